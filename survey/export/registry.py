"""Every product of `bathynerf export`, in the order of its help. A new family of products is one line here."""

from __future__ import annotations

from survey.export.cameras import CAMERAS
from survey.export.clouds import CLOUDS
from survey.export.documents import DOCUMENTS
from survey.export.hydrography import HYDROGRAPHY, SOUNDINGS
from survey.export.meshes import MESHES
from survey.export.orthophoto import ORTHOPHOTO
from survey.export.product import Product
from survey.export.qgis_project import QGIS
from survey.export.terrain import TERRAIN
from survey.export.vectors import VECTORS

# By the panel of help that a product stands in.
FAMILIES: dict[str, tuple[Product, ...]] = {
    "Points": (*CLOUDS, *SOUNDINGS),
    "Rasters": (*TERRAIN, *HYDROGRAPHY, *ORTHOPHOTO),
    "Meshes": MESHES,
    "Lines and areas": VECTORS,
    "Cameras": CAMERAS,
    "Documents and projects": (*DOCUMENTS, *QGIS),
}
PRODUCTS: tuple[Product, ...] = tuple(product for members in FAMILIES.values() for product in members)
