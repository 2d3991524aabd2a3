"""The quality gate of a run.

Three things are required. Of the ground that two or more views see, at the height where the bed was found, at least
half has a point: what one view alone sees cannot be measured and does not count. The median standard deviation of the
points by matching and given poses, without that of the datum by GPS or control, which no photograph improves, is at
most one and a half ground sampling distances. The total standard deviation of a height, including what all share by
water, lens and poses, is at most the same, or what IHO S-44's strictest order allows in shallow water (0.15 m at 95 %)
where that is more: a level read to some centimetres is no failure of a low flight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from survey.display.column import ColumnStatistics
from survey.display.quantities import NO_BREAK, length, share
from survey.plan.recipe import MAX_STD_GSD, STD_QUANTILE, max_height_std
from survey.report.collect import height_std
from survey.report.facts import Gate, RunVerdict
from survey.report.seen_cells import SeenCells, cells_of
from survey.run.aimed_run import std_cells

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.run.stored import StoredBed

MIN_COVERED_SHARE = 0.5
MIN_VIEWS = 2


def verdict_of(survey: Survey, stored: StoredBed, gsd_m: float, cells: SeenCells | None = None) -> RunVerdict:
    """Verdict of the gates on the points of a bed at a ground sampling distance [m], with its `cells_of` if known."""
    return RunVerdict(
        (
            _completeness(cells_of(survey, stored.bed.xyz, gsd_m) if cells is None else cells),
            _precision(ColumnStatistics(stored.std_of_photographs()).median, gsd_m),
            _whole(survey, stored, gsd_m),
        )
    )


def asked_gate(stored: StoredBed, std_m: float) -> Gate:
    """Gate on the target standard deviation [m], with the dominant part where it is missed."""
    # Photographs cannot reduce the std of the datum by GPS or control.
    bed = replace(stored.bed, std=stored.std_of_photographs()[:])
    cells = std_cells(bed, stored.gsd_m)
    reached = cells.reached(std_m)
    sentence = f"{cells.in_words(std_m)}; required: {share(STD_QUANTILE)} within the std asked for"
    if reached < STD_QUANTILE:
        sentence += f"; the rest is limited by {cells.limit(std_m)}"
    if stored.std_common is not None and np.isfinite(stored.std_common).any():
        sentence += f"; std_common, {length(float(np.nanmedian(stored.std_common)))} (median), comes on top"
    return Gate(
        "ground within the std asked for", 100.0 * reached, 100.0 * STD_QUANTILE, "%", reached >= STD_QUANTILE, sentence
    )


def _completeness(cells: SeenCells) -> Gate:
    seen = cells.num_views >= MIN_VIEWS
    found = float((cells.has_point & seen).sum() / seen.sum()) if seen.any() else 0.0
    sentence = (
        f"{share(found)} of the ground that two or more views see has a point of the bed; "
        f"required: at least {share(MIN_COVERED_SHARE)}"
    )
    passed = found >= MIN_COVERED_SHARE
    return Gate("ground with a point", 100.0 * found, 100.0 * MIN_COVERED_SHARE, "%", passed, sentence)


def _precision(std: float, gsd_m: float) -> Gate:
    limit = MAX_STD_GSD * gsd_m
    sentence = (
        f"the median standard deviation of the points is {length(std)}; required: at most {length(limit)} "
        f"({MAX_STD_GSD:g}{NO_BREAK}ground sampling distances)"
    )
    return Gate("median standard deviation", 1000.0 * std, 1000.0 * limit, "mm", std <= limit, sentence)


def _whole(survey: Survey, stored: StoredBed, gsd_m: float) -> Gate:
    """Total standard deviation of a height, as `height_std_m` in report.json."""
    std, limit = height_std(stored.bed.std, stored.std_common), max_height_std(gsd_m)
    passed = std.whole <= limit
    parts = f"{length(std.random)} random"
    if std.shared is not None:
        parts = f"{length(std.shared)} shared by large parts of the cloud, {parts}"
    sentence = f"a height is known to {length(std.whole)}, one sigma, all included ({parts}); "
    sentence += f"required: at most {length(limit)}"
    if not passed and std.shared is not None and std.shared > std.random:
        sentence += f"; the shared part limits it: {_remedy(survey)}"
    return Gate("height, all included", 1000.0 * std.whole, 1000.0 * limit, "mm", passed, sentence)


def _remedy(survey: Survey) -> str:
    """Remedy for a large common standard deviation."""
    water = survey.config.water
    if water is not None and water.level_std_m is None:
        return "give [water] level_std_m, and control points or [cameras] position_std_m where they are better known"
    return "give control points, or positions or a level of the water that are better known"
