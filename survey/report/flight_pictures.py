"""Pictures of flight and adjustment: cameras with what they see, residuals, parts, correlations of parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize, to_rgba
from matplotlib.patches import Rectangle

from evaluation.bootstrap import cell_counts, cell_means, cell_numbers
from geo.projection import ground_units_m
from refract import PinholeCamera
from survey.adjust.result.adjustment import Adjustment
from survey.adjust.result.parts import part_numbers
from survey.display import canvas
from survey.display.palette import BLUE, BOUNDS, DIFFERENCES, INK, LAND, OBLIQUE, RED, SERIES, SOFT, SPREADS, WATER
from survey.display.plan_grid import PlanGrid, median
from survey.display.quantities import LengthUnit, distance, height, length, number
from survey.folder.survey import Survey
from survey.report.adjustment import correlations, shown_lenses
from survey.report.checkpoints import MOST_ROWS, CheckpointAccuracy
from survey.report.facts import ReportFacts

# Cells along the longer side of a photograph, and the fewest residuals in one that is shown.
_CELLS, _FEWEST = 16, 5
# Cells of the ground: at most along a side, and residuals in each on average.
_GROUND_CELLS, _PER_CELL = 80, 20.0
# A correlation at least this large is written into its field in white.
_STRONG = 0.6
_LABELS = {"height_m": "level", "slope_x": "slope east", "slope_y": "slope north", "refractive_index": "index"}
# An arrow of the length that the subtitle names is as long as this share of the map.
_LONGEST = 0.125
# Margins of maps: beside cameras, and beside control points, for arrows and names.
_BESIDE, _MARGIN = 0.03, 0.14
# Views steeper than this are no oblique ones; their line, as a share of the longer side of the map.
_OBLIQUE_DEG, _LOOK = 15.0, 0.05
_PLAN_CELLS = 150
# An interval of this many times the usual one is a pause: another line or another flight.
_PAUSE = 4.0
# With more outlines than this each is drawn fainter.
_FEW_OUTLINES = 20
# A point with this many times the median residual sets no scale: its arrow is shortened, and its label has the factor.
_FAR, _CUT = 10.0, 1.5


def draw_image_residuals(path: Path, found: Adjustment) -> canvas.Picture:
    """Mean residual of each cell of the photographs of each lens, as arrows."""
    lenses = shown_lenses(found)
    num = len(lenses)
    tall = max(found.lenses[lens].height / found.lenses[lens].width for lens in lenses)
    figure = canvas.empty_figure(6.2 * num, 6.2 * tall + 0.55)
    fields = [mean_residuals(found, lens) for lens in lenses]
    longest = canvas.nice_limit(np.concatenate([np.linalg.norm(vectors, axis=1) for _, vectors, _ in fields]))
    subtitle = f"magnified: an arrow as long as a cell is wide means {longest:.2g} px"
    all_axes = np.ravel(figure.subplots(1, num))
    for lens, axes, (places, vectors, side) in zip(lenses, all_axes, fields, strict=True):
        _arrows(axes, places, vectors * side / longest, width=0.0035, color=BLUE)
        axes.plot(*places.T, ".", ms=2.0, color=SOFT)
        size = found.lenses[lens]
        axes.set(xlim=(0, size.width), ylim=(size.height, 0), xticks=[], yticks=[], aspect="equal")
        which = f" of lens {lens}" if len(found.lenses) > 1 else ""
        canvas.write_title(axes, f"Mean residual over the photographs{which}", subtitle)
    canvas.save(figure, path)
    words = "Measured less predicted place, over all photographs. A pattern is distortion that the lens model lacks."
    if num < len(found.lenses):
        words += f" Of {len(found.lenses)} lenses the {num} with the most residuals."
    return canvas.Picture(path, "Residuals over the photographs", words)


def _arrows(axes: Axes, places: np.ndarray, steps: np.ndarray, **style) -> None:
    """Arrows at places (N, 2) by steps (N, 2), both in the units of the axes."""
    if len(places):
        axes.quiver(*places.T, *steps.T, angles="xy", scale_units="xy", scale=1.0, **style)


def mean_residuals(found: Adjustment, lens: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Middles (K, 2) [px] of the cells, mean residuals (K, 2) [px] there, and the side of a cell [px]."""
    of_lens = found.poses.lens_of[found.residuals.view] == lens
    width, height = found.lenses[lens].width, found.lenses[lens].height
    side = max(width, height) / _CELLS
    shape = (math.ceil(height / side), math.ceil(width / side))
    cells = cell_numbers(found.residuals.at_px[of_lens] / side, shape)
    means = np.stack([cell_means(cells, axis, shape) for axis in found.residuals.px[of_lens].T], axis=-1)
    rows, columns = np.nonzero(cell_counts(cells, shape) >= _FEWEST)
    places = side * (np.column_stack([columns, rows]) + 0.5)
    return places, means[rows, columns], side


