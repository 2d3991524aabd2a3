"""Lines that were measured in the scene, as files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geo.lines import Line
from geo.vectors import Layer, write_geojson
from survey.export.profiles import Bed, write_csv
from survey.viewer.shown import Shown

# Two points (3,) [m], local.
Ends = tuple[np.ndarray, np.ndarray]


def write_lines(path: Path, shown: Shown, lines: Sequence[Ends]) -> None:
    """Lines with their lengths and height differences, as GeoJSON."""
    frame, offsets = shown.new_frame(), [end - start for start, end in lines]
    columns: dict[str, list] = {
        "name": [str(number) for number in range(1, len(lines) + 1)],
        "distance_m": [round(float(np.linalg.norm(offset)), 4) for offset in offsets],
        "in_plan_m": [round(float(np.linalg.norm(offset[:2])), 4) for offset in offsets],
        "height_difference_m": [round(float(offset[2]), 4) for offset in offsets],
    }
    shapes = [frame.crs_from_local(np.array(ends))[:, :2] for ends in lines]
    write_geojson(path, Layer("lines", "LineString", shapes, frame.crs, columns))


def write_profile(path: Path, shown: Shown, lines: Sequence[Ends]) -> None:
    """The last line as the table of `bathynerf profile`."""
    corners = shown.new_frame().crs_from_local(np.array(lines[-1]))[:, :2]
    reference = None if shown.reference is None else shown.reference.path
    write_csv(path, [Bed(shown.folder, reference).along(Line(str(len(lines)), corners))])
