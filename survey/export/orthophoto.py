"""The bed from above, through the water, from the photographs themselves.


The heights of the bed are projected into the photograph. A cell is hidden where a higher part of the bed falls on the
same pixel: cameras look from above, so that along a ray the higher point is the nearer one.

Exposures are compensated by means of cells that several photographs show.

Refraction is solved at every sixteenth cell and at three heights. Between these, linear interpolation in plan and
quadratic interpolation in height are accurate to a hundredth of a pixel.

Views of similar steepness are blended.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geo.crs import height_unit_m, horizontal_crs
from geo.files import scratch_array
from geo.grid import Grid, Window
from geo.raster import RasterBand, RasterForm, write_cog
from geo.reproject import Reprojection
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.export.bed_raster import BedRaster, bed_raster, cells_over, round_side
from survey.export.loaded import LoadedRun, Photograph, at_scale, colours_without_water, flight_of
from survey.export.rasters import noted_if_empty
from survey.export.registry import ExportOptions, require_not_too_fine
from survey.progress import current
from survey.run.flight import Flight

ColourOf = Callable[[np.ndarray, Window, np.ndarray, "CellProjection"], np.ndarray]

WINDOW = 512
_STEP = 16
# Heights of one window differ by this at least, so that there is a parabola through them [m].
_LEAST_RELIEF_M = 0.01
# A cell is hidden where the bed at its pixel is higher by this many cells.
_HIDDEN_CELLS = 3.0
# Side of the blocks of the height buffer, in cells of the bed: large enough to contain one each.
_BLOCK_CELLS = 1.5
# Most cells whose colours are compared, approximately, and iterations of the medians.
_COMPARED, _ROUNDS = 20_000, 6
# Difference of `CellProjection.tan_squared` over which one view blends into another.
_FADING = 0.004
# Width over which a photograph fades out at its border [px].
_BORDER_PX = 24.0
# Along the shorter side of a photograph at the resolution that is asked for.
_FEWEST_PX = 8


def write_orthophoto(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The mosaic of the photographs."""
    side_m = options.resolution_m or round_side(run.bed_header.gsd_m)
    mosaic = _mosaic(run, options, side_m)
    cells = mosaic.cells
    tags = {
        "COLOURS": "of the bed without its water" if run.is_true_colour else "as photographed, to a common exposure",
        "CELL_M": f"{side_m:g}",
    }
    bands = (RasterBand("red"), RasterBand("green"), RasterBand("blue"), RasterBand("seen"))
    crs = horizontal_crs(cells.crs)
    form = RasterForm(crs, cells.transform, cells.shape, bands, dtype="uint8", tags=tags, is_colour=True)
    parts = ((window.top, window.left, mosaic.rgba(window)) for window in cells.windows(WINDOW))
    write_cog(path, form, noted_if_empty(path, parts, 0, band=3))


