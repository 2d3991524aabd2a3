"""Observations of an adjustment: feature matches, windows and marks of control points, as one set, thinned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from refract.lens import Lens, affine_from_brown, brown_from_affine, distorted, is_affine, undistorted
from survey.adjust.block.prediction import apparent_rise_design
from survey.adjust.block.priors import PriorKnowledge, priors_for
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import State, is_held
from survey.control.points import Control, StableGround
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints

PixelMap = Callable[[Lens, np.ndarray], np.ndarray]
Sizes = Sequence[tuple[int, int]]  # (width, height) [px] of each photograph
# Kinds of observations, each with a standard deviation of its own.
MATCH, WINDOW, MARK = range(3)
KINDS = ("matches", "windows", "marks")
# Of marks set by hand [px], where no control says it.
MARKS_STD_PX = 0.5
# How many points an adjustment takes: of each of so many cells along a photograph, so many.
CELLS, PER_CELL = 8, 3


@dataclass(frozen=True)
class Observed:
    """Tie points of all kinds."""

    ties: TiePoints
    kind: np.ndarray  # (N,) int64: `MATCH`, `WINDOW` or `MARK`, of each observation
    # (M, 3) [m]: of the points that are known beforehand, at `TiePoints.start`; infinite for all others
    point_std: np.ndarray
    control: tuple[str, ...]  # Names of the control points, which come last
    sizes: Sizes
    marks_std_px: float = MARKS_STD_PX  # [px]: of the marks
    ground: StableGround | None = None  # On which dry tie points lie

    def only(self, keep: np.ndarray) -> Observed:
        """The kept observations (N,) bool, without points that then have too few."""
        first_control = len(self.ties) - len(self.control)
        count = np.bincount(self.ties.point[keep], minlength=len(self.ties))
        known = np.isfinite(self.point_std).all(axis=1)
        enough = count >= np.where(known, 1, np.where(np.arange(len(count)) >= first_control, 2, self.ties.least))
        keep = keep & enough[self.ties.point]
        number = np.cumsum(enough) - 1
        ties = replace(
            self.ties,
            start=self.ties.start[enough],
            point=number[self.ties.point[keep]],
            view=self.ties.view[keep],
            pixel=self.ties.pixel[keep],
        )
        control = tuple(name for name, kept in zip(self.control, enough[first_control:], strict=True) if kept)
        return replace(self, ties=ties, kind=self.kind[keep], point_std=self.point_std[enough], control=control)

    @property
    def given_std_px(self) -> np.ndarray:
        """Standard deviations (kinds,) [px] that are given: that of marks; NaN for those that the block shows."""
        given = np.full(len(KINDS), np.nan)
        given[MARK] = self.marks_std_px
        return given

    def problem(self, prior: PriorKnowledge, state: State) -> Problem:
        """Their adjustment from a state, with priors."""
        rise_design = apparent_rise_design(state, self.ties)
        rows = original_rows(self.ties, prior.lenses, prior.layout.lens_of)
        priors = priors_for(prior, self.ties, self.point_std)
        return Problem(prior.layout, self.ties, self.kind, priors, self.given_std_px, rise_design, rows)

    def at(self, points: np.ndarray) -> Observed:
        """The same with other approximate points (M, 3); those of control stay."""
        known = np.isfinite(self.point_std)
        return replace(self, ties=replace(self.ties, start=np.where(known, self.ties.start, points)))


def observed(
    parts: list[tuple[int, TiePoints]], control: Control | None, survey: Survey, prior: PriorKnowledge
) -> Observed:
    """All observations, parts of one kind each, in pixels that Brown's lens of the adjustment predicts."""
    if control is not None and control.points:
        parts = [*parts, (MARK, _marks(control, survey))]
    ties = TiePoints.together([replace(ties, pixel=_straightened(ties, prior)) for _, ties in parts])
    kind = np.concatenate([np.full(len(ties.view), kind) for kind, ties in parts])
    point_std = np.full((len(ties), 3), np.inf)
    names: tuple[str, ...] = ()
    if control is not None and control.points:
        names = tuple(point.name for point in control.points)
        point_std[len(ties) - len(names) :] = [
            np.full(3, np.inf) if point.is_check else np.asarray(point.std) for point in control.points
        ]
    if names and prior.common_up_std > 0.0:
        # Check points, at the height of the nearest tie point in plan.
        start, first = ties.start.copy(), len(ties) - len(names)
        start[first:, 2] = start[cKDTree(start[:first, :2]).query(start[first:, :2])[1], 2]
        ties = replace(ties, start=start)
    marks_std_px = MARKS_STD_PX if control is None else control.marks_std_px
    return Observed(ties, kind, point_std, names, sizes_of(survey), marks_std_px, survey.observations.ground)