def draw_ground_residuals(path: Path, survey: Survey, found: Adjustment) -> canvas.Picture:
    """Root mean square residual of each cell of the ground, with cameras, control and tie points."""
    crs = survey.frame.crs
    points = survey.frame.crs_from_local(found.points)
    cameras = survey.frame.crs_from_local(found.poses.centres)
    grid = PlanGrid.over(points[found.residuals.point], crs, max_cells=_GROUND_CELLS, per_cell=_PER_CELL)
    rms = np.sqrt(grid.mean(0.5 * np.sum(found.residuals.px**2, axis=1)))
    known = rms[np.isfinite(rms)]
    scale = ScalarMappable(Normalize(0.0, canvas.nice_limit(known)), SPREADS)
    extent = canvas.extent_around(np.concatenate([grid.box, cameras[:, :2]]), crs, _BESIDE)
    figure, axes = canvas.map_canvas(extent, crs, below_in=0.5)
    canvas.show(axes, scale.to_rgba(np.ma.masked_invalid(rms)), grid.extent)
    canvas.colour_bar(axes, scale, "rms residual of a coordinate [px]", extend="max")
    axes.plot(*points[:, :2].T, ".", ms=1.2, color=INK, alpha=0.35, label="point", zorder=3)
    axes.plot(*cameras[:, :2].T, "o", ms=4.0, mfc=INK, mec="white", mew=0.6, label="camera", zorder=5)
    _draw_control(axes, survey, found)
    figure.legend(loc="lower center", ncols=4, frameon=False, fontsize=9)
    words = "Where they are large: waves, moving things, or few photographs."
    return canvas.finished(axes, path, "Residuals over the ground", f"cells of {grid.side_m:.2g} m", words)


def draw_parts(path: Path, survey: Survey, found: Adjustment) -> canvas.Picture:
    """Cameras and tie points of a block that falls apart, each part in a colour of its own."""
    crs, number_of = survey.frame.crs, part_numbers(found)
    points, cameras = (survey.frame.crs_from_local(places)[:, :2] for places in (found.points, found.poses.centres))
    part_of_point = np.full(len(points), -1)
    part_of_point[found.residuals.point] = number_of[found.residuals.view]
    figure, axes = canvas.map_canvas(
        canvas.extent_around(np.concatenate([points, cameras]), crs, _BESIDE), crs, below_in=0.5
    )
    for part in range(int(number_of.max()) + 1):
        colour, of_part = SERIES[part % len(SERIES)], number_of == part
        label = f"part {part + 1}: {int(of_part.sum())} photographs"
        axes.plot(*points[part_of_point == part].T, ".", ms=1.5, color=colour, alpha=0.4, zorder=3)
        axes.plot(*cameras[of_part].T, "o", ms=5.0, mfc=colour, mec="white", mew=0.6, label=label, zorder=5)
    if (number_of < 0).any():
        axes.plot(*cameras[number_of < 0].T, "x", ms=5.0, color=INK, label="without points", zorder=5)
    _draw_control(axes, survey, found)
    figure.legend(loc="lower center", ncols=3, frameon=False, fontsize=9)
    title = "Parts of the block without common points"
    subtitle = "dots: tie points of each part; no tie point belongs to two parts"
    return canvas.finished(axes, path, title, subtitle, "Only positions, control and water connect the parts.")


