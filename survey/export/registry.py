"""Every product of `bathynerf export`, in the order of its help. A new family of products is one line here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.cameras import CAMERAS
from survey.export.clouds import CLOUDS
from survey.export.hydrography import HYDROGRAPHY
from survey.export.meshes import MESHES
from survey.export.orthophoto import ORTHOPHOTO
from survey.export.product import ExportOptions, Product
from survey.export.qgis_project import QGIS
from survey.export.soundings import SOUNDINGS
from survey.export.terrain import TERRAIN
from survey.export.vectors import VECTORS

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun


def _write_pdf(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    from survey.report.page import write_pdf

    write_pdf(run.folder.report_html_path, path)


def _check_pdf(path: Path, _run: LoadedRun, _options: ExportOptions) -> None:
    from survey.report.page import browser_for

    browser_for(path)


DOCUMENTS = (
    Product(
        "pdf",
        (".pdf",),
        help="report.html as PDF, A4 (by Chromium, Chrome or Edge).",
        example="--pdf report.pdf",
        takes=(),
        write=_write_pdf,
        check=_check_pdf,
        is_of_points=False,
    ),
)
# Products by the panel of the help text.
FAMILIES: dict[str, tuple[Product, ...]] = {
    "Points": (*CLOUDS, *SOUNDINGS),
    "Rasters": (*TERRAIN, *HYDROGRAPHY, *ORTHOPHOTO),
    "Meshes": MESHES,
    "Lines and areas": VECTORS,
    "Cameras": CAMERAS,
    "Documents and projects": (*DOCUMENTS, *QGIS),
}
PRODUCTS: tuple[Product, ...] = tuple(product for members in FAMILIES.values() for product in members)
