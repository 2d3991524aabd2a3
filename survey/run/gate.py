"""The quality gate of a run.

Three things are required. Of the ground that two or more views see, at the height where the bed was found, at least
half has a point: what one view alone sees cannot be measured and does not count. The median standard deviation of the
points by matching and given poses, without that of the datum by GPS or control, which no photograph improves, is at
most one and a half ground sampling distances. The total standard deviation of a height, including what all share by
water, lens and poses, is at most the same, or what IHO S-44's strictest order allows in shallow water (0.15 m at 95 %)
where that is more: a level read to some centimetres is no failure of a low flight.

A standard deviation or a time that was asked for is required, too.
"""

from dataclasses import dataclass, replace

import numpy as np

from fields.sweep.bed import BedPoints
from survey.display.plan_grid import median
from survey.display.quantities import NO_BREAK, length, share
from survey.folder.survey import Survey
from survey.plan.choices import MAX_STD_GSD, STD_QUANTILE, Choices, max_height_std
from survey.report.facts import Gate, RunVerdict, height_std
from survey.report.seen_cells import SeenCells, cells_of
from survey.run.stored import StoredBed

MIN_COVERED_SHARE = 0.5
MIN_VIEWS = 2
# Side of the cells in which a standard deviation that was asked for is required [ground sampling distances].
_CELL_GSD = 10.0
# Places that fewer views see than this have too few heights to average.
_FEW_VIEWS = 4.0


def verdict_of(survey: Survey, stored: StoredBed, gsd_m: float, cells: SeenCells | None = None) -> RunVerdict:
    """Verdict of the gates on the points of a bed at a ground sampling distance [m], with its `cells_of` if known."""
    cells = cells_of(survey, stored.bed.xyz, gsd_m) if cells is None else cells
    seen = cells.num_views >= MIN_VIEWS
    covered = float((cells.has_point & seen).sum() / seen.sum()) if seen.any() else 0.0
    completeness = (
        f"{share(covered)} of the ground that two or more views see has a point of the bed; "
        f"required: at least {share(MIN_COVERED_SHARE)}"
    )
    std, limit = median(stored.std_of_photographs()), MAX_STD_GSD * gsd_m
    precision = (
        f"the median standard deviation of the points is {length(std)}; required: at most {length(limit)} "
        f"({MAX_STD_GSD:g}{NO_BREAK}ground sampling distances)"
    )
    return RunVerdict(
        (
            _gate("ground with a point", 100.0 * covered, 100.0 * MIN_COVERED_SHARE, "%", completeness, at_least=True),
            _gate("median standard deviation", 1000.0 * std, 1000.0 * limit, "mm", precision),
            _whole(survey, stored, gsd_m),
        )
    )


def _gate(name: str, value: float, limit: float, unit: str, sentence: str, *, at_least: bool = False) -> Gate:
    return Gate(name, value, limit, unit, value >= limit if at_least else value <= limit, sentence)


def _whole(survey: Survey, stored: StoredBed, gsd_m: float) -> Gate:
    """Total standard deviation of a height, as `height_std_m` in report.json."""
    std, limit = height_std(stored.bed.std, stored.std_common), max_height_std(gsd_m)
    parts = f"{length(std.random)} random"
    if std.shared is not None:
        parts = f"{length(std.shared)} shared by large parts of the cloud, {parts}"
    sentence = f"a height is known to {length(std.whole)}, one sigma, all included ({parts}); "
    sentence += f"required: at most {length(limit)}"
    if std.whole > limit and std.shared is not None and std.shared > std.random:
        water = survey.config.water
        remedy = "give control points, or positions or a level of the water that are better known"
        if water is not None and water.level_std_m is None:
            remedy = (
                "give [water] level_std_m, and control points or [cameras] position_std_m where they are better known"
            )
        sentence += f"; the shared part limits it: {remedy}"
    return _gate("height, all included", 1000.0 * std.whole, 1000.0 * limit, "mm", sentence)


def gates_of_aim(chosen: Choices, stored: StoredBed, seconds: float) -> tuple[Gate, ...]:
    """Gates on what was asked for in place of a quality, of a run that has taken some time [s]."""
    gates = [] if chosen.target_std_m is None else [std_gate(stored, chosen.target_std_m)]
    if (most := chosen.time_budget_s) is not None:
        sentence = f"the points were found after {seconds:.0f} s; required: at most {most:g} s"
        gates.append(_gate("run time", seconds, most, "s", sentence))
    return tuple(gates)


def std_gate(stored: StoredBed, std_m: float) -> Gate:
    """Gate on the target standard deviation [m], with the dominant part where it is missed."""
    # Photographs cannot reduce the std of the datum by GPS or control.
    cells = std_cells(replace(stored.bed, std=stored.std_of_photographs()[:]), stored.gsd_m)
    reached = cells.reached(std_m)
    sentence = "no ground has points"
    if len(cells.std):
        most = 1e3 * float(np.quantile(cells.std, STD_QUANTILE))
        sentence = (
            f"{100 * reached:.1f} % of the ground has a std of at most {1e3 * std_m:.1f} mm; "
            f"{100 * STD_QUANTILE:g} % of it has at most {most:.1f} mm"
        )
    sentence += f"; required: {share(STD_QUANTILE)} within the std asked for"
    if reached < STD_QUANTILE:
        sentence += f"; the rest is limited by {cells.limit(std_m)}"
    if stored.std_common is not None and np.isfinite(stored.std_common).any():
        sentence += f"; std_common, {length(float(np.nanmedian(stored.std_common)))} (median), comes on top"
    name = "ground within the std asked for"
    return _gate(name, 100.0 * reached, 100.0 * STD_QUANTILE, "%", sentence, at_least=True)


@dataclass(frozen=True)
class CellStd:
    """Cells of the ground that have points; K of them, medians over their points."""

    std: np.ndarray  # (K,) [m]
    num_views: np.ndarray  # (K,)
    depth: np.ndarray  # (K,) [m]: of water; NaN in a dry survey

    def reached(self, std_m: float) -> float:
        """Share of the cells within a standard deviation [m]; 1 without cells."""
        return float((self.std <= std_m).mean()) if len(self.std) else 1.0

    def limit(self, std_m: float) -> str:
        """Dominant part of the standard deviation of most cells above the target."""
        above = self.std > std_m
        few = above & (self.num_views < _FEW_VIEWS)
        if 2 * few.sum() > above.sum():
            return "few photographs"
        within, rest = self.depth[~above], self.depth[above & ~few]
        if np.isfinite(within).any() and np.nanmedian(rest) > np.nanquantile(within, 0.75):
            return "depth"
        return "noise, texture and relief below the pixel"


def std_cells(bed: BedPoints, gsd: float) -> CellStd:
    """Cells of points of the bed; ``gsd`` [m] is the ground sampling distance."""
    use = np.isfinite(bed.std)
    place = np.floor(bed.xyz[use, :2] / (_CELL_GSD * gsd)).astype(np.int64)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    columns = (bed.std, bed.num_views, bed.depth)
    return CellStd(*(_medians(cell.ravel(), column[use].astype(np.float64)) for column in columns))


def _medians(cell: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The lower median of the values of each cell, numbered from zero."""
    order = np.lexsort((values, cell))
    ends = np.append(np.flatnonzero(np.diff(cell[order])) + 1, len(cell))
    starts = np.concatenate([[0], ends[:-1]])
    return values[order][(starts + ends - 1) // 2] if len(cell) else np.empty(0)
