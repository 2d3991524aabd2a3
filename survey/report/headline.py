"""What report.html says first: the verdict in a sentence, and the few numbers that matter most."""

from __future__ import annotations

from dataclasses import dataclass

from survey.display.quantities import NO_BREAK, LengthUnit, count, length, metres, number, share


@dataclass(frozen=True)
class Headline:
    """A verdict in words.

    Attributes
    ----------
    colour : "passed", "doubtful", "failed" or "unjudged"
    word : str
    sentence : str
    gates : list of dict
        As in report.json.
    """

    colour: str
    word: str
    sentence: str
    gates: list[dict]


@dataclass(frozen=True)
class Card:
    """A number with what it is, and a line that says more."""

    label: str
    value: str
    detail: str = ""


def headline(verdict: dict | None, warnings: list[str]) -> Headline:
    """Green where all gates are met without a warning, amber with one, red where a gate failed."""
    if verdict is None:
        return Headline("unjudged", "Not judged", "No quality gates were applied to this run.", [])
    gates = verdict["gates"]
    num_failed = sum(not gate["passed"] for gate in gates)
    if num_failed:
        said = f"{num_failed} of {len(gates)} quality gates {'is' if num_failed == 1 else 'are'} not met."
        return Headline("failed", "Failed", f"{said} Do not use the cloud without checking it.", gates)
    met = "All quality gates are met"
    if warnings:
        them = "the warning" if len(warnings) == 1 else f"the {len(warnings)} warnings"
        return Headline("doubtful", "Passed with warnings", f"{met}; read {them} below before use.", gates)
    return Headline("passed", "Passed", f"{met}, and there are no warnings.", gates)


def cards(figures: dict) -> list[Card]:
    """The few numbers that matter most."""
    survey, cloud, comparison = figures["survey"], figures["cloud"], figures["comparison"]
    left_out = survey["views_left_out"]
    area = ""
    if cloud["density_per_m2"]:
        area = f"{count(cloud['density_per_m2'])} per m² over {count(cloud['covered_area_m2'])}{NO_BREAK}m²"
    found = [Card("Points of the bed", count(cloud["points"]), area)]
    if cloud["depth_m"]:
        depth = cloud["depth_m"]
        found.append(
            Card("Median depth", metres(depth["median"]), f"{number(depth['min'], 2)} to {metres(depth['max'])}")
        )
    if cloud["std_m"]:
        std = cloud["std_m"]
        found.append(Card("Height std, median", length(std["median"]), f"95 % below {length(std['p95'])}"))
    for gate in (figures["verdict"] or {}).get("gates", []):
        if gate["unit"] == "%" and gate["value"] is not None:
            value, limit = share(0.01 * gate["value"]), share(0.01 * gate["limit"])
            found.append(Card(gate["name"].capitalize(), value, f"{limit} asked for"))
    found.append(Card("Photographs", count(survey["views_used"]), f"{left_out} left out" if left_out else "all used"))
    plan = figures["plan"]
    found.append(Card("Ground resolution", length(plan["gsd_m"]), f"from {number(plan['height_m'], 1)} m above"))
    if comparison:
        unit = LengthUnit.of([comparison["std_inner90_m"], comparison["mean_inner90_m"]])
        value = (
            f"{unit.number(comparison['mean_inner90_m'])}{NO_BREAK}±{NO_BREAK}{unit.text(comparison['std_inner90_m'])}"
        )
        found.append(Card("From the reference", value, "mean ± std, inner 90 %"))
    if figures["iho_s44"]:
        met = [o["order"] for o in figures["iho_s44"]["orders"] if o["meets_tvu"]]
        found.append(Card("IHO S-44, vertical only", met[0] if met else "none", "strictest order whose TVU is met"))
    return found
