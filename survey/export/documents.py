"""The report as PDF; a project of QGIS with cloud, terrain model, standard deviation and orthophoto, in one folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape, quoteattr

from matplotlib import colormaps
from pyproj import CRS

from geo.crs import crs_code, horizontal_crs
from geo.drivers import open_raster
from geo.files import write_text
from survey.display.palette import DEPTHS, SPREADS
from survey.errors import SurveyError
from survey.export.clouds import write_copc
from survey.export.loaded import LoadedRun
from survey.export.orthophoto import write_orthophoto
from survey.export.product import ExportOptions
from survey.export.styles import pipe, ramp
from survey.export.terrain import write_dem
from survey.progress import current
from survey.report.page import browser_for
from survey.report.page import write_pdf as print_page

_PROJECT, _MARK = "bed.qgs", "<!-- made by bathynerf -->"
_CLOUD, _DEM, _PHOTO = "cloud.copc.laz", "dem.tif", "orthophoto.tif"
# The first version of QGIS that reads COPC.
_VERSION = "3.26.0"
_STD_BAND = 2


class _Layer(NamedTuple):
    """A layer, from the top of the legend down."""

    # name, file, provider, kind: ``kind`` is QGIS's: "raster" or "point-cloud"
    name: str
    file: str
    provider: str
    kind: str
    content: str  # Its renderer
    is_shown: bool

    @property
    def key(self) -> str:
        # QGIS replaces shorter keys.
        return f"bathynerf_{self.name.replace(' ', '_')}"


def write_pdf(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """report.html, printed by a browser."""
    print_page(run.folder.report_html_path, path)


def check_pdf(path: Path, _run: LoadedRun, _options: ExportOptions) -> None:
    """Raise UnwritableFile without a browser."""
    browser_for(path)


def write_qgis(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The project with its files."""
    path.mkdir(parents=True, exist_ok=True)
    write_copc(path / _CLOUD, run, options)
    write_dem(path / _DEM, run, options)
    try:
        write_orthophoto(path / _PHOTO, run, options)
    except SurveyError as error:
        (path / _PHOTO).unlink(missing_ok=True)
        current().warn(f"{path / _PROJECT} has no orthophoto: {error}")
    write_text(path / _PROJECT, project(path, run.bed_header.name))


def project(folder: Path, title: str) -> str:
    """The text of the project for the files that lie in a folder; their paths are relative to it."""
    dem = folder / _DEM
    with open_raster(dem) as raster:
        bounds, crs = raster.bounds, horizontal_crs(CRS.from_wkt(raster.crs.to_wkt()))
    layers = [
        _Layer("cloud", _CLOUD, "copc", "point-cloud", _CLOUD_RENDERER, False),
        _Layer("height", _DEM, "gdal", "raster", pipe(ramp(dem, DEPTHS.reversed())), True),
        _Layer("standard deviation", _DEM, "gdal", "raster", pipe(ramp(dem, colormaps[SPREADS], _STD_BAND)), False),
    ]
    if (folder / _PHOTO).exists():
        layers.append(_Layer("orthophoto", _PHOTO, "gdal", "raster", pipe(_COLOURS), True))
    system = _system(crs)
    tree = "".join(
        f'<layer-tree-layer id="{layer.key}" name="{layer.name}" providerKey="{layer.provider}" '
        f'source="./{layer.file}" checked="Qt::{"Checked" if layer.is_shown else "Unchecked"}" expanded="0"/>\n'
        for layer in layers
    )
    maps = "".join(
        f'<maplayer type="{layer.kind}"><id>{layer.key}</id><datasource>./{layer.file}</datasource>'
        f"<layername>{layer.name}</layername><srs>{system}</srs><provider>{layer.provider}</provider>"
        f"{layer.content}</maplayer>\n"
        for layer in layers
    )
    extent = "".join(
        f"<{name}>{value!r}</{name}>"
        for name, value in zip(("xmin", "ymin", "xmax", "ymax"), map(float, bounds), strict=True)
    )
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        f"<qgis version={quoteattr(_VERSION)} projectname={quoteattr(title)}>{_MARK}\n<title>{escape(title)}</title>\n"
        f"<projectCrs>{system}</projectCrs>\n<layer-tree-group>\n{tree}</layer-tree-group>\n"
        f'<mapcanvas name="theMapCanvas"><extent>{extent}</extent><destinationsrs>{system}</destinationsrs>'
        f"</mapcanvas>\n<projectlayers>\n{maps}</projectlayers>\n"
        '<properties><Paths><Absolute type="bool">false</Absolute></Paths><SpatialRefSys><ProjectionsEnabled '
        'type="int">1</ProjectionsEnabled></SpatialRefSys></properties>\n</qgis>\n'
    )


def _system(crs: CRS) -> str:
    code = crs_code(crs)
    known = "" if code is None else f"<authid>{escape(code)}</authid>"
    return f"<spatialrefsys><wkt>{escape(crs.to_wkt())}</wkt>{known}</spatialrefsys>"


_COLOURS = (
    '<rasterrenderer type="multibandcolor" redBand="1" greenBand="2" blueBand="3" alphaBand="4" opacity="1" '
    'nodataColor=""><rasterTransparency/></rasterrenderer>'
)
# 16 bits for each colour, as in LAS.
_CLOUD_RENDERER = (
    '<renderer type="rgb" red="Red" green="Green" blue="Blue" pointSize="1" pointSizeUnit="MM" pointSymbol="0" '
    'maximumScreenError="0.3" maximumScreenErrorUnit="MM">'
    + "".join(
        f"<{name}ContrastEnhancement><minValue>0</minValue><maxValue>65535</maxValue>"
        f"<algorithm>StretchToMinimumMaximum</algorithm></{name}ContrastEnhancement>"
        for name in ("red", "green", "blue")
    )
    + "</renderer>"
)
