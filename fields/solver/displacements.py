"""Displacements of photographs against their mean in cells of solved tiles, and the surfaces that explain them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import ndimage, sparse

from fields.solver.gauss_newton import TileSolution, gradients_of
from fields.solver.tile import Brightness, SolverTile
from fields.solver.visibility import TileProjection
from fields.waves.surfaces import MORE_DRAWS, CellAdjustment, Displacements, find_surfaces
from fields.waves.waves import LEAST_DEPTH, Waves

# Side of the cells; surfaces have coefficients as far apart.
CELL_PX = 8
# Share of the pixels of a cell that are wanted, and share of these that a photograph has to show.
_FULL, _SEEN = 0.4, 0.6
# Observations with a smaller share of their weight left show something else: residuals of six times the noise.
_INLIER = 0.2
# Larger displacements are steps to another feature of the texture.
_LARGEST_PX = 2.5
# Least of what a step usually leaves, in variances of the noise: that of photographs without noise is rounding.
_LEAST_LEFT = 1e-6
_DEEP = 0.95  # Quantile of depths
# How wrong heights are is taken as alike within a Gauss window of this standard deviation, in cells.
_ALIKE_CELLS = 4.0


@dataclass(frozen=True)
class TileDisplacements:
    """Displacements of M pairs of a cell of a tile and a photograph, as in `fields.waves.surfaces.Displacements`."""

    cell: np.ndarray  # (M,) int
    view: np.ndarray  # (M,) int
    point: np.ndarray  # (M, 3) [m]: of the cell, in the frame of the water
    parallax: np.ndarray  # (M, 2)
    measured: np.ndarray  # (M, 2) [m]
    information: np.ndarray  # (M, 2, 2) [1/m^2]


def displacements_of(
    tile: SolverTile, found: TileProjection | TileSolution, brightness: Brightness
) -> TileDisplacements:
    """One linear step for each cell and photograph, from the gradients of the albedo and the residuals.

    With the residuals from the albedo of all, the same weights and a common shift that is free, that is the same as a
    step of all photographs and of the albedo together.
    """
    cells, ground = _Cells(tile, -found.ground.points[2] > LEAST_DEPTH), found.ground
    weight, residual = _without_outliers(brightness)
    gradient = gradients_of(tile, brightness.albedo)
    normal = np.array([[cells.sums(weight * one * other) for other in gradient] for one in gradient])
    normal = np.moveaxis(normal, (0, 1), (2, 3))
    right = np.stack([cells.sums(-weight * one * residual) for one in gradient], axis=-1)
    trace = np.trace(normal, axis1=2, axis2=3)
    slack = (1e-3 * trace + 1e-12)[..., None, None] * np.eye(2)
    step = np.linalg.solve(normal + slack, right[..., None])[..., 0]
    seen = cells.sums((weight > 0.0).astype(np.float32))
    known = (seen > _SEEN * cells.count) & (cells.count > _FULL * CELL_PX**2) & (trace > 0.0)
    known &= np.abs(step).max(axis=-1) < _LARGEST_PX
    known &= known.sum(axis=0) > 1
    # Where a step leaves more of the residuals than usual it led nowhere, as from too far: the weights of Geman and
    # McClure, or all other cells bend to it.
    left = (cells.sums(weight * residual * residual) - np.einsum("kca,kca->kc", step, right)) / np.maximum(seen, 1.0)
    usual = max(float(np.median(left[known])), _LEAST_LEFT) if known.any() else 1.0
    normal /= np.maximum(left / usual, 1.0)[..., None, None] ** 2
    view, cell = np.nonzero(known)
    point, per_pixel, motion = (
        cells.sums(each) / cells.count for each in (ground.points, ground.per_pixel, found.motion)
    )
    per_pixel = np.moveaxis(per_pixel, 2, 0)[cell]
    inverse = np.linalg.inv(per_pixel)
    return TileDisplacements(
        cell,
        np.array(found.views, dtype=int)[view],
        point.T[cell],
        -np.einsum("mab,mb->ma", per_pixel, motion.swapaxes(1, 2)[view, cell]),
        np.einsum("mab,mb->ma", per_pixel, step[view, cell]),
        np.einsum("mba,mbc,mcd->mad", inverse, normal[view, cell], inverse),
    )


def _without_outliers(brightness: Brightness) -> tuple[np.ndarray, np.ndarray]:
    """Weights and residuals (K, N) without outliers: robust weights would follow the displacements themselves."""
    inverse = 1.0 / brightness.noise[:, None] ** 2
    weight = np.where(brightness.weight > _INLIER * inverse, inverse, np.float32(0.0))
    residual = np.where(weight > 0.0, brightness.residual, np.float32(0.0))
    mean = (weight * residual).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
    return weight, np.where(weight > 0.0, residual - mean, np.float32(0.0))


class _Cells:
    """Squares of `CELL_PX` of a tile, with those of the wanted pixels that are in ``use`` (N,) bool."""

    def __init__(self, tile: SolverTile, use: np.ndarray):
        rows, columns = (place // CELL_PX for place in tile.places)
        self._use = np.flatnonzero(tile.requested & use)
        numbers, cell = np.unique((rows * len(tile) + columns)[self._use], return_inverse=True)
        count, ends = len(cell), np.arange(len(cell) + 1)
        self._sums = sparse.csr_matrix((np.ones(count, np.float32), cell, ends), shape=(count, len(numbers))).T
        self.count = np.bincount(cell, minlength=len(numbers))

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums (..., cells) of values (..., N)."""
        flat = values.reshape(-1, values.shape[-1]).take(self._use, axis=1)
        return (self._sums @ flat.T).T.reshape(*values.shape[:-1], len(self.count))