def check_orthophoto(_path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError where a photograph is not there any more."""
    flight_of(run, options.survey)


def _mosaic(run: LoadedRun, options: ExportOptions, side_m: float) -> Mosaic:
    """The photographs on the bed, in cells of a side [m]."""
    require_not_too_fine(side_m, run.bed_header.gsd_m)
    grid = bed_raster(run, replace(options, resolution_m=None))
    if side_m > grid.cells.side_m:
        # Heights need larger cells than colours do, but not larger ones than are asked for.
        grid = bed_raster(run, options)
    flight = flight_of(run, options.survey)
    scale = min(1.0, grid.pixel_m / side_m)
    shortest = scale * min(min(view.camera.width, view.camera.height) for view in flight.views)
    if shortest < _FEWEST_PX:
        raise SurveyError(
            f"--resolution {side_m:g} (metres) is too coarse: at that size a photograph has {shortest:.1f} pixels "
            f"along its shorter side, expected at least {_FEWEST_PX}; give e.g. --resolution "
            f"{round_side(run.bed_header.gsd_m):g}"
        )
    photographs = at_scale(flight, scale)
    cells = cells_over(grid.cells.box, grid.cells.crs, side_m)
    mosaic, colour_of = Mosaic.empty(cells, run.scratch), _colour_of(run, grid, cells)
    coarse = BedWindows(flight, grid.cells, grid.heights)
    fine = BedWindows(flight, cells, lambda window: _heights(grid, cells, window))
    with current().stage("Orthophoto", 2.0 * len(photographs)) as stage:
        cell_px = grid.cells.side_m / grid.pixel_m * scale
        buffers = [HeightBuffer.of(p.camera, coarse, cell_m=grid.cells.side_m, cell_px=cell_px) for p in photographs]
        factors = common_exposure(photographs, buffers, coarse, stage.advance)
        for photograph, buffer, factor in zip(photographs, buffers, factors, strict=True):
            pixels = photograph.pixels()
            for window, height, projection in fine.projected_into(photograph.camera):
                seen = buffer.visible(projection, height)
                colour = pixels.at(seen.u, seen.v) * factor
                weight = np.where(np.isfinite(colour[..., 0]), log_weight(seen, photograph.camera), np.nan)
                mosaic.add(window, weight, colour_of(colour, window, height, seen))
            stage.advance()
    return mosaic


def _heights(grid: BedRaster, cells: Grid, window: Window) -> np.ndarray:
    """Heights (rows, columns) [m] of finer cells, linear between those of the bed's raster; NaN where it has none."""
    at = grid.cells.columns_rows(cells.middles(window).reshape(-1, 2))
    shape = grid.cells.shape
    own = np.clip(np.floor(at).astype(np.int64), 0, np.array(shape[::-1]) - 1)
    first = np.floor(at - 0.5).astype(np.int64)
    share = at - 0.5 - first
    total, weight = np.zeros(len(at)), np.zeros(len(at))
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.clip(first + step, 0, np.array(shape[::-1]) - 1).T
        part = np.where(step, share, 1.0 - share).prod(axis=1) * (grid.origin[row, column] > 0)
        total, weight = total + part * grid.height[row, column], weight + part
    known = (grid.origin[own[:, 1], own[:, 0]] > 0) & (weight > 0.0)
    return np.where(known, total / np.where(weight > 0.0, weight, 1.0), np.nan).reshape(window.shape)


def _colour_of(run: LoadedRun, grid: BedRaster, cells: Grid) -> ColourOf:
    """Function of the colours of a photograph that gives those of the mosaic: the same, or without the water."""
    without_water, level = colours_without_water(run), grid.level
    if without_water is None or level is None:
        return lambda colour, _window, _height, _seen: colour

    def dry(colour: np.ndarray, window: Window, height: np.ndarray, seen: CellProjection) -> np.ndarray:
        depth = level(cells.middles(window)) - height
        wet = np.isfinite(colour[..., 0]) & (depth > 0.0)
        incidence = np.arccos(np.clip(seen.cos_incidence[wet], -1.0, 1.0))
        colour[wet] = without_water(colour[wet], depth[wet], incidence)
        return colour

    return dry


@dataclass(frozen=True)
class CellProjection:
    """Projection of cells into a camera, (rows, columns) each; NaN where it does not see them."""

    # u, v: [px]
    u: np.ndarray
    v: np.ndarray
    cos_incidence: np.ndarray  # [-]: of the ray in air, to the normal of the water
    tan_squared: np.ndarray  # [-]: squared tangent of the angle of the straight line to the camera off the vertical

    def where(self, seen: np.ndarray) -> CellProjection:
        """The same where ``seen`` (rows, columns) bool, else NaN."""
        layers = (self.u, self.v, self.cos_incidence, self.tan_squared)
        return CellProjection(*(np.where(seen, layer, np.nan) for layer in layers))


class BedWindows:
    """The windows of a raster in which the bed has a height, ready to be looked up in photographs.

    `heights` gives those (rows, columns) [m] of a window, NaN where there is none; it is asked again for each
    photograph that shows it.
    """

    def __init__(self, flight: Flight, cells: Grid, heights: Callable[[Window], np.ndarray]):
        self._water, self._heights = flight.water, heights
        self._windows = []
        for window in cells.windows(WINDOW):
            height = heights(window)
            if np.isfinite(height).any():
                self._windows.append(_Knots.of(flight, cells, window, height))

    def heights(self) -> Iterator[tuple[Window, np.ndarray]]:
        """Each window with its heights."""
        for knots in self._windows:
            yield knots.window, self._heights(knots.window)

    def projected_into(self, camera: PinholeCamera) -> Iterator[tuple[Window, np.ndarray, CellProjection]]:
        """The windows of which a camera may see something, with their heights, and how it sees them."""
        for knots in self._windows:
            found = knots.seen_by(camera, self._water)
            if found is not None:
                height = self._heights(knots.window)
                yield knots.window, height, knots.at_cells(found, height, camera)


@dataclass(frozen=True)
class _Knots:
    """The knots of a window at which refraction is solved."""

    window: Window
    # middle, half [m]: the heights are ``middle - half``, ``middle``, ``middle + half``
    middle: float
    half: float
    # rows, columns (cells, knots): weights that interpolate between knots
    rows: np.ndarray
    columns: np.ndarray
    points: np.ndarray  # (3, knots, knots, 3) [m], local

    @staticmethod
    def of(flight: Flight, cells: Grid, window: Window, height: np.ndarray) -> _Knots:
        low, high = float(np.nanmin(height)), float(np.nanmax(height))
        middle, half = 0.5 * (low + high), max(0.5 * (high - low), 0.5 * _LEAST_RELIEF_M)
        # The first cell and the last are knots, too.
        rows, columns = (np.unique(np.append(np.arange(0, n, _STEP), [n - 1])) for n in window.shape)
        east = cells.origin[0] + (window.left + columns + 0.5) * cells.step[0]
        north = cells.origin[1] + (window.top + rows + 0.5) * cells.step[1]
        levels = np.array([middle - half, middle, middle + half]) / height_unit_m(cells.crs)
        points = np.stack(np.meshgrid(levels, north, east, indexing="ij")[::-1], axis=-1)
        across, along = _between(rows, window.shape[0]), _between(columns, window.shape[1])
        if not cells.crs.equals(flight.frame.crs):
            back = Reprojection.between(cells.crs, flight.frame.crs)
            points = back(points.reshape(-1, 3)).reshape(points.shape)
        return _Knots(window, middle, half, across, along, flight.frame.local_from_crs(points))

    def seen_by(self, camera: PinholeCamera, water: FlatWater | None) -> np.ndarray | None:
        """Values of `CellProjection` (4, 3, knots, knots) at the knots; None where certainly no cell is seen."""
        pixels, size = camera.project(self.points, water), np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            # A window is larger than a photograph where its cells are larger than pixels: then knots lie around it.
            known = np.isfinite(pixels).all(axis=-1)
            if not known.any() or (pixels[known].min(axis=0) > size).any() or (pixels[known].max(axis=0) < 0.0).any():
                return None
        up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
        cosine = -(camera.directions(np.where(known[..., None], pixels, 0.0)) @ up)
        to_camera = camera.centre - self.points
        tan_squared = (to_camera[..., :2] ** 2).sum(axis=-1) / to_camera[..., 2] ** 2
        return np.stack([pixels[..., 0], pixels[..., 1], cosine, tan_squared])

    def at_cells(self, found: np.ndarray, height: np.ndarray, camera: PinholeCamera) -> CellProjection:
        """Values at the cells, interpolated from the knots by their heights."""
        t = (height - self.middle) / self.half
        u, v, cosine, tan_squared = (self._parabola(values, t) for values in found)
        with np.errstate(invalid="ignore"):
            seen = (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        return CellProjection(u, v, cosine, tan_squared).where(seen)

    def _parabola(self, values: np.ndarray, t: np.ndarray) -> np.ndarray:
        below, middle, above = (self.rows @ level @ self.columns.T for level in values)
        return middle + 0.5 * (above - below) * t + (0.5 * (above + below) - middle) * t**2


def _between(knots: np.ndarray, count: int) -> np.ndarray:
    """Weights (count, knots) that interpolate linearly between knots."""
    return np.stack([np.interp(np.arange(count), knots, row) for row in np.eye(len(knots))], axis=1)


@dataclass(frozen=True)
class HeightBuffer:
    """The highest bed in each block of a photograph's pixels."""

    height: np.ndarray  # (rows, columns) [m]: -inf where there is none
    block: float  # [px]: side
    allowed: float  # [m]: by so much a cell may lie lower and be seen

    @staticmethod
    def of(camera: PinholeCamera, bed: BedWindows, *, cell_m: float, cell_px: float) -> HeightBuffer:
        """The height buffer of a camera, for cells of the bed with sides of `cell_m` [m], `cell_px` in its image."""
        block = max(_BLOCK_CELLS * cell_px, 1.0)
        highest = np.full((int(camera.height / block) + 1, int(camera.width / block) + 1), -np.inf)
        buffer = HeightBuffer(highest, block, _HIDDEN_CELLS * cell_m)
        for _, height, projection in bed.projected_into(camera):
            seen, place = buffer._block_of(projection)
            np.maximum.at(highest, tuple(at[seen] for at in place), height[seen])
        return buffer

    def visible(self, projection: CellProjection, height: np.ndarray) -> CellProjection:
        """Projection of the visible cells with these heights (rows, columns) [m]; NaN where something hides them."""
        seen, place = self._block_of(projection)
        return projection.where(seen & (np.where(seen, height, -np.inf) >= self.height[place] - self.allowed))

    def _block_of(self, projection: CellProjection) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Cells in the photograph, and the row and column of their blocks."""
        seen = np.isfinite(projection.u)
        rows, columns = (np.where(seen, at, 0.0) / self.block for at in (projection.v, projection.u))
        return seen, (rows.astype(np.int64), columns.astype(np.int64))


def common_exposure(
    photographs: list[Photograph], buffers: list[HeightBuffer], bed: BedWindows, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) on the colours of V photographs that make them alike; they are 1 on average.

    `advance` is called after each photograph.
    """
    known = {window: np.flatnonzero(np.isfinite(height)) for window, height in bed.heights()}
    # Rounded up: OpenCV looks up less than 32,768 places of a row at a time.
    step = max(-(-sum(len(at) for at in known.values()) // _COMPARED), 1)
    compared = {window: at[::step] for window, at in known.items()}
    first = dict(zip(compared, np.cumsum([0, *map(len, compared.values())]).tolist(), strict=False))
    shown = np.full((len(photographs), sum(map(len, compared.values())), 3), np.nan, dtype=np.float32)
    for number, photograph in enumerate(photographs):
        pixels = photograph.pixels()
        for window, height, projection in bed.projected_into(photograph.camera):
            at = compared[window]
            seen = buffers[number].visible(projection, height)
            colour = pixels.at(seen.u.ravel()[at][None], seen.v.ravel()[at][None])[0]
            shown[number, first[window] : first[window] + len(at)] = np.log(np.maximum(colour, 1.0))
        advance()
    return np.exp(-exposure_gains(shown))


def exposure_gains(shown: np.ndarray) -> np.ndarray:
    """Exposure gains (V, 3) in the logarithms of colours (V, K, 3), NaN where a photograph does not show a cell."""
    gain = np.zeros((len(shown), 3))
    shown = shown[:, np.isfinite(shown[..., 0]).sum(axis=0) >= 2]
    if not shown.shape[1]:
        return gain
    with warnings.catch_warnings():
        # Of photographs that share no cell with another.
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(_ROUNDS):
            bed = np.nanmedian(shown - gain[:, None], axis=0)
            gain = np.nan_to_num(np.nanmedian(shown - bed, axis=1))
            gain -= gain.mean(axis=0)
    return gain


@dataclass(frozen=True)
class Mosaic:
    """Sums over views in cells, in files; the highest weight of a cell is 1."""

    cells: Grid
    highest: np.ndarray  # (rows, columns) float32: logarithm of the highest weight; of no meaning where `weight` is 0
    weight: np.ndarray  # (rows, columns) float32
    colour: np.ndarray  # (rows, columns, 3) float32: sum of weighted colours, 0 to 255

    @staticmethod
    def empty(cells: Grid, folder: Path) -> Mosaic:
        """Mosaic without a colour; its files are made in a folder."""
        shapes = {"highest": cells.shape, "weight": cells.shape, "colour": (*cells.shape, 3)}
        files = {name: scratch_array(folder / f"mosaic-{name}", "f4", shape) for name, shape in shapes.items()}
        return Mosaic(cells, **files)

    def add(self, window: Window, log_weight: np.ndarray, colour: np.ndarray) -> None:
        """Add a view's colours (rows, columns, 3) with the logarithms of their weights; NaN is not seen."""
        at = window.slices
        seen = np.isfinite(log_weight)
        before, weight = self.highest[at], self.weight[at]
        new = np.where(seen, log_weight, -np.inf)
        old = np.where(weight > 0.0, before, -np.inf)
        highest = np.where(seen, np.maximum(old, new), np.where(weight > 0.0, before, 0.0))
        keep, own = np.exp(old - highest), np.exp(new - highest)
        self.weight[at] = keep * weight + own
        self.colour[at] = keep[..., None] * self.colour[at] + np.where(seen[..., None], own[..., None] * colour, 0.0)
        self.highest[at] = highest

    def rgba(self, window: Window) -> np.ndarray:
        """Colours with transparency (4, rows, columns) uint8 of a window."""
        weight = self.weight[window.slices]
        colour = self.colour[window.slices] / np.where(weight > 0.0, weight, 1.0)[..., None]
        stored = np.clip(np.round(colour), 0, 255).astype(np.uint8)
        return np.concatenate([np.moveaxis(stored, -1, 0), np.where(weight > 0.0, 255, 0).astype(np.uint8)[None]])


def log_weight(projection: CellProjection, camera: PinholeCamera) -> np.ndarray:
    """Logarithm of the weight (rows, columns) of a view: higher for steep rays, low at the border of the image."""
    u, v = projection.u, projection.v
    border = np.minimum(np.minimum(u, camera.width - u), np.minimum(v, camera.height - v))
    return -projection.tan_squared / _FADING + np.log(np.clip(border / _BORDER_PX, 1e-3, 1.0))