def _draw_control(axes: Axes, survey: Survey, found: Adjustment) -> None:
    control = survey.observations.control
    places = {} if control is None else {point.name: point.crs[:2] for point in control.points}
    for is_check, colour, mark, label in ((False, RED, "^", "control point"), (True, BLUE, "s", "check point")):
        rows = [places[row.name] for row in found.control if row.is_check == is_check]
        if rows:
            axes.plot(*np.array(rows).T, mark, ms=6.5, mfc=colour, mec="white", mew=0.8, label=label, zorder=6)


def draw_correlation(path: Path, found: Adjustment) -> canvas.Picture:
    """Correlations of the parameters of water and lenses."""
    names, matrix = correlations(found)
    labels = []
    for name in names:
        lens, _, last = name.rpartition(".")
        # Of a lens its number only where there are several.
        own = f"{last} ({lens.removeprefix('camera')})" if len(found.lenses) > 1 else last
        labels.append(_LABELS.get(name, own))
    side = 1.6 + 0.42 * len(names)
    figure, axes = canvas.canvas(side + 0.9, side)
    image = axes.imshow(matrix, cmap=DIFFERENCES, norm=Normalize(-1.0, 1.0))
    axes.set_xticks(range(len(names)), labels, rotation=55, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), labels, fontsize=8)
    for row, column in np.ndindex(matrix.shape):
        value = float(matrix[row, column])
        colour = "white" if abs(value) >= _STRONG else INK
        if row != column:
            axes.text(column, row, number(value, 2), ha="center", va="center", fontsize=6.5, color=colour)
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)
    canvas.colour_bar(axes, image, "correlation", extend="neither")
    canvas.write_title(axes, "Correlation of water and lens")
    canvas.save(figure, path)
    words = (
        "Near 1 or -1 the photographs do not separate the two: each is only as good as the given value of the other."
    )
    return canvas.Picture(path, "Correlation of the parameters", words)


@dataclass(frozen=True)
class Residual:
    """A control or check point with its residual."""

    name: str
    place: tuple[float, float]  # (easting, northing), in crs
    off_m: tuple[float, float, float]  # (east, north, up) [m]: NaN where it is not known
    is_check: bool


def residuals_of(
    survey: Survey, adjustment: Adjustment | None, checkpoints: CheckpointAccuracy | None
) -> list[Residual]:
    """Control points by the adjustment, and check points by it, else by the height of the cloud."""
    given = survey.observations.control
    control = {} if given is None else {point.name: point for point in given.points}
    found = {
        row.name: Residual(row.name, control[row.name].crs[:2], row.residual_m, row.is_check)
        for row in (() if adjustment is None else adjustment.control)
    }
    for row in () if checkpoints is None else checkpoints.rows:
        if row.name not in found and row.difference_m is not None:
            off = (math.nan, math.nan, row.difference_m)
            found[row.name] = Residual(row.name, (row.easting, row.northing), off, True)
    return list(found.values())


