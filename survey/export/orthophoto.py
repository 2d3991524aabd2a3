"""The bed from above, through the water, from the photographs themselves.

The places of the bed in cells are projected into the photographs. A cell is hidden where a higher part of the bed falls
on the same pixel: cameras look from above, so that along a ray the higher point is the nearer one. Exposures are
compensated by means of cells that several photographs show. Views of similar steepness are blended.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from geo.compatibility import Reprojection
from geo.crs import height_unit_m, horizontal_crs
from geo.files import scratch_array
from geo.grid import Grid, Window
from geo.raster import RasterBand, RasterForm, write_cog
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.export.bed_raster import BedRaster, bed_raster, cells_over, round_side
from survey.export.loaded import LoadedRun, Photograph, at_scale, colours_without_water, flight_of
from survey.export.rasters import noted_if_empty
from survey.export.registry import ExportOptions, require_not_too_fine
from survey.progress import current
from survey.run.flight import Flight

WINDOW = 512
# A cell is hidden where the bed at its pixel is higher by this many cells.
_HIDDEN_CELLS = 3.0
# Side of the blocks of the height buffer, in cells of the bed: large enough to contain one each.
_BLOCK_CELLS = 1.5
# Most cells whose colours are compared, approximately, and iterations of the medians.
_COMPARED, _ROUNDS = 20_000, 6
# Difference of the squared tangent of the angle off the vertical over which one view blends into another.
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
    mosaic, without_water = Mosaic.empty(cells, run.scratch), colours_without_water(run)
    coarse = BedPlaces(flight, grid.cells, grid.heights, run.scratch / "places-of-heights")
    fine = BedPlaces(flight, cells, lambda window: _heights(grid, cells, window), run.scratch / "places-of-colours")
    with current().stage("Orthophoto", 2.0 * len(photographs)) as stage:
        cell_px = grid.cells.side_m / grid.pixel_m * scale
        buffers = [HeightBuffer.of(p.camera, coarse, cell_m=grid.cells.side_m, cell_px=cell_px) for p in photographs]
        factors = common_exposure(photographs, buffers, coarse, stage.advance)
        for photograph, buffer, factor in zip(photographs, buffers, factors, strict=True):
            pixels, camera = photograph.pixels(), photograph.camera
            for window, points, uv in fine.seen_by(camera):
                uv = buffer.visible(points, uv)
                colour = pixels.at(uv[..., 0], uv[..., 1]) * factor
                seen = np.isfinite(colour[..., 0])
                if without_water is not None and flight.water is not None:
                    depth = flight.level(points[..., :2]) - points[..., 2]
                    wet = seen & (depth > 0.0)
                    cosine = -(camera.directions(uv[wet]) @ np.array(flight.water.up))
                    incidence = np.arccos(np.clip(cosine, -1.0, 1.0))
                    colour[wet] = without_water(colour[wet], depth[wet], incidence)
                mosaic.add(window, np.where(seen, log_weight(points, uv, camera), np.nan), colour)
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


class BedPlaces:
    """The places of the bed in the cells of a raster, in a file.

    `heights` gives those (rows, columns) [m] of a window, NaN where there is none.
    """

    def __init__(self, flight: Flight, cells: Grid, heights: Callable[[Window], np.ndarray], file: Path):
        self._water, self._points = flight.water, scratch_array(file, "f4", (*cells.shape, 3))
        # Windows in which the bed has a height, and the corners (8, 3) of the boxes around it.
        self._boxes: dict[Window, np.ndarray] = {}
        own = cells.crs.equals(flight.frame.crs)
        back = None if own else Reprojection.between(cells.crs, flight.frame.crs)
        for window in cells.windows(WINDOW):
            height = heights(window)
            known, points = np.isfinite(height), np.full((*height.shape, 3), np.nan)
            if known.any():
                places = np.column_stack([cells.middles(window)[known], height[known] / height_unit_m(cells.crs)])
                points[known] = flight.frame.local_from_crs(places if back is None else back(places))
                ends = np.stack([points[known].min(axis=0), points[known].max(axis=0)], axis=1)
                self._points[window.slices], self._boxes[window] = points, np.array(list(product(*ends)))

    def some(self, most: int) -> np.ndarray:
        """About so many of the places (K, 3) [m], local, spread evenly over them."""
        every = max(-(-sum(int(self._is_known(window).sum()) for window in self._boxes) // most), 1)
        parts = [self._points[window.slices][self._is_known(window)][::every] for window in self._boxes]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def _is_known(self, window: Window) -> np.ndarray:
        return np.isfinite(self._points[window.slices][..., 2])

    def pixels_of(self, points: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """Pixels (..., 2) of places (..., 3) [m], local; NaN for those that the camera does not see."""
        uv = camera.project(points.reshape(-1, 3), self._water)
        return np.where(camera.sees(uv)[:, None], uv, np.nan).reshape(*points.shape[:-1], 2)

    def seen_by(self, camera: PinholeCamera) -> Iterator[tuple[Window, np.ndarray, np.ndarray]]:
        """The windows of which a camera may see something, with their places (rows, columns, 3) and `pixels_of`."""
        size = np.array([camera.width, camera.height])
        for window, corners in self._boxes.items():
            around = camera.project(corners, self._water)
            # Comparisons with NaN, of corners that the camera does not see at all, are False.
            if not ((around < 0.0).all(axis=0) | (around > size).all(axis=0)).any():
                points = self._points[window.slices].astype(np.float64)
                yield window, points, self.pixels_of(points, camera)


@dataclass(frozen=True)
class HeightBuffer:
    """The highest bed in each block of a photograph's pixels."""

    height: np.ndarray  # (rows, columns) [m]: -inf where there is none
    block: float  # [px]: side
    allowed: float  # [m]: by so much a cell may lie lower and be seen

    @staticmethod
    def of(camera: PinholeCamera, bed: BedPlaces, *, cell_m: float, cell_px: float) -> HeightBuffer:
        """The height buffer of a camera, for cells of the bed with sides of `cell_m` [m], `cell_px` in its image."""
        block = max(_BLOCK_CELLS * cell_px, 1.0)
        highest = np.full((int(camera.height / block) + 1, int(camera.width / block) + 1), -np.inf)
        buffer = HeightBuffer(highest, block, _HIDDEN_CELLS * cell_m)
        for _, points, uv in bed.seen_by(camera):
            seen, place = buffer._block_of(uv)
            np.maximum.at(highest, tuple(at[seen] for at in place), points[..., 2][seen])
        return buffer

    def visible(self, points: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of places (..., 3) [m], local; NaN where something hides them."""
        seen, place = self._block_of(uv)
        seen &= np.where(seen, points[..., 2], -np.inf) >= self.height[place] - self.allowed
        return np.where(seen[..., None], uv, np.nan)

    def _block_of(self, uv: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Cells in the photograph, and the row and column of their blocks."""
        seen = np.isfinite(uv[..., 0])
        blocks = (np.where(seen[..., None], uv, 0.0) / self.block).astype(np.int64)
        return seen, (blocks[..., 1], blocks[..., 0])


def common_exposure(
    photographs: list[Photograph], buffers: list[HeightBuffer], bed: BedPlaces, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) on the colours of V photographs that make them alike; they are 1 on average.

    `advance` is called after each photograph.
    """
    # OpenCV looks up less than 32,768 places of a row at a time.
    points = bed.some(_COMPARED)
    shown = np.full((len(photographs), len(points), 3), np.nan, dtype=np.float32)
    for number, photograph in enumerate(photographs):
        u, v = buffers[number].visible(points, bed.pixels_of(points, photograph.camera)).T
        shown[number] = np.log(np.maximum(photograph.pixels().at(u[None], v[None])[0], 1.0))
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


def log_weight(points: np.ndarray, uv: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Logarithm of the weight (...) of a view of points (..., 3): higher for steep rays, low at the border of it."""
    border = np.minimum(uv, (camera.width, camera.height) - uv).min(axis=-1)
    to_camera = camera.centre - points
    tan_squared = (to_camera[..., :2] ** 2).sum(axis=-1) / to_camera[..., 2] ** 2
    return -tan_squared / _FADING + np.log(np.clip(border / _BORDER_PX, 1e-3, 1.0))
