"""Lines of equal depth, and the shoreline, in the raster of heights that all raster products are made of."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import contourpy
import numpy as np

from geo.vectors import Layer
from survey.errors import SurveyError
from survey.export.bed_cells import Window
from survey.export.gridded import gridded

if TYPE_CHECKING:
    from survey.export.bed_cells import Gridded
    from survey.export.loaded import LoadedRun
    from survey.export.product import ExportOptions

# Shorter lines, in cells, are noise of single cells.
SHORTEST = 8.0
_ABOUT = 10
# More are an interval by mistake.
_MOST_LEVELS = 1000
_ROUND = (1.0, 2.0, 5.0, 10.0)


def contours(run: LoadedRun, options: ExportOptions) -> Layer:
    """Lines of equal depth; of equal height in a dry survey.

    Raises
    ------
    SurveyError
        If the interval is none, or makes too many contours.
    GeoError
        If the CRS is unusable.
    """
    grid = gridded(run, options)
    whole = _whole(grid)
    is_dry = grid.level is None
    values = grid.heights(whole) if is_dry else grid.depths(whole)
    step = _interval(values, options.interval_m)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if (high - low) / step > _MOST_LEVELS:
        raise SurveyError(
            f"--interval {step:g} makes over {_MOST_LEVELS} contours from {low:.2f} to {high:.2f} m; give a larger one"
        )
    levels = [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    lines, depths = [], []
    for level in levels:
        found = _lines(grid, values, level)
        lines += found
        depths += [round(level, 6)] * len(found)
    name = "height_m" if is_dry else "depth_m"
    about = f"every {step:g} m, in cells of {grid.cells.side_m:g} m; depths count down from the water"
    return Layer("contours", "LineString", lines, grid.cells.crs, {name: depths}, about, _heights(grid, lines, depths))


def shoreline(run: LoadedRun, options: ExportOptions) -> Layer:
    """The line of depth zero, where the bed was found on both sides of it.

    Raises
    ------
    SurveyError
        For a dry survey.
    """
    grid = gridded(run, options)
    if grid.level is None:
        raise SurveyError(f"{run.place.name} is a dry survey and has no shoreline; leave --shoreline out")
    lines = _lines(grid, grid.depths(_whole(grid)), 0.0)
    about = f"where the bed meets the water of the survey, in cells of {grid.cells.side_m:g} m"
    depths = [0.0] * len(lines)
    heights = _heights(grid, lines, depths)
    return Layer("shoreline", "LineString", lines, grid.cells.crs, {"depth_m": depths}, about, heights)


def _heights(grid: Gridded, lines: list[np.ndarray], values: list[float]) -> list[np.ndarray]:
    """Heights (N,) in crs along lines of one depth, or of one height in a dry survey [m]."""
    level = grid.level
    return [
        (np.full(len(line), value) if level is None else level(line) - value) / grid.height_unit_m
        for line, value in zip(lines, values, strict=True)
    ]


def _whole(grid: Gridded) -> Window:
    rows, columns = grid.cells.shape
    return Window(0, rows, 0, columns)


def _lines(grid: Gridded, values: np.ndarray, level: float) -> list[np.ndarray]:
    """Lines (N, 2) in crs through the middles of cells; they end where cells have no height."""
    if min(values.shape) < 2:
        return []
    found = [np.asarray(line) for line in contourpy.contour_generator(z=np.ma.masked_invalid(values)).lines(level)]
    lengths = (np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in found)
    west, north, side = grid.cells.west, grid.cells.north, np.array(grid.cells.side)
    corner = np.array([west + 0.5 * side[0], north - 0.5 * side[1]])
    return [
        corner + line * side * np.array([1.0, -1.0])
        for line, length in zip(found, lengths, strict=True)
        if length >= SHORTEST
    ]


def _interval(values: np.ndarray, asked: float | None) -> float:
    """Between lines [m]: what is asked for, or a round number that gives about ten."""
    if asked is not None:
        if not (math.isfinite(asked) and asked > 0.0):
            raise SurveyError(f"--interval is {asked:g}, expected metres between contours, e.g. 0.25")
        return asked
    low, high = np.nanquantile(values, [0.02, 0.98])
    wanted = max(float(high - low), 1e-3) / _ABOUT
    power = 10.0 ** math.floor(math.log10(wanted))
    return next(power * number for number in _ROUND if power * number >= wanted * (1.0 - 1e-9))
