"""Lines and areas of a run: footprints of the photographs, shoreline, contours, and where no bed was seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.product import ExportOptions, Product

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun


def _writer(name: str) -> Callable[[Path, LoadedRun, ExportOptions], None]:
    """The function of a product that writes the layer that the function of `survey.export.outlines` gives."""

    def write(path: Path, run: LoadedRun, options: ExportOptions) -> None:
        from geo import vectors
        from survey.export import outlines
        from survey.progress import current

        layer: vectors.Layer = getattr(outlines, name)(run, options)
        if not layer.shapes:
            current().note(f"{path}: nothing to show, the layer {layer.name} is empty")
        if path.suffix.lower() == ".gpkg":
            vectors.write_geopackage(path, layer)
        elif path.suffix.lower() == ".dxf":
            vectors.write_dxf(path, vectors.lines_of(layer), layer.crs)
        elif path.suffix.lower() == ".zip":
            vectors.write_shapefile(path, layer)
        elif (warning := vectors.write_geojson(path, layer)) is not None:
            current().warn(warning)

    return write


def _check(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise where the format of a layer cannot hold the CRS."""
    from geo.vectors import require_drawable, require_wgs84

    suffix, crs = path.suffix.lower(), run.crs_for(options.crs)
    if suffix == ".dxf":
        require_drawable(path, crs)
    elif suffix == ".geojson":
        place = run.some_place if options.crs is None else run.transformation_to(options.crs)(run.some_place)
        require_wgs84(path, crs, place[:, :2])


def _check_seen(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    _ = run.flight
    _check(path, run, options)


def _check_lines(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from survey.export.outlines import require_interval

    require_interval(options)
    _check(path, run, options)


def _check_shoreline(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from survey.export.outlines import require_wet

    require_wet(run)
    _check(path, run, options)


def _product(
    option: str,
    what: str,
    example: str,
    takes: tuple[str, ...],
    *,
    check: Callable[[Path, LoadedRun, ExportOptions], None] = _check,
    has_heights: bool = False,
) -> Product:
    return Product(
        option,
        (".geojson", ".gpkg", *((".dxf", ".zip") if has_heights else ())),
        help=f"{what}: GeoJSON, {'DXF (extra dxf), ' if has_heights else ''}{_BY_GDAL[has_heights]} (extra vector).",
        example=f"--{option} {example}",
        takes=takes,
        write=_writer(option),
        check=check,
    )


def _write_unseen(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    if path.suffix.lower() in _RASTERS:
        from survey.export.outlines import write_mask

        write_mask(path, run, options)
    else:
        _writer("unseen_areas")(path, run, options)


_BY_GDAL = {False: "GeoPackage", True: "GPKG, zipped shapefile"}
_CELLS = ("crs", "resolution_m", "fill_m")
_RASTERS = (".tif", ".tiff")
VECTORS = (
    _product("footprints", "What each photograph shows of the bed", "images.geojson", ("crs",), check=_check_seen),
    _product(
        "shoreline",
        "Where the bed meets the water",
        "shore.gpkg --fill 0.5",
        _CELLS,
        check=_check_shoreline,
        has_heights=True,
    ),
    _product(
        "contours",
        "Lines of equal depth",
        "deep.dxf --interval 0.5",
        (*_CELLS, "interval_m"),
        check=_check_lines,
        has_heights=True,
    ),
    Product(
        "unseen",
        (".geojson", ".gpkg", *_RASTERS),
        help="Where water was looked at and no bed found: polygons, or GeoTIFF in the cells of --dem.",
        example="--unseen unseen.geojson",
        takes=_CELLS,
        write=_write_unseen,
        check=_check_seen,
    ),
)