def draw_residuals(path: Path, survey: Survey, residuals: Sequence[Residual]) -> canvas.Picture:
    """Residuals of points: an arrow for the plan, and one along the map's north for the height."""
    crs = survey.frame.crs
    places = np.array([each.place for each in residuals])
    off = np.array([each.off_m for each in residuals])
    unit_m = ground_units_m(crs, places[0])
    extent = canvas.extent_around(places, crs, _MARGIN)
    figure, axes = canvas.map_canvas(extent, crs, below_in=0.5)
    axes.set_facecolor("white")
    distances = np.sqrt(np.nansum(off**2, axis=1))
    off, longest, is_far = clip_outliers(off)
    times = _LONGEST * (extent[1] - extent[0]) * unit_m[0] / longest
    in_plan = np.isfinite(off[:, 0])
    up = np.column_stack([np.zeros(len(off)), off[:, 2]])
    style = {"width": 0.006, "zorder": 4}
    _arrows(axes, places[in_plan], times * off[in_plan, :2] / unit_m, color=BLUE, label="residual in plan", **style)
    label = "residual in height, up drawn northwards"
    _arrows(axes, places, times * up / unit_m, color=RED, label=label, **style)
    is_check = np.array([each.is_check for each in residuals])
    for part, mark, colour, label in ((~is_check, "^", INK, "control point"), (is_check, "s", LAND, "check point")):
        if part.any():
            axes.plot(*places[part].T, mark, ms=6.0, mfc=colour, mec=INK, mew=0.8, label=label, zorder=5)
    cut = [f" (shortened: {length(distance)})" if far else "" for far, distance in zip(is_far, distances, strict=True)]
    checks = np.flatnonzero(is_check)
    named = [*np.flatnonzero(~is_check).tolist(), *checks[np.argsort(-distances[checks])[:MOST_ROWS]].tolist()]
    canvas.write_labels(axes, places[named], [f"{residuals[i].name}{cut[i]}" for i in named])
    figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    unit = LengthUnit.of([longest])
    subtitle = f"magnified: an arrow an eighth as long as the map is wide means {unit.text(longest)}"
    words = "The adjusted point less the given one; of check points without marks, the height of the cloud less theirs."
    return canvas.finished(axes, path, "Control and check points", subtitle, words)


