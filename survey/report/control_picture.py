"""Map of control and check points with their residuals as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from geo.projection import ground_units_m
from survey.adjust.adjustment import Adjustment
from survey.compare.canvas import map_canvas, nice_limit, save, write_title
from survey.display.palette import BLUE, INK, LAND, RED
from survey.display.quantities import LengthUnit, length
from survey.folder.survey import Survey
from survey.report.checkpoints import CheckpointFigures
from survey.report.raster import Picture

# An arrow of the length that the subtitle names is as long as this share of the map.
_LONGEST = 0.125
_MARGIN = 0.14
# A point that is off by so many times the median sets no scale: its arrow is cut, and its name says by how much it is.
_FAR, _CUT = 10.0, 1.5


@dataclass(frozen=True)
class Residual:
    """A point with what the survey has it off by.

    Attributes
    ----------
    name : str
    place : (easting, northing), in crs
    off_m : (east, north, up) [m]
        NaN where it is not known.
    is_check : bool
    """

    name: str
    place: tuple[float, float]
    off_m: tuple[float, float, float]
    is_check: bool


def residuals_of(
    survey: Survey, adjustment: Adjustment | None, checkpoints: CheckpointFigures | None
) -> list[Residual]:
    """Control points by the adjustment, and check points by it, else by the height of the cloud."""
    given = survey.observations.control
    control = {} if given is None else {point.name: point for point in given.points}
    found = {
        row.name: Residual(row.name, control[row.name].crs[:2], row.residual_m, row.is_check)
        for row in (() if adjustment is None else adjustment.control)
    }
    places = {name: point.crs[:2] for name, point in control.items()}
    places |= {point.name: point.crs[:2] for point in survey.observations.checkpoints}
    for row in () if checkpoints is None else checkpoints.rows:
        if row.name not in found and row.difference_m is not None:
            off = (float("nan"), float("nan"), row.difference_m)
            found[row.name] = Residual(row.name, places[row.name], off, True)
    return list(found.values())


def draw_residuals(path: Path, survey: Survey, residuals: Sequence[Residual]) -> Picture:
    """Points in plan: an arrow for what they are off in plan, one along the map's north for the height."""
    crs = survey.frame.crs
    places = np.array([each.place for each in residuals])
    off = np.array([each.off_m for each in residuals])
    unit_m = ground_units_m(crs, places[0])
    extent, width_m = _extent(places, unit_m)
    figure, axes = map_canvas(extent, crs, below_in=0.5)
    axes.set_facecolor("white")
    in_all = np.sqrt(np.nansum(off**2, axis=1))
    off, longest, is_far = clipped(off)
    times = _LONGEST * width_m / longest
    in_plan = np.isfinite(off[:, 0])
    up = np.column_stack([np.zeros(len(off)), off[:, 2]])
    _arrows(axes, places[in_plan], times * off[in_plan, :2] / unit_m, BLUE, "off in plan")
    _arrows(axes, places, times * up / unit_m, RED, "off in height, up as north")
    is_check = np.array([each.is_check for each in residuals])
    for part, mark, colour, label in ((~is_check, "^", INK, "control point"), (is_check, "s", LAND, "check point")):
        if part.any():
            axes.plot(*places[part].T, mark, ms=6.0, mfc=colour, mec=INK, mew=0.8, label=label, zorder=5)
    for each, far, whole in zip(residuals, is_far, in_all, strict=True):
        name = f"{each.name} (cut: {length(float(whole))})" if far else each.name
        axes.annotate(name, each.place, (5, 5), textcoords="offset points", fontsize=7.5, color=INK, zorder=6)
    figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    unit = LengthUnit.of([longest])
    title = "Control and check points"
    write_title(axes, title, f"magnified: an arrow an eighth as long as the map is wide means {unit.text(longest)}")
    save(figure, path)
    words = "The adjusted point less the given one; of check points without marks, the height of the cloud less theirs."
    return Picture(path, title, words)


def clipped(off: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Residuals (N, 3) [m] with outliers clipped, the length [m] of the longest arrow, and the outliers (N,) bool.

    Outliers set no scale for the arrows of the others.
    """
    in_all = np.sqrt(np.nansum(off**2, axis=1))
    is_far = in_all > _FAR * np.median(in_all)
    near = off if is_far.all() else off[~is_far]
    longest = nice_limit(np.concatenate([np.hypot(near[:, 0], near[:, 1]), near[:, 2]]))
    share = np.minimum(_CUT * longest / np.maximum(in_all, 1e-9), 1.0)
    return np.where(is_far[:, None], off * share[:, None], off), longest, is_far


def _arrows(axes: Axes, places: np.ndarray, steps: np.ndarray, colour: str, label: str) -> None:
    if len(places):
        axes.quiver(
            *places.T,
            *steps.T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.006,
            color=colour,
            label=label,
            zorder=4,
        )


def _extent(places: np.ndarray, unit_m: np.ndarray) -> tuple[tuple[float, float, float, float], float]:
    """West, east, south, north around places with room for arrows and names, and the width [m]."""
    low, high = places.min(axis=0), places.max(axis=0)
    size = max(float(((high - low) * unit_m).max()), 1.0)
    low, high = low - _MARGIN * size / unit_m, high + _MARGIN * size / unit_m
    return (float(low[0]), float(high[0]), float(low[1]), float(high[1])), float((high - low)[0] * unit_m[0])
