"""The head of report.html: verdict, main figures, coverage of the water, and limitations of the cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from evaluation import IhoS44
from survey.compare.tables import limits_label
from survey.display.blocks import Block, Rows, Sentences, Text
from survey.display.quantities import (
    NO_BREAK,
    LengthUnit,
    area,
    count,
    density,
    distance,
    height,
    length,
    share,
    volume,
)
from survey.report.checkpoints import LE95
from survey.report.facts import Gate, RunVerdict
from survey.report.figures import ReportFigures

# Smaller things than so many ground sampling distances are smoothed away by the windows that are matched.
_SMALLEST_GSD = 5.0


@dataclass(frozen=True)
class Headline:
    """A verdict in words."""

    colour: str  # "passed", "doubtful", "failed" or "unjudged"
    word: str
    sentence: str
    gates: tuple[Gate, ...]


@dataclass(frozen=True)
class Card:
    """A number with its name, and a line of detail."""

    label: str
    value: str
    detail: str = ""


def headline(verdict: RunVerdict | None, warnings: tuple[str, ...], draft_command: str | None = None) -> Headline:
    """Green where all gates are met without a warning, amber with one, red where a gate failed.

    A draft, of which the command is given, is not judged by the gates of a cloud for use: it is amber.
    """
    if verdict is None:
        return Headline("unjudged", "Not judged", "No quality gates were applied to this run.", ())
    gates = verdict.gates
    num_failed = sum(not gate.passed for gate in gates)
    if num_failed:
        message = f"{num_failed} of {len(gates)} quality gates {'is' if num_failed == 1 else 'are'} not met."
        if draft_command is not None:
            sentence = (
                "A first look: it shows where a bed is found, and whether settings and flight are right. Of a cloud "
                f"for use {message} {draft_command.replace('--quality draft', '--quality standard')} makes one."
            )
            return Headline("doubtful", "Draft", sentence, gates)
        return Headline("failed", "Failed", f"{message} Do not use the cloud without checking it.", gates)
    all_met = "All quality gates are met"
    if warnings:
        them = "the warning" if len(warnings) == 1 else f"the {len(warnings)} warnings"
        return Headline("doubtful", "Passed with warnings", f"{all_met}; read {them} below before use.", gates)
    return Headline("passed", "Passed", f"{all_met}, and there are no warnings.", gates)


def cards(figures: ReportFigures) -> Iterator[Card]:
    """The few numbers that matter most: heights, cloud, flight, check points, distance to a reference."""
    survey, plan, cloud, checkpoints = figures.survey, figures.plan, figures.cloud, figures.checkpoints
    if (std := figures.height_std) is not None:
        shared = "" if std.shared is None else f"{length(std.shared)} shared by all, "
        detail = f"{shared}{length(std.random)} random; {length(LE95 * std.whole)} at 95{NO_BREAK}%"
        yield Card("Height, one sigma, all included", length(std.whole), detail)
        stated = figures.stated
        if figures.comparison is None and stated is not None and stated.orders:
            order = stated.strictest
            detail = "strictest order for 95 % of the points, by what the cloud states"
            yield Card("IHO S-44, vertical, stated", "none" if order is None else order.name, detail)
    over = f"{density(cloud.density_per_m2)} over {area(cloud.covered_area_m2)}" if cloud.density_per_m2 else ""
    yield Card("Points of the bed", count(cloud.points), over)
    if (depth := cloud.depth_m) is not None:
        yield Card("Median depth", height(depth.median), f"{height(depth.min)} to {height(depth.max)}")
    left_out = f"{survey.views_left_out} left out" if survey.views_left_out else "all used"
    yield Card("Photographs", count(survey.views_used), left_out)
    yield Card("Ground resolution", length(plan.gsd_m), f"from {distance(plan.height_m)} above")
    if checkpoints is not None and checkpoints.groups:
        found = checkpoints.groups[0]
        detail = f"RMS at {found.num} of {len(checkpoints.rows)}, mean {length(found.mean_m)}"
        yield Card("Check points", length(found.rms_m), detail)
    yield from _of_comparison(figures)


def _of_comparison(figures: ReportFigures) -> Iterator[Card]:
    if figures.comparison is None:
        return
    distances, uncertainty = figures.comparison.distances, figures.comparison.uncertainty
    mean_m, std_m = distances.mean_inner90_m, distances.std_inner90_m
    unit = LengthUnit.of([std_m, mean_m])
    value = f"{unit.number(mean_m)}{NO_BREAK}±{NO_BREAK}{unit.text(std_m)}"
    surface, detail = figures.comparison.reference_surface, "mean ± std, inner 90 %"
    if surface is not None:
        detail += f"; the reference itself ± {length(surface.std_median_m)} between its points"
    yield Card("From the reference", value, detail)
    if uncertainty is not None:
        yield _of_orders(uncertainty.iho)


def _of_orders(iho: IhoS44) -> Card:
    """The strictest order that all points and every depth meet; where all points alone meet a stricter one, why not."""
    strictest = iho.strictest
    pooled = next((order for order in iho.orders if order.meets_tvu), None)
    detail = "strictest order whose TVU is met at every depth"
    if pooled is not None and pooled is not strictest:
        worst = min(pooled.failing + pooled.undecided, key=lambda band: band.share_within)
        depth = limits_label(worst.low_m, worst.high_m, "m")
        detail += f"; at {depth} only {share(worst.share_within)} are within {pooled.name}"
    doubtful = next((order for order in iho.orders if order.is_undecided), None)
    if doubtful is not None:
        detail += f"; {doubtful.name} is undecided, as heights between the points of the reference are too uncertain"
    worth = "none" if doubtful is None else "undecided"
    return Card("IHO S-44, vertical only", worth if strictest is None else strictest.name, detail)


def coverage(figures: ReportFigures) -> list[Block]:
    """Coverage of the water in words, and reasons for gaps; nothing for a dry survey."""
    found = figures.coverage
    if found is None:
        return []
    water_m2 = found.wet_m2 + found.two_views_m2 + found.one_view_m2
    if not water_m2:
        return []
    std = "" if found.water_std_m3 is None else f" ± {volume(found.water_std_m3)} (one sigma)"
    gaps = (
        ("no bed, two photographs or more", found.two_views_m2,
         "turbid or too deep, glint, moving plants, or a bed without texture"),
        ("no bed, one photograph only", found.one_view_m2, "no second ray to intersect"),
    )  # fmt: skip
    rows = [
        ("bed found", _part(found.wet_m2, water_m2)),
        ("water over it", f"{volume(found.water_m3)}{std}"),
        *((label, f"{_part(gap_m2, water_m2)}: {why}") for label, gap_m2, why in gaps if gap_m2),
    ]
    if figures.left_out:
        rows.append(("photographs without a pose", f"{len(figures.left_out)}: what they alone show is missing"))
    return [Rows(rows)]


def _part(value_m2: float, whole_m2: float) -> str:
    return f"{area(value_m2)}, {share(value_m2 / whole_m2 if whole_m2 else None)} of the water that was looked at"


def method(figures: ReportFigures) -> list[Block]:
    """How the cloud was made, for whoever did not make it."""
    made = f"{count(figures.survey.views_used)} photographs, their poses from {figures.survey.poses}."
    if (water := figures.water) is not None:
        made += (
            f" Every ray was bent by Snell's law where it meets the water (level {height(water.level_m)}, index "
            f"{water.refractive_index:.4f}) before photographs were matched: no factor on depths, no shift, no fit to "
            "a reference."
        )
    refined = " and refined by least squares over all of them" if figures.plan.field == "solver" else ""
    made += f" Heights were searched by matching them{refined}; each point was found at one height by two or more."
    return [Text(made)]


def limitations(figures: ReportFigures) -> list[Block]:
    """Fitness of the cloud for purposes, in sentences with this run's figures."""
    parts, std = [], figures.height_std
    if std is not None:
        message = f"A typical height is within {length(LE95 * std.whole)} of the truth in 95 of 100 cases"
        if std.shared:
            shared = length(LE95 * std.shared)
            message += f"; of that, {shared} are a common shift of all heights, which averaging does not reduce"
        parts.append(f"{message}, if level, index and positions are as accurate as stated.")
    parts.append(
        f"Things smaller than about {length(_SMALLEST_GSD * figures.plan.gsd_m)} are smoothed away or missing; what "
        "stands on a wall or under an overhang may be missing too."
    )
    if figures.water is not None:
        parts.append(
            "The water was taken as at rest: waves add noise, and where they do not average out, a bias. What moves, "
            "as plants and fish, is wrong or missing."
        )
        parts.append(
            "The top of plants counts as bed where they hide it. No statement is made on the ground below them, nor on "
            "what lies where no bed was found."
        )
        parts.append("Not a nautical survey: search for obstructions and full coverage were not tested.")
    if figures.checkpoints is None and figures.comparison is None:
        parts.append("Nothing independent was measured with it: no check points, no reference.")
    return [Sentences(parts)]
