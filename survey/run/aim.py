"""Quality and image scale of a run with a target standard deviation or a time budget, by what is foreseen before it.

Candidates are the image scales, each without the solver (draft) and with it (standard). What an image scale does to the
standard deviation of points is foreseen from the poses, what it takes from the amounts of work on an idle machine;
docs/targets.md compares both with finished runs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from survey.adjust.result.foreseen import foresee
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.area import ASSUMED_DEPTH_M
from survey.plan.choices import STD_QUANTILE, Choices, gsd_m, image_scale_of
from survey.plan.plan import Decision, make_plan
from survey.plan.workload import workload_of
from survey.progress import rough
from survey.words import SCALES, Quality

# Standard deviation that 95 % of the ground stays within, over the foreseen one: 1.0 on textured beds, 2.8 on a river,
# 8.7 on a wreck with walls (docs/targets.md).
REACHED_PER_FORESEEN = 3.0
# What estimated times may be short by.
_RESERVE = 1.2
# Smaller images are not matched [px along the longer side]: at 256 px errors of data/quick are five times those at 512.
_LEAST_SIDE_PX = 400
# Standard deviations that can be asked for: in pixels of the largest images at least, of the smallest at most.
_LEAST_PX, _MOST_PX = 0.01, 10.0


@dataclass(frozen=True)
class Candidate:
    """A quality at an image scale, with what is foreseen of it."""

    quality: str
    image_scale: float
    # [m]: on `STD_QUANTILE` of the ground; NaN where the solver, which alone gives one to rely on, is left out, and
    # where too few views overlap
    std_m: float
    seconds: float | None  # Of a whole run on an idle machine; None on a device whose rates were not measured

    def __str__(self) -> str:
        return f"{self.quality} at image scale {self.image_scale:g}"


@dataclass(frozen=True)
class AimedPlan:
    """Choice for an aim; options without an aim stay as they are."""

    chosen: Choices  # With quality and image scale
    decision: Decision | None = None  # Line of the plan
    warnings: tuple[str, ...] = ()  # Reasons against reaching the standard deviation, as sentences
    candidates: tuple[Candidate, ...] = ()  # In ascending order of work

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """What is foreseen of each candidate, and the choice, as labelled sentences; none without an aim."""
        if self.decision is None:
            return ()
        rows = [("asked", self.chosen.aim)]
        for each in self.candidates:
            std = _on_ground(each.std_m) if math.isfinite(each.std_m) else ""
            time = "" if each.seconds is None else f"about {rough(each.seconds)} on an idle machine"
            rows.append((str(each), ", ".join(part for part in (std, time) if part)))
        return (
            *rows,
            ("chosen", f"{self.decision.choice}: {self.decision.reason}"),
            *(("", text) for text in self.warnings),
        )


def plan_for_aim(
    survey: Survey, chosen: Choices, *, gone_s: float = 0.0, refuses: bool = True, depth_m: float = ASSUMED_DEPTH_M
) -> AimedPlan:
    """Choose quality and image scale for the aim of a run whose poses are known and whose bed lies at a depth [m].

    ``gone_s`` of the time budget have passed. Where it is too short, that is an error if the choice ``refuses``; else
    the shortest run follows, with a warning.
    """
    if not chosen.has_aim:
        return AimedPlan(chosen)
    target_m, budget_s = chosen.target_std_m, chosen.time_budget_s
    foreseen = foresee(survey, depth_m=depth_m, chosen=chosen)
    # Those that can be matched; 1 is one of them however small the photographs are.
    side = min(max(view.lens.width, view.lens.height) for view in survey.views)
    scales = sorted(scale for scale in SCALES if scale == 1.0 or scale * side >= _LEAST_SIDE_PX)
    if target_m is not None:
        pixel_m = gsd_m(survey, replace(chosen, image_scale=1.0))
        least, most = _LEAST_PX * pixel_m, _MOST_PX * pixel_m / scales[0]
        if not least <= target_m <= most:
            raise SurveyError(
                f"--target-std {target_m:g} is in metres, expected {least:.2g} to {most:.2g} here, a hundredth of a "
                f"pixel of the largest images to {_MOST_PX:g} of the smallest; 0.02 is 20 mm"
            )
    # Matches are as good in pixels at any scale.
    full_m = common_m = math.nan
    if foreseen is not None:
        full_m = REACHED_PER_FORESEEN * foreseen.heights.of_point_m * image_scale_of(survey, chosen)
        common_m = foreseen.heights.of_all_m
    candidates = []
    for scale, quality in product(scales, (Quality.draft.value, Quality.standard.value)):
        plan = make_plan(survey, replace(chosen, quality=quality, image_scale=scale))
        std_m = full_m / scale if plan.solves else math.nan
        candidates.append(Candidate(quality, scale, std_m, workload_of(survey, plan).seconds))
    warnings = [] if target_m is None else _std_warnings(target_m, candidates[-1].std_m, common_m)
    best, reason = _wanted(target_m, candidates)
    if budget_s is not None:
        best, reason = _in_time(budget_s - gone_s, candidates[: candidates.index(best) + 1], reason, refuses=refuses)
        if best.seconds is not None and _RESERVE * best.seconds > budget_s - gone_s:
            warnings.append(reason)
    chosen = replace(chosen, quality=best.quality, image_scale=best.image_scale)
    return AimedPlan(chosen, Decision("aim", str(best), reason), tuple(warnings), tuple(candidates))


def _on_ground(std_m: float) -> str:
    return f"about {length(std_m)} on {100 * STD_QUANTILE:g} % of the ground"


def _wanted(target_m: float | None, candidates: Sequence[Candidate]) -> tuple[Candidate, str]:
    """The candidate with the least work that is foreseen to reach the standard deviation, else the last; and why."""
    if target_m is None:
        return candidates[-1], "whole photographs, with the solver"
    for each in candidates:
        if each.std_m <= target_m:
            return each, f"the least work that is foreseen to reach {length(target_m)}: {_on_ground(each.std_m)}"
    return candidates[-1], f"nothing is foreseen to reach {length(target_m)}; whole photographs come nearest"


def _in_time(left_s: float, candidates: Sequence[Candidate], reason: str, *, refuses: bool) -> tuple[Candidate, str]:
    """The last candidate that fits into the time, and why; one without the solver only where none with it fits."""
    seconds = [each.seconds for each in candidates if each.seconds is not None]
    if len(seconds) < len(candidates):
        raise SurveyError(
            "--time-budget needs an estimate of the run time, and there are rates for --device cpu with LLVM alone; "
            "give --quality or --target-std instead"
        )
    fitting = [each for each, time in zip(candidates, seconds, strict=True) if _RESERVE * time <= left_s]
    left = f"{left_s:.0f} s"
    if not fitting:
        words = (
            f"this survey takes at least about {math.ceil(_RESERVE * min(seconds))} s on this machine when idle, a "
            f"reserve of {100 * (_RESERVE - 1):.0f} % included, and {left} are left"
        )
        if refuses:
            raise SurveyError(f"--time-budget is too short: {words}; give more, or a smaller [area]")
        return candidates[0], f"{words}: the shortest run follows"
    best = ([each for each in fitting if each.quality == Quality.standard] or fitting)[-1]
    time = f"about {rough(seconds[list(candidates).index(best)])} on an idle machine"
    if best is candidates[-1]:
        return best, f"{reason}; {time}, of {left}"
    return best, f"the best that fits into {left}: {time}; {candidates[-1]} would take about {rough(seconds[-1])}"


def _std_warnings(std_m: float, reached_m: float, common_m: float) -> list[str]:
    asked, sentences = f"asked is a standard deviation of {length(std_m)}", []
    if reached_m > std_m:
        sentences.append(
            f"{asked}, but photographs of this size and overlap give {_on_ground(reached_m)}, a third of it to three "
            "times as much by texture, noise and relief; fly lower or with more overlap"
        )
    if common_m > std_m:
        sentences.append(
            f"{asked} for the points themselves; water, lens and poses add about {length(common_m)} common to all "
            "points, which no processing reduces: state what is known better ([water] level_std_m, index_std; "
            "position_std_m), or give control points"
        )
    return sentences