def sizes_of(survey: Survey) -> Sizes:
    """Sizes (width, height) [px] of the photographs."""
    return tuple((view.lens.width, view.lens.height) for view in survey.views)


def _marks(control: Control, survey: Survey) -> TiePoints:
    """The marks of control points as tie points, in order of points."""
    view = {view.name: number for number, view in enumerate(survey.views)}
    point = {found.name: number for number, found in enumerate(control.points)}
    rows = sorted((point[mark.point], view[mark.view], mark.pixel) for mark in control.marks)
    return TiePoints(
        np.array([found.local for found in control.points], dtype=np.float64),
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2] for row in rows], dtype=np.float64),
    )


def original_rows(ties: TiePoints, lenses: Sequence[Lens], lens_of: np.ndarray) -> np.ndarray:
    """Rows (N,) [px] of photographs as they were taken, of tie points in pixels that the adjustment predicts."""
    return original_pixels(ties, lenses, lens_of)[:, 1]


def original_pixels(ties: TiePoints, lenses: Sequence[Lens], lens_of: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of photographs as they were taken, of tie points in pixels that the adjustment predicts."""
    return _by_lens(ties, lenses, lens_of, affine_from_brown, distorted)


def _straightened(ties: TiePoints, prior: PriorKnowledge) -> np.ndarray:
    """Pixels (N, 2) as they are; of held lenses those of their pinhole, of affine ones those of Brown's part."""

    def to_pinhole(lens: Lens, pixel: np.ndarray) -> np.ndarray:
        return undistorted(lens, pixel) * lens.focal + (lens["cx"], lens["cy"])

    return _by_lens(ties, prior.lenses, prior.layout.lens_of, brown_from_affine, to_pinhole)


def _by_lens(
    ties: TiePoints, lenses: Sequence[Lens], lens_of: np.ndarray, of_affine: PixelMap, of_held: PixelMap
) -> np.ndarray:
    """Pixels (N, 2) with those of affine lenses and of lenses that the adjustment holds mapped."""
    pixels = ties.pixel.copy()
    for number, lens in enumerate(lenses):
        at = lens_of[ties.view] == number
        if at.any() and (is_affine(lens) or is_held(lens)):
            pixels[at] = (of_affine if is_affine(lens) else of_held)(lens, pixels[at])
    return pixels


def thinned(ties: TiePoints, sizes: Sizes, cells: int, per_cell: int) -> np.ndarray:
    """Tie-point thinning: numbers of the points (K,) to keep, ascending; long tracks first, spread evenly.

    A block of 30 photographs has some 10,000 matches in each. Neighbours share errors of waves, relief and lens, so
    that a few hundred, well spread, determine a photograph as well as all of them: points are taken until each of so
    many cells along the longer side of a photograph has so many, or all that it has.
    """
    if not len(ties):
        return np.zeros(0, dtype=np.int64)
    size = np.array(sizes, dtype=np.float64)[ties.view]
    side = size.max(axis=1) / cells
    across = np.ceil(size[:, 0] / side)
    column, row = np.floor(ties.pixel / side[:, None]).T
    _, cell = np.unique(np.column_stack([ties.view, row * across + column]), axis=0, return_inverse=True)
    cell = cell.ravel()
    have = np.zeros(cell.max() + 1, dtype=np.int64)
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    length = np.diff(first)
    keep = []
    # Of equally long tracks in order of a fixed shuffle: those of pycolmap come photograph by photograph.
    shuffle = np.random.default_rng(0).permutation(len(ties))
    for point in shuffle[np.argsort(-length[shuffle], kind="stable")]:
        cells_of_point = cell[first[point] : first[point + 1]]
        if (have[cells_of_point] < per_cell).any():
            have[cells_of_point] += 1
            keep.append(point)
    return np.sort(np.array(keep, dtype=np.int64))
