"""Registration of a block to the dry ground of an earlier survey: robust point to plane, iterated with the adjustment.

Tie points over the ground lie on it, each on the plane through the points around it, to the scatter of these
(`evaluation.vertical`). So the ground determines height and tilt of the block, scale by its extent, and its place
in plan where it is not flat. Whether a tie point is dry follows from the earlier survey, whose heights count from the
datum of crs, and not from the block, which may lie metres off. Tie points off their plane by more than others (what
grew, was washed away or built) are left out. Of each square one point counts, so that their errors are independent. The
shift that all points of the earlier survey share is a parameter with a prior (`survey.adjust.block.problem`), so that
control and positions that are known better than the earlier survey determine the datum of the block and this shift.

First the block is shifted onto the ground: from the best of many places on a grid in plan, by least squares with robust
weights. Positions are known to some metres in plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.spatial.transform import Rotation

from evaluation.summary import std_by_median
from evaluation.vertical import local_surface
from survey.adjust.block.bundle import Solution
from survey.adjust.block.normal_equations import System, system_with
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.block.problem import Planes, Problem
from survey.control.points import StableGround
from survey.display.quantities import length
from survey.errors import ControlError
from survey.photos.cameras import View

NAMES = ("east_m", "north_m", "up_m", "turn_east_deg", "turn_north_deg", "turn_up_deg", "scale_ppm")
_UNITS = np.array([1.0, 1.0, 1.0, math.degrees(1.0), math.degrees(1.0), math.degrees(1.0), 1e6])
# Sides of the squares, in spacings of the ground's points, and squares along the longer side at most.
_SPACINGS, _MOST_SQUARES = 3.0, 30
# Distances beyond so many robust standard deviations, and at least so many of their own, are of ground that changed.
_CHANGED = 3.0
# Planes known that much worse than most do not count.
_ROUGH = 4.0
# Fewer points hold no block.
LEAST_GROUND_POINTS = 12
# No plane is known better.
_LEAST_STD_M = 0.002
# Of the start: standard deviation of positions in plan [m], starts along each axis, and how many of them are followed.
_PLAN_STD_M = 3.0
_STARTS_M = np.arange(-5.0, 5.1, 0.5)
_MOST_STARTS, _STEPS = 10, 12
_MOST_NODES = 20_000
_STEADY_M = 1e-3
_AXES = ("east", "north", "up")
# The ground determines a part of the transformation whose std it lowers to this share.
_DETERMINED_SHARE = 0.7
# On ground that did not change, less of it does, and tie points scatter by less.
_MOST_CHANGED, _MOST_SCATTER = 0.5, 3.0
# In standard deviations of what was said of the reference.
_MOST_OFF = 3.0


@dataclass(frozen=True)
class GroundTies:
    """Tie points over the ground of an earlier survey, with its planes under them."""

    planes: Planes
    # over, changed (M,) bool: points over the ground; those of them that are left out
    over: np.ndarray
    changed: np.ndarray
    scatter: float  # By how much more than the ground's own points they scatter about it; 1 at least


def ties_on_ground(ground: StableGround, points: np.ndarray, num_ties: int) -> GroundTies:
    """Planes of the ground under points (M, 3) [m], less the shift of the ground.

    The first ``num_ties`` are tie points, the others control.
    """
    normal, height, std, spacing = _planes_at(ground, points[:, :2])
    known = np.isfinite(height) & np.isfinite(normal).all(axis=1) & (np.arange(len(points)) < num_ties)
    off = np.where(known, np.einsum("mi,mi->m", normal, points) - height, np.nan)
    if known.sum() < LEAST_GROUND_POINTS:
        raise ControlError(
            f"{int(known.sum())} tie points lie over the dry ground of [control] reference, expected at least "
            f"{LEAST_GROUND_POINTS}; give a reference that covers dry ground in the photographs, or leave it out"
        )
    std = np.maximum(std, _LEAST_STD_M)
    # At steps of the ground no plane fits.
    known &= std <= _ROUGH * np.median(std[known])
    scaled = off[known] / std[known]
    scatter = max(float(std_by_median(scaled - np.median(scaled))), 1.0)
    std = std * scatter
    good = known & (np.abs(off - np.median(scaled) * std / scatter) <= _CHANGED * std)
    used = _one_of_each_square(points, good, std, spacing)
    precision = np.where(used, std**-2.0, 0.0)
    planes = Planes(np.where(used[:, None], normal, 0.0), np.where(used, height, 0.0), np.where(used, precision, 0.0))
    return GroundTies(planes, known, known & ~good, scatter)


def _planes_at(ground: StableGround, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Normals (N, 3), heights along them (N,), their std (N,) at places (N, 2), and the spacing of the ground [m]."""
    surface = local_surface(ground.points, places)
    if not np.isfinite(surface.spacing_m):
        return np.full((len(places), 3), np.nan), surface.height, surface.std, np.nan
    sides = surface.spacing_m * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    around = local_surface(ground.points, (places[:, None] + sides).reshape(-1, 2)).height.reshape(-1, 4)
    slope = (around[:, ::2] - around[:, 1::2]) / (2.0 * surface.spacing_m)
    normal = np.column_stack([-slope, np.ones(len(places))])
    return normal, surface.height - np.einsum("ni,ni->n", slope, places), surface.std, surface.spacing_m