def moved(parts: Sequence[TileDisplacements]) -> float:
    """Standard deviation [m] of displacements along an axis, beyond their noise and what heights explain."""
    found = _together(parts)
    if not len(found["cell"]):
        return 0.0
    cells = CellAdjustment(found["cell"], found["parallax"], found["information"])
    measured = found["measured"].astype(np.float32)
    excess = float((measured * cells.left(cells.weighted(measured))).sum()) - cells.degrees_of_freedom
    free = cells.degrees_of_freedom / measured.size * np.trace(found["information"], axis1=1, axis2=2).sum()
    return float(np.sqrt(max(excess, 0.0) / max(free, 1e-12)))


def _together(parts: Sequence[TileDisplacements]) -> dict[str, np.ndarray]:
    """Displacements of several tiles by name, with cells of their own."""
    names = [each.name for each in fields(TileDisplacements)]
    found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    tile = np.repeat(np.arange(len(parts)), [len(part.cell) for part in parts])
    number = tile * (found["cell"].max(initial=0) + 1) + found["cell"]
    return found | {"cell": np.unique(number, return_inverse=True)[1]}


def waves_of(
    parts: Sequence[TileDisplacements],
    still: Waves,
    spacing: float,
    before: Waves | None = None,
    *,
    is_last: bool = True,
) -> Waves:
    """Surfaces of all photographs, with coefficients at a spacing [m], from displacements in tiles.

    ``still`` has the cameras; the displacements were measured against those by the surfaces ``before``. What is wrong
    with surfaces is drawn more often in the last round.
    """
    found = _together(parts)
    _, first = np.unique(found["cell"], return_index=True)
    view, point = found["view"], found.pop("point")
    crossing, by_height, by_gradient = (np.empty((len(view), *shape)) for shape in ((2,), (2,), (2, 2)))
    for each in np.unique(view):
        at = np.flatnonzero(view == each)
        places = point[at].T.astype(np.float32)
        rays = still.crossings(each, places)
        crossing[at], by_height[at] = rays.place.T, rays.by_height.T
        by_gradient[at] = rays.by_gradient.transpose(2, 0, 1)
        if before is not None:
            # The equations of all rounds are linear, in the surfaces as a whole.
            crossing[at] = (place := before.through(each, places)[0]).T
            found["measured"][at] += rays.displacement(*before.surface(each, place)).T
    displacements = Displacements(crossing=crossing, by_height=by_height, by_gradient=by_gradient, **found)
    posterior = find_surfaces(displacements, len(still.centres), spacing, MORE_DRAWS if is_last else 0)
    size = np.bincount(view, weights=(posterior.shifts[0] ** 2).sum(axis=1))
    shown = int(size.argmax())
    shifts = np.concatenate([point[:, :2], *posterior.shifts], axis=1)[view == shown]
    deep = float(np.quantile(still.tides[view] - point[:, 2], _DEEP))
    variances = _variances(point[first, :2], posterior.errors, spacing)
    return replace(still.with_surfaces(posterior, *variances, deep), shown=shown, shifts=shifts)


def _variances(place: np.ndarray, errors: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Variances (2, rows, columns) [m^2] of heights and places, by errors (draws, C, 3) of cells at places (C, 2) [m].

    With the place (2,) [m] of the first node; the nodes are at a spacing [m].
    """
    corner = place.min(axis=0)
    column, row = np.round((place - corner) / spacing).astype(int).T
    squares = (errors**2).mean(axis=0)
    sums = np.zeros((3, row.max() + 1, column.max() + 1))
    for total, values in zip(sums, (squares[:, 0], squares[:, 1:].mean(axis=1), np.ones(len(row))), strict=True):
        np.add.at(total, (row, column), values)
    sums = ndimage.gaussian_filter(sums, (0.0, _ALIKE_CELLS, _ALIKE_CELLS))
    near = ndimage.distance_transform_edt(sums[2] < 1e-3, return_distances=False, return_indices=True)
    return (sums[:2] / np.maximum(sums[2], 1e-9))[:, *near].astype(np.float32), corner
