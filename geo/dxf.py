"""Lines with heights, written as DXF for CAD programs."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from geo.crs import called, crs_code, height_unit_m, horizontal_unit, is_geographic
from geo.errors import UnwritableFile
from geo.files import write_whole
from geo.optional import library_for

MARK = b"bathynerf"
# $INSUNITS, by the length of the unit [m]; 0 for one that has no number.
_NO_UNIT, _UNITS = 0, ((1.0, 6), (1000.0, 7), (0.3048, 2), (1200.0 / 3937.0, 21))
_VERSION = "R2010"
# What names of layers may not hold.
_NOT_IN_NAMES = re.compile(r"[<>/\\\":;?*|=`\x00-\x1f]")


class DxfLine(NamedTuple):
    """A polyline."""

    layer: str
    places: np.ndarray  # (N, 3): Easting, northing and height, in the units of a CRS


def write_dxf(path: str | Path, lines: Sequence[DxfLine], crs: CRS) -> None:
    """Write polylines as DXF (R2010), whole or not at all; a layer for each name, the CRS in a custom property.

    Raises
    ------
    UnwritableFile
        If the CRS is in degrees, or in different units in plan and in height, which a drawing cannot hold; if the file
        cannot be written, or ezdxf is not installed.
    """
    if is_geographic(crs):
        raise UnwritableFile(
            f"{path}: a DXF is in lengths, and {called(crs)} is in degrees; give --crs, e.g. a UTM zone"
        )
    unit = horizontal_unit(crs)
    if abs(height_unit_m(crs) / unit - 1.0) > 1e-9:
        raise UnwritableFile(
            f"{path}: a DXF has one unit for plan and heights, and {called(crs)} has {unit:.10g} m in plan and "
            f"{height_unit_m(crs):.10g} m in height; give --crs with the same unit in both"
        )
    ezdxf = library_for(path, "ezdxf", "dxf", to_write=True)
    drawing = ezdxf.new(_VERSION)
    drawing.header["$INSUNITS"] = next((code for length, code in _UNITS if abs(length / unit - 1.0) < 1e-9), _NO_UNIT)
    drawing.header.custom_vars.append("made_by", MARK.decode())
    drawing.header.custom_vars.append("crs", crs_code(crs) or called(crs))
    space = drawing.modelspace()
    for line in lines:
        layer = _NOT_IN_NAMES.sub("_", line.layer)
        if layer not in drawing.layers:
            drawing.layers.add(layer)
        space.add_polyline3d(line.places.tolist(), dxfattribs={"layer": layer})
    text = io.StringIO()
    drawing.write(text)
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode(drawing.output_encoding, errors="dxfreplace"))


def is_our_dxf(path: Path) -> bool:
    """Whether a file is a DXF that `write_dxf` wrote."""
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    return b"SECTION" in head[:64] and MARK in head