def _one_of_each_square(points: np.ndarray, good: np.ndarray, std: np.ndarray, spacing: float) -> np.ndarray:
    """Mask (M,) of the points that count: of each square the one whose plane is known best."""
    used = np.zeros(len(points), dtype=bool)
    rows = np.flatnonzero(good)
    if not len(rows):
        return used
    side = max(_SPACINGS * spacing, float(np.ptp(points[rows, :2], axis=0).max()) / _MOST_SQUARES)
    rows = rows[np.argsort(std[rows], kind="stable")]
    _, first = np.unique(np.floor(points[rows, :2] / side), axis=0, return_index=True)
    used[rows[first]] = True
    return used


def shift_onto(ground: StableGround, points: np.ndarray) -> np.ndarray:
    """Shift (3,) [m] that puts tie points (M, 3) [m] onto the ground."""
    low, high = ground.points[:, :2].min(axis=0) - _PLAN_STD_M, ground.points[:, :2].max(axis=0) + _PLAN_STD_M
    near = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
    # Some hundreds determine a shift as well as all.
    near = near[:: max(len(near) // 400, 1)]
    found = []
    if len(near) >= LEAST_GROUND_POINTS:
        planes = _PlanesOnGrid.around(ground, near)
        starts = np.stack(np.meshgrid(_STARTS_M, _STARTS_M), axis=-1)
        costs = np.array([[_cost(planes, near, start) for start in row] for row in starts])
        # The best places of a wide valley would leave none for others.
        is_least = np.isfinite(costs) & (costs <= minimum_filter(costs, 3, mode="nearest"))
        least = starts[is_least][np.argsort(costs[is_least], kind="stable")[:_MOST_STARTS]]
        found = [_descend(planes, near, start) for start in least]
    best = min((each for each in found if each is not None), key=lambda each: each[0], default=None)
    if best is None:
        raise ControlError(
            "no tie points lie over the dry ground of [control] reference; give a reference that covers dry ground in "
            "the photographs, in the crs of the survey, or leave it out"
        )
    return best[1]


@dataclass(frozen=True)
class _PlanesOnGrid:
    """Planes of the ground at the nodes of a grid, each for what lies nearest: to try many shifts quickly."""

    low: np.ndarray
    side: float
    shape: tuple[int, int]
    normal: np.ndarray
    height: np.ndarray

    @staticmethod
    def around(ground: StableGround, points: np.ndarray) -> _PlanesOnGrid:
        """Around points (M, 3), as far as starts and their descents lead."""
        reach = float(_STARTS_M.max()) + _PLAN_STD_M
        low, high = points[:, :2].min(axis=0) - reach, points[:, :2].max(axis=0) + reach
        area = float(np.prod(np.ptp(ground.points[:, :2], axis=0)))
        spacing = math.sqrt(max(area, 1e-6) / len(ground.points))
        side = max(spacing, math.sqrt(float(np.prod(high - low)) / _MOST_NODES))
        columns, rows = (np.ceil((high - low) / side).astype(np.int64) + 1).tolist()
        x, y = np.meshgrid(low[0] + side * np.arange(columns), low[1] + side * np.arange(rows))
        nodes = np.column_stack([x.ravel(), y.ravel()])
        surface = local_surface(ground.points, nodes)
        by_row, by_column = np.gradient(surface.height.reshape(rows, columns), side)
        normal = np.column_stack([-by_column.ravel(), -by_row.ravel(), np.ones(len(nodes))])
        height = surface.height + np.einsum("ni,ni->n", normal[:, :2], nodes)
        return _PlanesOnGrid(low, side, (rows, columns), normal, height)

    def at(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals (N, 3) and heights along them (N,) at places (N, 2); NaN where there is no ground."""
        column, row = np.round((places - self.low) / self.side).astype(np.int64).T
        inside = (row >= 0) & (column >= 0) & (row < self.shape[0]) & (column < self.shape[1])
        node = np.where(inside, row * self.shape[1] + column, 0)
        return self.normal[node], np.where(inside, self.height[node], np.nan)


def _cost(planes: _PlanesOnGrid, points: np.ndarray, shift: np.ndarray) -> float:
    """Cost of a shift in plan (2,), with that in height which suits most points; infinite without ground."""
    normal, height = planes.at(points[:, :2] + shift)
    off = np.einsum("mi,mi->m", normal, points + np.array([*shift, 0.0])) - height
    off = off[np.isfinite(off)]
    return np.inf if len(off) < LEAST_GROUND_POINTS else _cost_of(off - np.median(off), len(points), shift)


def _cost_of(off: np.ndarray, count: int, shift: np.ndarray) -> float:
    """Cost of distances (K,) [m] of those of so many points that lie over ground, and of a shift in plan."""
    scale = max(float(std_by_median(off)), _LEAST_STD_M)
    # Few points over the ground may fit anywhere.
    return math.log(scale) + math.log(count / len(off)) + float(shift[:2] @ shift[:2]) / (40.0 * _PLAN_STD_M**2)


def _descend(planes: _PlanesOnGrid, points: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Cost and shift (3,) where a start in plan (2,) leads; None where too few points lie over the ground."""
    shift = np.array([*start, 0.0])
    best: tuple[float, np.ndarray] | None = None
    for _ in range(_STEPS):
        moved = points + shift
        normal, height = planes.at(moved[:, :2])
        known = np.isfinite(height) & np.isfinite(normal).all(axis=1)
        if known.sum() < LEAST_GROUND_POINTS:
            break
        normal = normal[known]
        off = np.einsum("mi,mi->m", normal, moved[known]) - height[known]
        # Where ground has changed to one side only, the median is biased, if less than the mean.
        shift[2] -= float(np.median(off))
        off -= np.median(off)
        cost = _cost_of(off, len(points), shift)
        if best is None or cost < best[0]:
            best = cost, shift.copy()
        scale = max(float(std_by_median(off)), _LEAST_STD_M)
        weight = np.maximum(1.0 - (off / (_CHANGED * scale)) ** 2, 0.0) ** 2 / scale**2
        matrix = (normal * weight[:, None]).T @ normal + np.diag([_PLAN_STD_M**-2.0, _PLAN_STD_M**-2.0, 0.0])
        right = -(normal * weight[:, None]).T @ off - np.array([*shift[:2] / _PLAN_STD_M**2, 0.0])
        change = np.linalg.solve(matrix, right)
        shift = shift + change
        if np.abs(change).max() < _STEADY_M:
            break
    return best


@dataclass(frozen=True, kw_only=True)
class GroundFit:
    """Fit of an adjusted block to the dry ground of an earlier survey."""

    # num_points, num_over, num_changed: Tie points that hold the block, one of each square of ground; all over the
    # ground; those where it changed
    num_points: int
    num_over: int
    num_changed: int
    rms_m: float  # Of the vertical distances of the points that hold it
    scatter: float  # By how much more than the ground's own points tie points scatter about it
    std: tuple[float, ...]  # Of each of `NAMES`: how well the place of the block is known
    std_without: tuple[float, ...] | None  # The same without the ground; None where nothing else holds the block
    # off_m, off_std_m, off_prior_m (east, north, up) [m]: by how much all of the earlier survey is off, as control and
    # positions tell: as it is given less as it was found; how well that is known, and how well it was before
    off_m: tuple[float, ...]
    off_std_m: tuple[float, ...]
    off_prior_m: tuple[float, ...]
    reference: str  # File of the earlier survey
    moved: tuple[float, ...]  # Of each of `NAMES`: by how much, from where poses and positions had it
    is_against_positions: bool  # Whether it contradicts positions of a stated accuracy

    @property
    def is_determined_by_ground(self) -> tuple[bool, ...]:
        """Parts of the transformation that the ground determines."""
        without = (math.inf,) * len(self.std) if self.std_without is None else self.std_without
        return tuple(std <= _DETERMINED_SHARE * before for std, before in zip(self.std, without, strict=True))

    @property
    def notes(self) -> tuple[str, ...]:
        """The placement in a sentence."""
        axes = _along_axes(self.moved, self.std)
        undetermined = [
            name.rsplit("_", 1)[0].replace("_", " about ")
            for name, is_determined in zip(NAMES, self.is_determined_by_ground, strict=True)
            if not is_determined
        ]
        remarks = f"; it does not determine {', '.join(undetermined)}" if undetermined else ""
        determined = np.array(self.off_std_m) <= _DETERMINED_SHARE * np.array(self.off_prior_m)
        if determined.any():
            off = np.array(_along_axes(self.off_m, self.off_std_m))[determined]
            remarks += f"; all of {self.reference} is off by {', '.join(off)}, as control and positions show"
        return (
            f"placed on {self.num_points} points of the dry ground of {self.reference}, to {length(self.rms_m)} rms: "
            f"moved by {', '.join(axes)}{remarks}",
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about ground that changed, or contradicts the positions."""
        share = self.num_changed / max(self.num_over, 1)
        parts = [
            f"{self.reference} lies {length(value)} (± {length(std)}) further {axis} than control and positions place "
            f"it, and [control] reference_std_m says {length(prior)}: check its datum and theirs, or give a larger "
            "reference_std_m"
            for value, std, prior, axis in zip(self.off_m, self.off_std_m, self.off_prior_m, _AXES, strict=True)
            if abs(value) > _MOST_OFF * prior
        ]
        if share > _MOST_CHANGED:
            parts.append(
                f"{100.0 * share:.0f} % of the tie points over the ground of {self.reference} do not fit it: it has "
                "changed, or is another place; give polygons of stable ground in [control] stable"
            )
        if self.scatter > _MOST_SCATTER:
            parts.append(
                f"tie points over the ground of {self.reference} scatter about it {self.scatter:.1f} times as much as "
                "its own points: it may be another place or time; look at the bank in the cloud, give positions good "
                "to a few metres, or polygons of stable ground in [control] stable"
            )
        if self.is_against_positions:
            moved = " / ".join(length(value) for value in self.moved[:3])
            parts.append(
                f"{self.reference} places the block {moved} (east / north / up) from where the positions place it, "
                "more than their stated accuracies allow; the reference is used: check its datum, and those of the "
                "positions and crs"
            )
        return tuple(parts)


def _along_axes(values: tuple[float, ...], stds: tuple[float, ...]) -> list[str]:
    """East, north and up with their standard deviations, in words."""
    return [f"{length(v)} {axis} (± {length(std)})" for v, std, axis in zip(values, stds, _AXES, strict=False)]


def ground_fit(
    on_ground: GroundTies,
    problem: Problem,
    solution: Solution,
    before: Sequence[View],
    reference: str,
    *,
    is_against_positions: bool,
) -> GroundFit:
    """Shift, turn and scale of a block against the ground; ``before`` has the poses that it came with."""
    of_shift, covariance = problem.layout.shift, solution.covariance
    planes, points = on_ground.planes, solution.state.points
    used = planes.precision > 0.0
    middle = points[used].mean(axis=0)
    alone = replace(problem, priors=replace(problem.priors, planes=None))
    system = system_with(alone, solution.state, solution.weights)
    try:
        without = _in_units(_std_of_block(system, points, middle, system.normal.inverse))
    except np.linalg.LinAlgError:
        without = None
    return GroundFit(
        num_points=int(used.sum()),
        num_over=int(on_ground.over.sum()),
        num_changed=int(on_ground.changed.sum()),
        rms_m=float(np.sqrt(np.mean(planes.distances(points, solution.state.shift)[used] ** 2))),
        scatter=on_ground.scatter,
        std=_in_units(_std_of_block(solution.system, points, middle, covariance)),
        std_without=without,
        off_m=tuple((-solution.state.shift).tolist()),
        off_std_m=tuple(np.sqrt(np.diag(covariance)[of_shift]).tolist()),
        off_prior_m=tuple(problem.priors.std[of_shift].tolist()),
        reference=reference,
        moved=_moved_by(before, solution, middle),
        is_against_positions=is_against_positions,
    )


def _in_units(values: np.ndarray) -> tuple[float, ...]:
    """Shift [m], turn [rad] and scale less one (7,) in the units of `NAMES`."""
    return tuple((values * _UNITS).tolist())


def _std_of_block(system: System, points: np.ndarray, middle: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (7,) of shift, turn and scale of the points (M, 3) about a middle, as these follow."""
    x, y, z = (points - middle).T
    zero, one = np.zeros(len(points)), np.ones(len(points))
    design = np.stack(
        [
            np.stack([one, zero, zero, zero, z, -y, x], axis=-1),
            np.stack([zero, one, zero, -z, zero, x, y], axis=-1),
            np.stack([zero, zero, one, y, -x, zero, z], axis=-1),
        ],
        axis=1,
    )
    fit = np.linalg.pinv(design.reshape(-1, 7)).reshape(7, len(points), 3)
    pulled = np.einsum("kmi,mji->kmj", fit, system.point_root).reshape(7, -1)
    follow = -system.coupling.transposed_times(pulled.T).T
    return np.sqrt(propagated_variance(follow, covariance))


def _moved_by(before: Sequence[View], solution: Solution, middle: np.ndarray) -> tuple[float, ...]:
    """Motion of a block, as `NAMES`: its shift is that at the middle (3,) of the points that hold it."""
    state = solution.state
    centres = np.array([view.camera.centre for view in before])
    rotations = np.array([view.camera.cam_from_local for view in before])
    turns = Rotation.from_matrix(state.rotations.transpose(0, 2, 1) @ rotations)
    turn = Rotation.from_rotvec(np.median(turns.as_rotvec(), axis=0))
    was, now = centres - centres.mean(axis=0), state.centres - state.centres.mean(axis=0)
    turned = turn.apply(was)
    scale = float(np.sum(turned * now) / max(float(np.sum(turned * turned)), 1e-12))
    middle_before = centres.mean(axis=0) + turn.inv().apply(middle - state.centres.mean(axis=0)) / scale
    return _in_units(np.array([*(middle - middle_before), *turn.as_rotvec(), scale - 1.0]))
