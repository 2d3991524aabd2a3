"""Maps of the bed: colour, depth and standard deviation, the bed in one photograph, and where no bed was found."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, LightSource, LogNorm, Normalize, to_rgba
from matplotlib.patches import Patch
from scipy import ndimage

from fields.sweep.maps import HeightMap
from geo.crs import height_unit_m
from survey.display import canvas
from survey.display.palette import (
    COUNTS,
    DEPTHS,
    DIFFERENCES,
    DRY_GROUND,
    EMPTY,
    HEIGHTS,
    INK,
    OBLIQUE,
    RED,
    SOFT,
    SPREADS,
    WATER,
)
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import LengthUnit, length, share
from survey.photos.images import load_image
from survey.report.facts import ReportFacts
from survey.report.profile import Cut, draw_line
from survey.report.seen_cells import REASONS, cells_of
from survey.water.wave_surfaces import WaveSurfaces
from survey.words import figure_text

# The most pixels of a height map along its longer side.
_PIXELS = 2000
_OF_SOLVER = "from the normal matrix of the solver"
_OF_SWEEP = "from the spread of the views that agree around it and the curvature of the bed"
# Codes of cells with their colours, in the order of `REASONS`; 0 is what no view sees.
_HAS_POINT, _OF_REASONS = (
    255,
    (OBLIQUE, SOFT, "#f2c230", "#8a4f7d", "#e3b7c6", "#c56a8a", "#24427a", RED, "#4b8b6f", INK),
)
_COLOURS = {_HAS_POINT: WATER} | dict(zip(REASONS, (*_OF_REASONS, RED), strict=True))
# Arrows of displacements, about.
_MOST_ARROWS = 800
# Pixels of the map of cells without a bed, along its longer side at most.
_UNSEEN_PIXELS = 900
_LEGEND_COLUMNS = 4


def draw_orthophoto(path: Path, facts: ReportFacts, grid: PlanGrid) -> canvas.Picture:
    """The cloud in its colours, in plan, the highest point of each cell on top."""
    colours = without_pinholes(grid.highest(facts.points_crs[:, 2], facts.bed.rgb))
    known = np.isfinite(colours[..., 0])
    image = np.zeros((*known.shape, 4), dtype=np.uint8)
    image[known, :3], image[known, 3] = colours[known], 255
    axes = _show(image, facts, grid)
    subtitle = f"the cloud in its own colours, cells of {length(grid.side_m)}"
    words = "The cloud in its own colours; where points lie above each other, the highest."
    return canvas.finished(axes, path, "The bed from above", subtitle, words)


def draw_surface(path: Path, facts: ReportFacts, grid: PlanGrid, cut: Cut | None) -> canvas.Picture:
    """Depth below the water in plan, or height in a dry survey, shaded by the relief; with the line of a cut."""
    height = without_pinholes(grid.mean(facts.points_crs[:, 2])) * height_unit_m(facts.survey.frame.crs)
    depth, title, label = None, "Height of the ground", f"height [{LengthUnit.of_heights().name}]"
    words = "Mean height of each cell, shaded by the relief."
    if facts.survey.water is not None:
        depth = without_pinholes(grid.mean(facts.bed.depth, facts.bed.wet))
        depth[2 * grid.count(facts.bed.wet) < grid.count()] = np.nan
        title = "Depth of the bed"
        ground = "" if facts.bed.wet.all() else "; dry ground in greys"
        words = f"Mean true depth of each cell, shaded by the relief{ground}."
    image, scale = shaded_bed(depth, height, grid.side_m)
    axes = _show(image, facts, grid)
    if cut is not None:
        draw_line(axes, facts, cut)
    axes.set_facecolor("white")  # the grey of other maps' gaps is that of dry ground here
    _bar(axes, scale, label, is_depth=depth is not None)
    return canvas.finished(axes, path, title, f"cells of {length(grid.side_m)}", words)


def draw_num_views(path: Path, facts: ReportFacts, grid: PlanGrid) -> canvas.Picture:
    """Mean number of views that agree, in plan."""
    values = without_pinholes(grid.mean(facts.bed.num_views))
    top = max(4, int(np.nanquantile(values, 0.99)) + 1)
    steps = np.arange(1, top + 1, max(1, top // 10))
    scale = ScalarMappable(BoundaryNorm(np.append(steps, steps[-1] + 1), 256), COUNTS)
    axes = _show(image_of(values, scale), facts, grid)
    canvas.colour_bar(axes, scale, "views", extend="max").minorticks_off()
    words = "Number of views that see a point at the same height; the more, the more reliable."
    return canvas.finished(axes, path, "Views that agree", f"mean of each cell of {length(grid.side_m)}", words)


def draw_std(path: Path, facts: ReportFacts, grid: PlanGrid) -> canvas.Picture:
    """Random standard deviation of the heights, in plan."""
    values = without_pinholes(grid.mean(facts.bed.std))
    known = values[np.isfinite(values)]
    # By ratio: beside walls it is a hundred times as large as on open ground.
    low, middle, high = np.maximum(np.quantile(known, (0.01, 0.5, 0.99)), 1e-6) if known.size else (1e-3, 1e-3, 1e-3)
    unit = LengthUnit.of([middle])
    scale = ScalarMappable(LogNorm(low * unit.per_metre, max(high, 1.1 * low) * unit.per_metre), SPREADS)
    axes = _show(image_of(values * unit.per_metre, scale), facts, grid)
    bar = canvas.colour_bar(axes, scale, f"standard deviation [{unit.name}]")
    canvas.plain_log_ticks(bar.ax.yaxis)
    source = _OF_SOLVER if facts.plan.solves else _OF_SWEEP
    words = f"Random part for each point, {source}; without the part common to all heights by water, lens and poses."
    subtitle = f"mean of each cell of {length(grid.side_m)}"
    return canvas.finished(axes, path, "Standard deviation of the height", subtitle, words)


def draw_view(path: Path, facts: ReportFacts, height_maps: Sequence[HeightMap]) -> canvas.Picture:
    """A photograph next to its height map, shown as depths."""
    # That with the most pixels that another view confirms.
    height_map = height_maps[int(np.argmax([np.count_nonzero(each.agreeing) for each in height_maps]))]
    view = facts.survey.views[height_map.view]
    share_confirmed = float((height_map.agreeing > 0).mean())
    # Large maps are subsampled: matplotlib takes some 100 bytes per pixel.
    every = -(-max(height_map.height.shape) // _PIXELS)
    thin = np.s_[::every, ::every]
    rows, columns = height_map.height[thin].shape
    scale_of_map = columns / view.camera.width
    height = np.where(height_map.agreeing[thin] > 0, height_map.height[thin], np.nan).astype(np.float64)
    depth = None if facts.survey.water is None else np.where(height < 0.0, -height, np.nan)
    image, scale = shaded_bed(depth, height, facts.plan.gsd_m * facts.plan.image_scale / scale_of_map)

    figure = canvas.empty_figure(11.0, max(2.5, 4.9 * rows / columns + 0.45))
    left, right = figure.subplots(1, 2)
    left.imshow(load_image(view, scale=min(scale_of_map, 1.0)))
    right.imshow(image, interpolation="nearest")
    right.set_facecolor(EMPTY)
    for axes in (left, right):
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    left.set_title(figure_text(view.name), loc="left", color=INK, fontsize=12, weight="bold")
    name = "height" if depth is None else "true depth along its rays"
    right.set_title(f"Its depth map: {name}", loc="left", color=INK, fontsize=12, weight="bold")
    label = f"height over the local origin [{LengthUnit.of_heights().name}]"
    _bar(right, scale, label, is_depth=depth is not None)
    canvas.save(figure, path)
    words = f"Another view confirms {share(share_confirmed)} of the pixels; the others are left grey."
    return canvas.Picture(path, "A photograph and its depth map", words)


def draw_waves(path: Path, facts: ReportFacts, surfaces: WaveSurfaces) -> canvas.Picture:
    """The surface of the water, without its tilt, in the photograph where it has the largest std, in plan."""
    surface = max((each.without_tilt() for each in surfaces.over(facts.bed.xyz)), key=lambda each: each.std)
    limit = canvas.nice_limit(surface.height)
    unit = LengthUnit.of([limit])
    end = limit * unit.per_metre
    scale = ScalarMappable(Normalize(-end, end), DIFFERENCES)
    _, axes = canvas.map_canvas(surface.grid.extent, facts.survey.frame.crs)
    canvas.show(axes, image_of(surface.height * unit.per_metre, scale), surface.grid.extent)
    canvas.colour_bar(axes, scale, f"height of the water [{unit.name}]")
    words = (
        "The roughest of all photographs, where its rays to the bed cross the water, without its tilt, which an error "
        "of the pose is, too."
    )
    subtitle = f"{figure_text(surface.name)}, standard deviation {length(surface.std)}"
    return canvas.finished(axes, path, "Surface of the water in a photograph", subtitle, words)


def draw_wave_shifts(path: Path, facts: ReportFacts, surfaces: WaveSurfaces) -> canvas.Picture:
    """How the photograph that waves displace most shows the bed displaced, before and after its surface was found."""
    place, before, after = surfaces.shifts_in_crs(_MOST_ARROWS)
    # In metres, whatever the unit of the CRS.
    rms, left = (float(np.sqrt(np.mean(surfaces.shifts[:, k : k + 2] ** 2))) for k in (2, 4))
    unit, (low, high) = LengthUnit.of([rms]), (limit(place, axis=0) for limit in (np.min, np.max))
    _, axes = canvas.map_canvas((float(low[0]), float(high[0]), float(low[1]), float(high[1])), facts.survey.frame.crs)
    # An arrow of two standard deviations spans the distance to the next.
    apart = np.sqrt(np.prod(high - low) / len(place))
    scale = 2.0 * np.sqrt(np.mean(before**2)) / apart
    for shift, colour, width in ((before, OBLIQUE, 0.002), (after, INK, 0.003)):
        axes.quiver(*place.T, *shift.T, color=colour, width=width, angles="xy", scale_units="xy", scale=scale)
    words = (
        "Displacements of cells of the bed against the other photographs, less what heights explain: light as over "
        "still water, dark with the surface that was found. An arrow an eighth as long as the map is wide means "
        f"{unit.text(2.0 * rms / apart * np.ptp(axes.get_xlim()) / 8.0)}."
    )
    subtitle = (
        f"{figure_text(surfaces.shown)}, {unit.number(rms)} {unit.name} before and {unit.number(left)} {unit.name} "
        "after, along an axis"
    )
    return canvas.finished(axes, path, "Residual shifts of a photograph", subtitle, words)


def _bar(axes: Axes, scale: ScalarMappable, label: str, *, is_depth: bool) -> None:
    """A bar of the colours of lengths [m] in the unit of heights; depths grow downwards."""
    unit = LengthUnit.of_heights()
    low, high = scale.get_clim()
    shown = ScalarMappable(Normalize(low * unit.per_metre, high * unit.per_metre), scale.get_cmap())
    bar = canvas.colour_bar(axes, shown, f"true depth below the water [{unit.name}]" if is_depth else label)
    if is_depth:
        bar.ax.invert_yaxis()


def _show(image: np.ndarray, facts: ReportFacts, grid: PlanGrid) -> Axes:
    """An image (rows, columns, 4) uint8 of a grid, in axes in crs and true to scale."""
    _, axes = canvas.map_canvas(grid.extent, facts.survey.frame.crs)
    canvas.show(axes, image, grid.extent)
    return axes


def draw_unseen(path: Path, facts: ReportFacts) -> canvas.Picture:
    """Ground with points, and without, by the reason."""
    survey = facts.survey
    cells = cells_of(survey, facts.bed.xyz, facts.plan.gsd_m) if facts.cells is None else facts.cells
    codes, seen = np.where(cells.has_point, _HAS_POINT, cells.gaps), cells.num_views >= 2
    missing = float(np.mean(~cells.has_point[seen])) if seen.any() else 0.0
    grid, shown = cells.in_crs(codes, survey.frame, _UNSEEN_PIXELS)
    named = [(code, REASONS.get(code, "has points").partition(":")[0]) for code in _COLOURS if (codes == code).any()]
    figure, axes = canvas.map_canvas(grid.extent, survey.frame.crs, below_in=0.3 * -(-len(named) // _LEGEND_COLUMNS))
    colours = np.full((256, 4), to_rgba(EMPTY))
    colours[list(_COLOURS)] = [to_rgba(colour) for colour in _COLOURS.values()]
    canvas.show(axes, np.rint(255.0 * colours).astype(np.uint8)[shown], grid.extent)
    figure.legend(
        handles=[Patch(color=_COLOURS[code], label=f"{name}, {share(np.mean(codes[cells.num_views > 0] == code))}")
                 for code, name in named],
        loc="lower center", ncols=_LEGEND_COLUMNS, frameon=False, fontsize=8,
    )  # fmt: skip
    words = (
        "Ground without a point, by the reason that most of the photographs give; shares are of the ground that "
        "photographs look at. Nothing is filled in there."
    )
    subtitle = f"{share(missing)} of the ground that two or more views see"
    return canvas.finished(axes, path, "Where no bed was found, and why", subtitle, words)


def without_pinholes(raster: np.ndarray) -> np.ndarray:
    """A raster (rows, columns, ...) whose single empty cells have the mean of their neighbours.

    A cell is single where at least five of the eight cells around it are filled; larger gaps stay.
    """
    known = np.isfinite(raster if raster.ndim == 2 else raster.sum(axis=-1))
    around = np.ones((3, 3, *(1,) * (raster.ndim - 2)))
    shape = (*known.shape, *(1,) * (raster.ndim - 2))
    is_known = known.reshape(shape)
    filled = ndimage.convolve(is_known.astype(np.float64), around, mode="constant")
    total = ndimage.convolve(np.where(is_known, raster, 0.0).astype(np.float64), around, mode="constant")
    single = ~is_known & (filled > 4.5)
    return np.where(single, total / np.where(single, filled, 1.0), raster).astype(raster.dtype)


def hillshade(height: np.ndarray, cell_m: float) -> np.ndarray:
    """Light on a relief (rows, columns) [m] from the north-west, float32, 0 to 1; 0.5 where level or unknown.

    The relief is exaggerated so that its steeper parts stand at about 45 degrees: it shows form, not slope.
    """
    known = np.isfinite(height)
    if min(height.shape) < 2 or not known.any():
        return np.full(height.shape, 0.5, dtype=np.float32)
    weight = ndimage.gaussian_filter(known.astype(np.float32), 1.0)
    # About their mean, heights have all digits in single precision.
    relief = np.where(known, height - height[known].mean(), 0.0).astype(np.float32)
    smooth = ndimage.gaussian_filter(relief, 1.0) / np.maximum(weight, 1e-9)
    south, east = np.gradient(smooth, cell_m)
    # Beyond the edge of what is known, the ratio above is meaningless.
    inner = known & (weight > 0.6)
    slope = np.hypot(south, east)
    steep = float(np.quantile(slope[inner], 0.9)) if inner.any() else 0.0
    exaggeration = min(1.0 / steep, 20.0) if steep > 1e-9 else 1.0
    length = np.sqrt(1.0 + (exaggeration * slope) ** 2)
    # Light from the north-west at 45 degrees: east -1/2, north 1/2, up 1/sqrt(2).
    light = (0.5 * exaggeration * (east + south) + math.sqrt(0.5)) / length
    return np.where(inner, np.clip(0.5 + 0.6 * (light - math.sqrt(0.5)), 0.0, 1.0), np.float32(0.5))


def image_of(values: np.ndarray, scale: ScalarMappable) -> np.ndarray:
    """Values (rows, columns) in the colours of a scale (rows, columns, 4) uint8, transparent where NaN."""
    return scale.to_rgba(np.ma.masked_invalid(values), bytes=True)


def shaded_bed(depth: np.ndarray | None, height: np.ndarray, cell_m: float) -> tuple[np.ndarray, ScalarMappable]:
    """A bed as an image (rows, columns, 4) uint8, transparent where unknown, and the scale of its colours.

    Depths (rows, columns) [m] below the water are NaN on dry ground, which is drawn in greys; None is a dry survey,
    coloured by height [m]. Cells are `cell_m` [m] apart, for the relief.
    """
    shade = hillshade(height, cell_m)
    if depth is None:
        return _coloured(height, shade, HEIGHTS)
    is_wet = np.isfinite(depth)
    image, scale = _coloured(depth, shade, DEPTHS)
    dry, _ = _coloured(np.where(is_wet, np.nan, height), shade, DRY_GROUND)
    return np.where(is_wet[..., None], image, dry), scale


def _coloured(values: np.ndarray, shade: np.ndarray, colours: Colormap) -> tuple[np.ndarray, ScalarMappable]:
    """Values (rows, columns) as an image (rows, columns, 4) uint8; the scale spans their inner 98 %."""
    known = np.isfinite(values)
    low, high = np.quantile(values[known], [0.01, 0.99]) if known.any() else (0.0, 1.0)
    scale = ScalarMappable(Normalize(low, high if high > low else low + 1e-3), colours)
    rgb = np.asarray(colours(scale.norm(np.where(known, values, low))))[..., :3]
    lit = np.clip(LightSource().blend_soft_light(rgb, shade[..., None]), 0.0, 1.0)
    return np.dstack([np.rint(255.0 * lit), np.where(known, 255, 0)]).astype(np.uint8), scale
