"""The first recipe of a run with an aim, and what can be foreseen before anything is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from survey import machine
from survey.adjust.result.foreseen import foresee
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.machine import Load
from survey.plan.area import ASSUMED_DEPTH_M
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.recipe import STD_QUANTILE, Aim, Recipe, recipes_for
from survey.progress import Progress
from survey.run.aimed_run import ANY_RUN_S, AimedRun, FullSizeAmounts, RoundRates
from survey.run.clock import Clock

# What the stated rates of another machine may be wrong by.
_UNKNOWN_PACE = 1.2
# Standard deviations that can be asked for: in pixels of the largest images at least, of the smallest at most.
_LEAST_PX, _MOST_PX = 0.01, 10.0


@dataclass(frozen=True)
class Feasibility:
    """Feasibility of an aim before anything is computed."""

    recipes: tuple[Recipe, ...]
    scales: tuple[float, ...]  # Of the images, for each recipe
    amounts: FullSizeAmounts
    # [m]: foreseen by matching alone for each recipe, median over the places; NaN where too few views overlap
    point_std_m: tuple[float, ...]
    common_std_m: float  # [m]: of water, lens and poses
    first: int  # Number of the recipe of the first round
    rates: RoundRates  # By stated rates and how busy the machine is
    load: Load  # Of the machine


def assess_feasibility(
    aim: Aim, survey: Survey, chosen: Choices, load: Load, depth_m: float = ASSUMED_DEPTH_M
) -> Feasibility:
    """Feasibility of an aim for a survey whose poses are known.

    Parameters
    ----------
    aim, survey, chosen :
        As the run has them.
    load : Load
        Of the machine.
    depth_m : [m]
        Of the bed under the water.

    Raises
    ------
    SurveyError
        If no view looks down, or the standard deviation cannot be meant.
    """
    recipes = recipes_for([(view.lens.width, view.lens.height) for view in survey.views])
    plans = [make_plan(survey, chosen, recipe=recipe) for recipe in recipes]
    _require_plausible_std(aim, plans[0].gsd_m, plans[-1].gsd_m)
    scales = tuple(plan.image_scale for plan in plans)
    amounts = FullSizeAmounts.of(survey, plans[-1])
    foreseen, at = foresee(survey, depth_m=depth_m, chosen=chosen), make_plan(survey, chosen).image_scale
    std = tuple(math.nan if foreseen is None else foreseen.heights.of_point_m * at / scale for scale in scales)
    first = 0
    if aim.std_m is not None:
        # Only heights of the solver have a standard deviation that can be relied on.
        solving = [number for number, recipe in enumerate(recipes) if recipe.field == "solver"]
        first = next((number for number in solving if not std[number] > aim.std_m), solving[-1])
    rates = RoundRates.stated(amounts, load.slowdown)
    common = math.nan if foreseen is None else foreseen.heights.of_all_m
    return Feasibility(recipes, scales, amounts, std, common, first, rates, load)


def _require_plausible_std(aim: Aim, largest_m: float, smallest_m: float) -> None:
    """Raise for a target std beyond the range that pixels of the smallest and the largest images [m] can give."""
    if aim.std_m is None:
        return
    asked, least, most = f"--target-std {aim.std_m:g} is in metres", _LEAST_PX * smallest_m, _MOST_PX * largest_m
    if aim.std_m < least:
        raise SurveyError(
            f"{asked}, and less than a hundredth of what a pixel covers here ({1e3 * least:.2g} mm), which image "
            "matching does not reach; give more, 0.02 for 20 mm"
        )
    if aim.std_m > most:
        raise SurveyError(
            f"{asked}, and more than {_MOST_PX:g} pixels of the smallest images cover here ({most:.2g} m), which any "
            "cloud has; give less, 0.02 for 20 mm"
        )


def aim_warnings(aim: Aim, found: Feasibility) -> list[str]:
    """Reasons against reaching a standard deviation, as sentences."""
    if aim.std_m is None:
        return []
    asked, sentences = f"asked is a standard deviation of {length(aim.std_m)}", []
    if found.point_std_m[-1] > aim.std_m:
        sentences.append(
            f"{asked}, but photographs of this size and overlap allow about {length(found.point_std_m[-1])}; fly "
            "lower or with more overlap"
        )
    if found.common_std_m > aim.std_m:
        sentences.append(
            f"{asked} for the points themselves; water, lens and poses add about {length(found.common_std_m)} common "
            "to all points, which no processing reduces: state what is known better ([water] level_std_m, index_std; "
            "position_std_m), or give control points"
        )
    return sentences


def shortest_s(found: Feasibility) -> float:
    """Shortest accepted time budget [s]."""
    return _UNKNOWN_PACE * found.rates.least_s(found.amounts, found.scales[0], lowest_scale=found.scales[0])


def require_some_time(aim: Aim | None) -> None:
    """Raise for a time budget in which no survey can be processed, without reading one."""
    if aim is not None and aim.seconds is not None and aim.seconds < ANY_RUN_S:
        raise SurveyError(
            f"--time-budget {aim.seconds:g} is too short: any run takes {ANY_RUN_S:g} s and more; give more, "
            "bathynerf check --time-budget says how much"
        )


def require_time(seconds: float, found: Feasibility) -> None:
    """Raise for a time budget [s] in which no cloud of this survey can be made."""
    shortest = math.ceil(shortest_s(found))
    if seconds < shortest:
        raise SurveyError(
            f"--time-budget {seconds:g} is too short: this survey takes at least about {shortest} s on this machine, "
            f"as busy as it is ({found.load}); give more, or a smaller [area]"
        )


def begin_aimed_run(
    aim: Aim, survey: Survey, chosen: Choices, clock: Clock | None, progress: Progress, *, refuses: bool
) -> AimedRun:
    """The state of a run with an aim before its first round.

    Parameters
    ----------
    aim, survey, chosen, clock, progress :
        As the run has them.
    refuses : bool
        Whether a time that is too short is an error, as before anything was computed; otherwise the shortest run
        follows, with a warning.

    Raises
    ------
    SurveyError
        If the time is too short, or the standard deviation cannot be meant.
    """
    found = assess_feasibility(aim, survey, chosen, machine.measure_load())
    progress.note(f"asked: {aim}")
    progress.note(f"machine: {found.load}")
    for text in aim_warnings(aim, found):
        progress.warn(text)
    # No rates are known of other devices: they are measured in the first round.
    if (
        clock is not None
        and aim.seconds is not None
        and make_plan(survey, chosen, recipe=found.recipes[0]).device == "llvm"
    ):
        if refuses:
            require_time(aim.seconds, found)
        elif clock.left_s < shortest_s(found):
            progress.warn(f"{clock.left_s:.0f} s are left of --time-budget {aim.seconds:g}: the shortest run follows")
    state = AimedRun(aim, found.recipes, found.scales, found.amounts, clock, 0, found.rates)
    # If the first round would leave little of the time, the shortest recipe comes first.
    state.number = found.first if clock is None or 2.0 * state.round_s(found.first) < clock.left_s else 0
    return state


def rows_of(
    aim: Aim, survey: Survey, chosen: Choices, load: Load, depth_m: float = ASSUMED_DEPTH_M
) -> tuple[tuple[str, str], ...]:
    """Expected std and duration of an aim, labelled for `check`; parameters as for `assess_feasibility`."""
    found = assess_feasibility(aim, survey, chosen, load, depth_m)
    rows = [("asked", str(aim))]
    is_timed = make_plan(survey, chosen, recipe=found.recipes[0]).device == "llvm"
    for number, (recipe, scale) in enumerate(zip(found.recipes, found.scales, strict=True)):
        if recipe.field != "solver":
            continue
        std = found.point_std_m[number]
        heights = f"std of points about {length(std)} (median)" if math.isfinite(std) else "too few views overlap"
        seconds = found.rates.least_s(found.amounts, scale, lowest_scale=found.scales[0]) + found.rates.solver_s(
            found.amounts, scale
        )
        rows.append((f"image scale {scale:g}", heights + (f", about {seconds:.0f} s" if is_timed else "")))
    if aim.std_m is not None:
        # Of all surveys in docs/targets.md whose images are not tiny.
        within = f"{100 * STD_QUANTILE:g} % of it stay within 1.7 to 5 times the median, on surveys so far; that counts"
        rows.append(("of the ground", within))
    rows += [("", text) for text in aim_warnings(aim, found)]
    if aim.seconds is not None and is_timed:
        enough = "enough" if aim.seconds >= shortest_s(found) else "more than the budget: process refuses"
        shortest = f"about {math.ceil(shortest_s(found))} s, a reserve of {100 * (_UNKNOWN_PACE - 1):.0f} % included"
        rows.append(("shortest run", f"{shortest}; {enough}"))
    if is_timed:
        rows.append(("times", f"on this machine as busy as it is, {load}"))
    return tuple(rows)
