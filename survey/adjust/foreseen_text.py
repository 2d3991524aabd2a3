"""Sentences with verdicts for the pre-analysis of `survey.adjust.foreseen`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from evaluation.standards import TO_95, TVU
from survey.adjust.foreseen import (
    DEPTH_M,
    MATCH_STD_PX,
    TIE_STD_PX,
    Foreseen,
    HeightStds,
    foresee,
    heights_by_depth,
)
from survey.adjust.priors import EXACT_STD_DEG, EXACT_STD_M, INDEX_STD, LEVEL_STD_M
from survey.adjust.verdicts import MOST_STD_FOCAL, MOST_STD_INDEX, MOST_STD_LEVEL_M
from survey.folder.survey import Survey
from survey.folder.water import ASSUMED_INDEX_STD
from survey.plan.check import Section
from survey.plan.choices import USUAL, Choices
from survey.plan.verdict import Verdict, by_limits, judged

# Good and fair: photographs that the worst tenth of the places is in; angles between rays to a place.
OVERLAP, ANGLES_DEG = (5.0, 3.0), (30.0, 15.0)
_ADJUSTED = "poses and lens adjusted"
_KEPT = (
    "for heights poses and lens kept, as good as those of an adjusted block "
    f"({100 * EXACT_STD_M:g} cm, {EXACT_STD_DEG:g} degrees) where nothing is said"
)


def foreseen_section(survey: Survey, *, depth_m: float = DEPTH_M, chosen: Choices = USUAL) -> Section | None:
    """What is foreseen, for `check`; None where too few views overlap."""
    found = foresee(survey, depth_m=depth_m, chosen=chosen)
    if found is None:
        return None
    return Section("Foreseen from the poses", rows_of(found, heights_by_depth(survey, depth_m, chosen=chosen)))


def rows_of(found: Foreseen, by_depth: Sequence[HeightStds]) -> tuple[tuple[str, str], ...]:
    """What is foreseen, as labelled sentences."""
    is_wet = math.isfinite(found.level_std_m)
    place = f"a rough bed {found.heights.depth_m:g} m under the water" if is_wet else "rough ground"
    assumed = (
        f"{place}, tie points good to {TIE_STD_PX:g} px, matches to {MATCH_STD_PX:g} px of what is worked on, "
        f"{_ADJUSTED if found.is_adjusted else _KEPT}, level and index known to {LEVEL_STD_M:g} m and {INDEX_STD:g} "
        f"where nothing is said, an index that is not given to {ASSUMED_INDEX_STD:g}, still and clear water "
        "without glitter"
    )
    rows = [("overlap", _overlap_text(*found.views_of_place)), ("angles", _angles_text(found.angle_deg))]
    if is_wet:
        rows += [
            ("level", _use(f"to {100.0 * found.level_std_m:.1f} cm", found.level_std_m, MOST_STD_LEVEL_M)),
            ("index", _use(f"to {found.index_std:.4f}", found.index_std, MOST_STD_INDEX)),
        ]
    rows += [
        ("focal length", _use(f"to {100.0 * found.focal_std:.2f} %", found.focal_std, MOST_STD_FOCAL)),
        ("heights", _heights_text(found.heights, by_depth)),
        ("assumed", assumed),
    ]
    return tuple(rows)


def _overlap_text(low: float, median: float) -> str:
    return judged(
        by_limits(low, *OVERLAP),
        f"a place is in {median:.0f} photographs (median), the worst tenth in {low:.0f} or fewer",
        "fly 80 % of overlap ahead and 70 % aside, or a smaller area",
    )


def _angles_text(angle_deg: float) -> str:
    return judged(
        by_limits(angle_deg, *ANGLES_DEG),
        f"rays to a place differ by up to {angle_deg:.0f} degrees (median)",
        "add views tilted by 25 to 35 degrees that cross",
    )


def _use(words: str, std: float, limit: float) -> str:
    if std <= limit:
        return judged(Verdict.good, f"the photographs can tell it {words}", "")
    return judged(
        Verdict.poor, f"not observable by this flight: {words}", "it has to be given, or add oblique views that cross"
    )


def _heights_text(main: HeightStds, by_depth: Sequence[HeightStds]) -> str:
    """Standard deviations by depth, and what S-44 says of those at the main depth."""
    each = [f"{_mm(std.of_point_m)} / {_mm(std.of_all_m)} mm at {std.depth_m:.2g} m of depth" for std in by_depth]
    said = ", ".join(each) or f"{_mm(main.of_point_m)} / {_mm(main.of_all_m)} mm"
    total = TO_95 * math.hypot(main.of_point_m, main.of_all_m)
    allowed = [(name, math.hypot(a, b * main.depth_m)) for name, a, b in TVU]
    orders = [name for name, most in allowed if total <= most]
    order = f"; enough for S-44 {orders[0]} at {main.depth_m:.2g} m" if orders and by_depth else ""
    return judged(
        by_limits(total, allowed[0][1], allowed[1][1]),
        f"one sigma, of a point by matching / of all in common by water, lens and poses: {said}{order}",
        "fly lower, with more overlap and oblique views",
    )


def _mm(metres: float) -> str:
    return f"{1000.0 * metres:.0f}" if metres >= 0.001 else f"{1000.0 * metres:.1f}"
