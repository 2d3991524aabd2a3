"""Every product of `bathynerf export` as data, in the order of its help; a new product is an entry here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from survey.errors import SurveyError
from survey.files.toml_table import option
from survey.words import LARGEST

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun

# Finer cells repeat their neighbours, and fill the disk [px].
_FINEST_PX = 0.05
# By suffix, the module that writes a file and the extra that brings it, where it is not always there.
_LIBRARIES = {
    ".gpkg": ("pyogrio", "vector"), ".zip": ("pyogrio", "vector"), ".dxf": ("ezdxf", "dxf"),
}  # fmt: skip


_made, _mesh = partial(option, "How they are made"), partial(option, "Meshes")


@dataclass(frozen=True)
class ExportOptions:
    """Options of products; each product says in `Product.takes` which of these it follows."""

    resolution_m: float | None = _made(
        "M",
        "Side of a cell [m]; default: by the density of the points.",
        name="--resolution",
        # No aerial photograph resolves the first, and no survey is as wide as the second.
        expected="the side of a cell in metres, from 0.0001 to 100000, e.g. 0.1",
        least=1e-4,
        most=1e5,
    )
    # Of the product; None for that of the run
    crs: str | None = _made("CRS", "CRS of products, e.g. EPSG:32632; heights are kept unless it has a vertical part.")
    fill_m: float = _made(
        "M",
        "Fill gaps up to this width [m].",
        name="--fill",
        default=0.0,
        expected="the width of the gaps to fill in metres, e.g. 0.5",
        least=0.0,
        most=LARGEST,
    )
    mesh_method: str = _mesh(
        "METHOD",
        "delaunay: one height per place; poisson: with overhangs (extra mesh).",
        default="delaunay",
        one_of=("delaunay", "poisson"),
    )
    watertight: bool = _mesh(None, "Close the mesh with walls and a bottom.", name="--watertight", default=False)
    interval_m: float | None = _made(
        "M",
        "Contour interval [m]; default: about ten contours.",
        name="--interval",
        expected="metres between contours, e.g. 0.25",
        above=0.0,
        most=LARGEST,
    )
    no_bed: bool = _made(
        None, "Add water without a bed to LAS, LAZ, COPC: class 45, and 41 above it.", name="--no-bed", default=False
    )
    tpu: bool = _made(None, "Add total_tvu and total_thu [m], 95 %, to LAS, LAZ, COPC.", name="--tpu", default=False)
    thin: str = _made(
        None, "Thinning of soundings to one per cell; none: keep all.", default="none", one_of=("none", "shoal", "mean")
    )
    as_computed: bool = _made(None, "Ignore edits made in view.", name="--as-computed", default=False)
    survey: str | None = _made("DIR", "Survey folder, if it was moved since the run.")


def require_not_too_fine(side_m: float, pixel_m: float) -> None:
    """Raise SurveyError where cells of a side [m] are far smaller than pixels [m] on the ground."""
    if side_m < _FINEST_PX * pixel_m:
        raise SurveyError(
            f"--resolution {side_m:g} (metres) is finer than {_FINEST_PX:g} of a pixel, which covers "
            f"{1000.0 * pixel_m:.3g} mm of the ground; give e.g. --resolution {pixel_m:.1g}"
        )


@dataclass(frozen=True)
class Product:
    """Product: an option of `bathynerf export`.

    Its module has a function ``write_<option>`` of the path, the run and the options, which writes the file whole or
    not at all; where something can be known before, ``check_<option>`` of the same, which raises where it cannot be
    made; and where it has a style of QGIS, ``style_<option>`` of the path (`survey.export.styles`). The module is
    imported when the product is made: the command line imports this file.
    """

    option: str  # Without the dashes, e.g. "las".
    suffixes: tuple[str, ...]  # That a file of it may have, in lower case, e.g. (".tif", ".tiff").
    module: str  # In survey.export
    takes: tuple[str, ...]  # Fields of `ExportOptions` that it follows
    help: str  # One line
    example: str  # What follows the option in an example
    # Whether it is a folder of files, which is made where it is not there, and always written anew
    is_folder: bool = False
    is_of_points: bool = True  # Whether it is made of the points of the bed, of which a run may have none

    def function(self, verb: str) -> Any:
        """The function of the product that begins with a verb, "write", "check" or "style"; None where it has none."""
        return getattr(import_module(f"survey.export.{self.module}"), f"{verb}_{self.option}", None)


_EDITED = "as_computed"
_CELLS = ("crs", "resolution_m", "fill_m", _EDITED)
_TIFF, _VECTOR = (".tif", ".tiff"), (".geojson", ".gpkg")
_LINES = (*_VECTOR, ".dxf", ".zip")
_BY_GDAL = "GeoJSON, DXF (extra dxf), GPKG, zipped shapefile (extra vector)."
FAMILIES: dict[str, tuple[Product, ...]] = {
    "Points": (
        Product("las", (".las",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as LAS 1.4.", "bed.las"),
        Product("laz", (".laz",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as LAZ, LAS compressed.", "bed.laz --crs EPSG:4326"),
        Product("copc", (".copc.laz",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as cloud-optimised LAZ, from which readers fetch parts.", "bed.copc.laz"),
        Product("ply", (".ply",), "clouds", ("crs", _EDITED),
                "Points as binary PLY in double precision.", "bed.ply"),
        Product("soundings", (".xyz", ".csv"), "clouds", ("crs", "resolution_m", "thin", _EDITED),
                "Points as XYZ or, with depth and standard deviations, CSV.", "bed.xyz --thin shoal"),
    ),
    "Rasters": (
        Product("dem", _TIFF, "rasters", _CELLS,
                "Heights as GeoTIFF: height, uncertainty, points, depth, origin.", "bed.tif --resolution 0.1"),
        Product("bag", (".bag",), "rasters", _CELLS,
                "Heights and uncertainty as BAG (HDF5).", "bed.bag --resolution 0.5"),
        Product("s44", _TIFF, "rasters", _CELLS,
                "Order of IHO S-44 by uncertainty, as GeoTIFF.", "orders.tif --resolution 1"),
        Product("orthophoto", _TIFF, "orthophoto", (*_CELLS, "survey"),
                "The bed from above, from the photographs, as GeoTIFF.", "bed.tif --fill 0.5"),
        Product("waves", ("",), "rasters", (_EDITED,),
                "Folder: height of the water in each photograph, as GeoTIFF.", "waves", is_folder=True),
    ),
    "Meshes": (
        Product("mesh", (".ply", ".obj", ".glb"), "meshes",
                ("crs", "resolution_m", "mesh_method", "watertight", _EDITED),
                "The bed in coloured triangles: PLY, OBJ or GLB.", "bed.obj --watertight"),
    ),
    "Lines and areas": (
        Product("footprints", _VECTOR, "vectors", ("crs", _EDITED),
                "What each photograph shows of the bed: GeoJSON, GeoPackage (extra vector).", "images.geojson"),
        Product("shoreline", _LINES, "vectors", _CELLS,
                f"Where the bed meets the water: {_BY_GDAL}", "shore.gpkg --fill 0.5"),
        Product("contours", _LINES, "vectors", (*_CELLS, "interval_m"),
                f"Lines of equal depth: {_BY_GDAL}", "deep.dxf --interval 0.5"),
        Product("unseen", _VECTOR, "vectors", ("crs", _EDITED),
                "Where water was looked at and no bed found, and why: polygons.", "unseen.geojson"),
        Product("gaps", _TIFF, "vectors", (_EDITED,),
                "Why ground inside the bounds has no point, wet or dry: reasons as GeoTIFF.", "gaps.tif"),
    ),
    "Cameras": (
        Product("colmap", ("",), "cameras", (_EDITED,),
                "Folder: cameras as a COLMAP model (text); rays bend at the water.", "sparse", is_folder=True),
        Product("nerfstudio", (".json",), "cameras", (),
                "Cameras as nerfstudio's transforms.json.", "cameras.json", is_of_points=False),
    ),
    "Documents": (
        Product("pdf", (".pdf",), "pdf", (),
                "report.html as PDF, A4 (by Chromium, Chrome or Edge).", "report.pdf", is_of_points=False),
    ),
}  # fmt: skip
PRODUCTS: tuple[Product, ...] = tuple(product for members in FAMILIES.values() for product in members)


def require_makeable(product: Product, path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError or GeoError where a product cannot be made: for its library, its options, or the run.

    What can only be found while it is computed, e.g. that no cell of a raster has a height, is not.
    """
    from geo.files import library_for

    if product.is_of_points:
        run.require_points()
    if (library := _LIBRARIES.get(path.suffix.lower())) is not None:
        library_for(path, *library, to_write=True)
    if "resolution_m" in product.takes and options.resolution_m is not None:
        require_not_too_fine(options.resolution_m, run.bed_header.gsd_m)
    if (check := product.function("check")) is not None:
        check(path, run, options)
