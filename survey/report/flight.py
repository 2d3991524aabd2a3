"""Map of the flight: cameras and their footprints over the bed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle

from geo.projection import ground_units_m
from refract import PinholeCamera
from survey.compare.canvas import extent_around, map_canvas, show
from survey.display.column import median
from survey.display.palette import BOUNDS, INK, LAND, OBLIQUE, SOFT, WATER
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import distance, height
from survey.folder.survey import Survey
from survey.report.facts import ReportFacts
from survey.report.raster import Picture, finished

_OBLIQUE_DEG = 15.0
# Line of an oblique view, as a share of the longer side of the map.
_LOOK = 0.05
_CELLS = 150
# An interval of this many times the usual one is a pause: another line or another flight.
_PAUSE = 4.0
# With more outlines than this each is drawn fainter.
_FEW_OUTLINES = 20


def draw_plan(path: Path, facts: ReportFacts) -> Picture:
    """Cameras with footprints and directions of view, bed under water, dry ground and bounds, in plan."""
    survey = facts.survey
    cameras = [view.camera for view in survey.views]
    centres = survey.frame.crs_from_local(np.array([c.centre for c in cameras]))[:, :2]
    if len(facts.bed):
        ground = median(facts.bed.xyz[:, 2])
    else:
        ground = float(np.median([camera.centre[2] for camera in cameras])) - facts.plan.height_m
    footprints = [survey.frame.crs_from_local(_footprint(camera, survey, ground))[:, :2] for camera in cameras]
    bounds = np.reshape(() if survey.bounds is None else survey.bounds, (-1, 2))
    extent = extent_around(np.concatenate([*footprints, centres, bounds]), survey.frame.crs, 0.025)
    figure, axes = map_canvas(extent, survey.frame.crs, below_in=0.5)
    axes.set_facecolor("white")
    if len(facts.bed):
        _draw_wet_and_dry(axes, facts)
    outline = to_rgba(INK, min(0.4, max(0.08, 0.4 * _FEW_OUTLINES / len(cameras))))
    axes.add_collection(PolyCollection(footprints, facecolors="none", edgecolors=outline, lw=0.7))
    _draw_lines(axes, facts, centres)
    unit_m = ground_units_m(survey.frame.crs, centres[0])
    longer_m = max((extent[1] - extent[0]) * unit_m[0], (extent[3] - extent[2]) * unit_m[1])
    _draw_cameras(axes, survey, centres, _LOOK * longer_m / unit_m)
    if survey.bounds is not None:
        e0, n0, e1, n1 = survey.bounds
        frame = Rectangle((e0, n0), e1 - e0, n1 - n0, fill=False, ec=BOUNDS, lw=1.6, ls="--", zorder=4)
        frame.set_label("bounds")
        axes.add_patch(frame)
    figure.legend(loc="lower center", ncols=3, frameon=False, fontsize=9)
    subtitle = f"{len(cameras)} views, {distance(facts.plan.height_m)} over {_over(survey)}"
    words = f"Outlines: what each photograph covers on {_over(survey)}."
    return finished(axes, path, "The flight in plan", subtitle, words)


def _draw_wet_and_dry(axes: Axes, facts: ReportFacts) -> None:
    grid = PlanGrid.over(facts.points_crs, facts.survey.frame.crs, max_cells=_CELLS)
    count, wet = grid.count(), grid.count(facts.bed.wet)
    is_wet = 2 * wet >= np.maximum(count, 1)
    for part, colour, label in (
        (is_wet, WATER, "bed under water"),
        ((count > 0) & ~is_wet, LAND, "dry ground"),
    ):
        if part.any():
            image = np.where(part[..., None], to_rgba(colour), (0.0, 0.0, 0.0, 0.0))
            show(axes, image, grid.extent)
            axes.add_patch(Rectangle((0.0, 0.0), 0.0, 0.0, color=colour, label=label, transform=axes.transAxes))


def _draw_lines(axes: Axes, facts: ReportFacts, centres: np.ndarray) -> None:
    """Draw lines from exposure to exposure in the order of their times; no line over a pause."""
    headers = [facts.headers.get(view.name) for view in facts.survey.views]
    # One clock for all.
    times = [None if header is None else header.taken for header in headers]
    if None in times:
        times = [None if header is None else header.clock for header in headers]
    seconds = np.array([time.timestamp() for time in times if time is not None])
    if len(seconds) == len(times):
        lines = flight_lines(seconds, centres)
        axes.add_collection(LineCollection(list(lines), colors=SOFT, lw=0.9, zorder=4, label="flight line"))


def flight_lines(seconds: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Segments (K, 2, 2) between successive cameras (N, 2) at times (N,) [s]; none across a pause."""
    order = np.argsort(seconds, kind="stable")
    along, gaps = centres[order], np.diff(seconds[order])
    return np.stack([along[:-1], along[1:]], axis=1)[gaps <= _PAUSE * np.median(gaps)]


def _draw_cameras(axes: Axes, survey: Survey, centres: np.ndarray, length: np.ndarray) -> None:
    """Dots for cameras, and lines of up to ``length`` (2,) in crs in the viewing directions of oblique ones."""
    looks = np.array([view.camera.cam_from_local[2] for view in survey.views])
    is_oblique = np.degrees(np.arccos(np.clip(-looks[:, 2], -1.0, 1.0))) > _OBLIQUE_DEG
    lines = np.stack([centres, centres + looks[:, :2] * length], axis=1)[is_oblique]
    axes.add_collection(LineCollection(lines, colors=OBLIQUE, lw=1.2, zorder=5))
    for part, colour, label in ((~is_oblique, INK, "camera"), (is_oblique, OBLIQUE, "camera, oblique")):
        if part.any():
            axes.plot(*centres[part].T, "o", ms=4.5, mfc=colour, mec="white", mew=0.6, label=label, zorder=6)


def _footprint(camera: PinholeCamera, survey: Survey, ground: float) -> np.ndarray:
    """Border (N, 3) of an image on the water, or on level ground; local.

    Rays flatter than 1 in 4 are taken as falling 1 in 4. Pixels outside the field of the lens are left out.
    """
    rays = camera.directions(camera.outline())
    rays = rays[np.isfinite(rays).all(axis=1)]
    if survey.water is None:
        normal, over = np.array([0.0, 0.0, 1.0]), float(camera.centre[2]) - ground
    else:
        normal, over = np.array(survey.water.up), -float(survey.water.depth(camera.centre))
    return camera.centre + rays * (over / np.maximum(-rays @ normal, 0.25))[:, None]


def _over(survey: Survey) -> str:
    water = survey.config.water
    if water is None:
        return "the ground"
    slope = math.hypot(water.slope_east, water.slope_north)
    return f"the water at {height(water.known_level_m)}" + (f", which rises by {100.0 * slope:.2g} %" if slope else "")
