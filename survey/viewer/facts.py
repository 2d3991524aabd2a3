"""What is known of a point, and of the way between two, as lines of text."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from geo.crs import is_geographic
from survey.display.quantities import MINUS, length, number
from survey.viewer.colours import SCALES
from survey.viewer.shown import Shown
from survey.viewer.sightings import Sighting


def facts_of(shown: Shown, row: int, seen: Sequence[Sighting] | None = None) -> list[tuple[str, str]]:
    """A point of the cloud, as labels and texts; with the photographs in whose frames it lies."""
    frame = shown.new_frame()
    east, north, height = frame.crs_from_local(shown.tree.points[row][None])[0]
    names, digits = (("longitude", "latitude"), 8) if is_geographic(frame.crs) else (("easting", "northing"), 3)
    rows = [(names[0], number(east, digits)), (names[1], number(north, digits)), ("height", number(height, 3))]
    for kind, scale in SCALES.items():
        if kind != "height" and kind in shown.columns:
            value = float(shown.columns[kind][row])
            rows.append((scale.label, number(value, 0) if kind == "num_views" else length(value)))
    if seen is not None and not seen:
        rows.append(("in the frame of", "no photograph"))
    elif seen:
        low, high = (math.degrees(seen[place].incidence) for place in (0, -1))
        rows.append(("in the frame of", f"{len(seen)} photographs, {low:.0f} to {high:.0f}° off nadir"))
    return rows


def way_between(start: np.ndarray, end: np.ndarray) -> list[tuple[str, str]]:
    """Distances between two points (3,) [m], local, as labels and texts."""
    away = end - start
    fall = float(away[2])
    return [
        ("distance", length(float(np.linalg.norm(away)))),
        ("in plan", length(float(np.linalg.norm(away[:2])))),
        ("height", ("+" if fall > 0.0 else "") + length(fall).replace("-", MINUS)),
    ]


def markdown(rows: Sequence[tuple[str, str]]) -> str:
    """Labels and texts as a table for the panel."""
    return "\n".join(["| | |", "|---|---|", *(f"| {label} | {text} |" for label, text in rows)])
