"""QGIS styles (.qml) next to rasters and clouds: QGIS applies the one with the name of the file when it opens it."""

from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from laspy.copc import CopcReader
from matplotlib.colors import Colormap, to_hex

from evaluation.standards import TVU
from geo.files import write_text
from geo.raster import open_raster
from survey.display.palette import DEPTHS, RED
from survey.progress import current

# QGIS drops comments when it saves a style, so a style with this mark is unchanged and may be replaced.
_MARK = "<!-- made by bathynerf -->"
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_NUM_COLOURS = 8
# Quantiles of a band at the ends of the colours, and cells along a side that are read for them.
_ENDS, _MOST_SIDE = (0.01, 0.99), 1024
# Levels of the octree of a cloud that are read: some 10,000 points.
_COARSE_LEVELS = 2

Style = Callable[[Path], str]


def write_style(path: Path, style: Style) -> None:
    """Write the style of a raster or cloud next to it, unless there is one that bathynerf did not write."""
    style_path = path.with_suffix(".qml")
    if style_path.exists() and _MARK not in style_path.read_text(encoding="utf-8", errors="replace"):
        current().detail(f"{style_path} was not written by bathynerf, and stays")
        return
    write_text(style_path, style(path))


def of_heights(path: Path) -> str:
    """Heights or elevations in the first band: dark blue where low."""
    with open_raster(path) as raster:
        scale = max(max(raster.shape) / _MOST_SIDE, 1.0)
        shape = tuple(max(int(side / scale), 1) for side in raster.shape)
        values = raster.read(1, out_shape=shape, masked=True).compressed()
    low, high = _ends(values)
    return _of_raster(
        '<rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1" nodataColor="" '
        f'classificationMin="{low:.9g}" classificationMax="{high:.9g}"><rasterTransparency/><rastershader>'
        f"{_shader(low, high, DEPTHS.reversed())}</rastershader></rasterrenderer>"
    )


def of_orders(_path: Path) -> str:
    """Orders of IHO S-44 in the first band, by their names."""
    names = [f"S-44 {name}" if name[0].isupper() else f"S-44 order {name}" for name, _, _ in TVU]
    shades = [to_hex(DEPTHS(0.85 - 0.7 * number / len(TVU))) for number in range(len(TVU))]
    entries = "".join(
        f'<paletteEntry value="{code}" color="{colour}" alpha="255" label={quoteattr(name)}/>'
        for code, (colour, name) in enumerate(zip([*shades, RED], [*names, "no order"], strict=True), 1)
    )
    return _of_raster(
        '<rasterrenderer type="paletted" band="1" opacity="1" alphaBand="-1" nodataColor=""><rasterTransparency/>'
        f"<colorPalette>{entries}</colorPalette></rasterrenderer>"
    )


def of_clouds(path: Path) -> str:
    """True depth of the points of a COPC, dark blue where deep, or their heights where no point has a depth."""
    with CopcReader.open(path) as reader:
        some = reader.query(level=range(_COARSE_LEVELS))
    depth = np.asarray(some["depth"]) if "depth" in some.point_format.extra_dimension_names else np.empty(0)
    # What is not known is not positive either.
    wet = depth[depth > 0.0]
    is_wet = len(wet) > 0
    low, high = _ends(wet if is_wet else np.asarray(some.z))
    return _document(
        f'<renderer type="ramp" attribute="{"depth" if is_wet else "Z"}" min="{low:.9g}" max="{high:.9g}" '
        'pointSize="1" pointSizeUnit="MM" pointSymbol="0" maximumScreenError="0.3" maximumScreenErrorUnit="MM">'
        f"{_shader(low, high, DEPTHS if is_wet else DEPTHS.reversed())}</renderer>"
    )


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Values at both ends of the colours."""
    values = values[np.isfinite(values)].astype(np.float64)
    low, high = np.quantile(values, _ENDS).tolist() if len(values) else (0.0, 1.0)
    return low, high if high > low else low + 1.0


def _shader(low: float, high: float, colours: Colormap) -> str:
    steps = np.linspace(0.0, 1.0, _NUM_COLOURS)
    items = "".join(
        f'<item alpha="255" value="{value:.9g}" label="{value:.5g}" color="{to_hex(colours(step))}"/>'
        for step, value in zip(steps, low + steps * (high - low), strict=True)
    )
    return (
        '<colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" '
        f'minimumValue="{low:.9g}" maximumValue="{high:.9g}">{items}</colorrampshader>'
    )


def _of_raster(renderer: str) -> str:
    return _document(f"<pipe>{renderer}</pipe>")


def _document(content: str) -> str:
    return f'{_HEAD}<qgis version="3.22.0" styleCategories="AllStyleCategories">{_MARK}{content}</qgis>\n'