def clip_outliers(off: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Residuals (N, 3) [m] with outliers clipped, the length [m] of the longest arrow, and the outliers (N,) bool.

    Outliers set no scale for the arrows of the others.
    """
    in_all = np.sqrt(np.nansum(off**2, axis=1))
    is_far = in_all > _FAR * np.median(in_all)
    near = off if is_far.all() else off[~is_far]
    longest = canvas.nice_limit(np.concatenate([np.hypot(near[:, 0], near[:, 1]), near[:, 2]]))
    share = np.minimum(_CUT * longest / np.maximum(in_all, 1e-9), 1.0)
    return np.where(is_far[:, None], off * share[:, None], off), longest, is_far


def draw_plan(path: Path, facts: ReportFacts) -> canvas.Picture:
    """Cameras with footprints and directions of view, bed under water, dry ground and bounds, in plan."""
    survey, cameras = facts.survey, [view.camera for view in facts.survey.views]
    crs, centres = survey.frame.crs, survey.frame.crs_from_local(np.array([c.centre for c in cameras]))[:, :2]
    if len(facts.bed):
        ground = median(facts.bed.xyz[:, 2])
    else:
        ground = float(np.median([camera.centre[2] for camera in cameras])) - facts.plan.height_m
    footprints = [survey.frame.crs_from_local(_footprint(camera, survey, ground))[:, :2] for camera in cameras]
    bounds = np.reshape(() if survey.bounds is None else survey.bounds, (-1, 2))
    extent = canvas.extent_around(np.concatenate([*footprints, centres, bounds]), crs, 0.025)
    figure, axes = canvas.map_canvas(extent, crs, below_in=0.5)
    axes.set_facecolor("white")
    if len(facts.bed):
        grid = PlanGrid.over(facts.points_crs, crs, max_cells=_PLAN_CELLS)
        count, is_wet = grid.count(), 2 * grid.count(facts.bed.wet)
        is_wet = is_wet >= np.maximum(count, 1)
        for part, colour, label in ((is_wet, WATER, "bed under water"), ((count > 0) & ~is_wet, LAND, "dry ground")):
            if part.any():
                canvas.show(axes, np.where(part[..., None], to_rgba(colour), (0.0, 0.0, 0.0, 0.0)), grid.extent)
                axes.plot([], [], "s", ms=9.0, color=colour, label=label)
    outline = to_rgba(INK, min(0.4, max(0.08, 0.4 * _FEW_OUTLINES / len(cameras))))
    axes.add_collection(PolyCollection(footprints, facecolors="none", edgecolors=outline, lw=0.7))
    headers = [facts.headers.get(view.name) for view in survey.views]
    # One clock for all.
    times = [None if header is None else header.taken for header in headers]
    if None in times:
        times = [None if header is None else header.clock for header in headers]
    if seconds := [time.timestamp() for time in times if time is not None and None not in times]:
        lines = flight_lines(np.array(seconds), centres)
        axes.add_collection(LineCollection(list(lines), colors=SOFT, lw=0.9, zorder=4, label="flight line"))
    unit_m = ground_units_m(crs, centres[0])
    longer_m = max((extent[1] - extent[0]) * unit_m[0], (extent[3] - extent[2]) * unit_m[1])
    looks = np.array([camera.cam_from_local[2] for camera in cameras])
    is_oblique = np.degrees(np.arccos(np.clip(-looks[:, 2], -1.0, 1.0))) > _OBLIQUE_DEG
    lines = np.stack([centres, centres + looks[:, :2] * _LOOK * longer_m / unit_m], axis=1)[is_oblique]
    axes.add_collection(LineCollection(list(lines), colors=OBLIQUE, lw=1.2, zorder=5))
    for part, colour, label in ((~is_oblique, INK, "camera"), (is_oblique, OBLIQUE, "camera, oblique")):
        if part.any():
            axes.plot(*centres[part].T, "o", ms=4.5, mfc=colour, mec="white", mew=0.6, label=label, zorder=6)
    if survey.bounds is not None:
        e0, n0, e1, n1 = survey.bounds
        frame = Rectangle((e0, n0), e1 - e0, n1 - n0, fill=False, ec=BOUNDS, lw=1.6, ls="--", zorder=4)
        frame.set_label("bounds")
        axes.add_patch(frame)
    figure.legend(loc="lower center", ncols=3, frameon=False, fontsize=9)
    over = "the ground"
    if (water := survey.config.water) is not None:
        slope = math.hypot(water.slope_east, water.slope_north)
        rises = f", which rises by {100.0 * slope:.2g} %" if slope else ""
        over = f"the water at {height(water.known_level_m)}{rises}"
    subtitle = f"{len(cameras)} views, {distance(facts.plan.height_m)} over {over}"
    return canvas.finished(
        axes, path, "The flight in plan", subtitle, f"Outlines: what each photograph covers on {over}."
    )


def flight_lines(seconds: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Segments (K, 2, 2) between successive cameras (N, 2) at times (N,) [s]; none across a pause."""
    order = np.argsort(seconds, kind="stable")
    along, gaps = centres[order], np.diff(seconds[order])
    return np.stack([along[:-1], along[1:]], axis=1)[gaps <= _PAUSE * np.median(gaps)]


def _footprint(camera: PinholeCamera, survey: Survey, ground: float) -> np.ndarray:
    """Border (N, 3) of an image on the water, or on level ground; local.

    Rays flatter than 1 in 4 are taken as falling 1 in 4. Pixels outside the field of the lens are left out.
    """
    rays = camera.directions(camera.outline())
    rays = rays[np.isfinite(rays).all(axis=1)]
    normal, over = np.array([0.0, 0.0, 1.0]), float(camera.centre[2]) - ground
    if survey.water is not None:
        normal, over = np.array(survey.water.up), -float(survey.water.depth(camera.centre))
    return camera.centre + rays * (over / np.maximum(-rays @ normal, 0.25))[:, None]
