"""report.html: the figures of a report as one page without further files, for screen and paper."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import jinja2

from evaluation import IhoS44
from survey.compare import tables as compare_tables
from survey.compare.figures import Figures
from survey.display import palette
from survey.display.blocks import Block, Rows, Section, Sentences, Table, Text, png_data
from survey.display.canvas import Picture
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
    typeset,
)
from survey.progress import clock
from survey.report import checkpoints, photographs, tables
from survey.report.adjustment import adjustment
from survey.report.checkpoints import LE95
from survey.report.facts import Gate, RunVerdict
from survey.report.figures import ReportFigures
from survey.settings.config import settings_text
from survey.words import Quality

# Headings with the files of their pictures and the titles of their sections, which fill the pages between pictures.
_GROUPS = (
    ("The bed", ("depth", "orthophoto", "profile"), ("Point cloud",)),
    ("Uncertainty and coverage", ("unseen", "views", "std", "histograms"),
     ("Coverage", "Check points", "Stated uncertainty of the cloud")),
    ("Comparison with the reference", ("error", "completeness", "error_histogram", "error_bands"),
     ("Comparison with the reference", "Vertical uncertainty (IHO S-44)")),
    ("Residuals of the adjustment", ("parts", "control", "residuals_ground", "residuals_image", "correlation"),
     ("Adjustment",)),
    ("Waves", ("waves", "wave_shifts"), ("Waves",)),
    ("Flight", ("view", "plan"), ("Survey and water", "Photographs")),
)  # fmt: skip
# These show several things side by side and take the whole width.
_WIDE = ("view", "profile", "error_bands")
# Smaller things than so many ground sampling distances are smoothed away by the windows that are matched.
_SMALLEST_GSD = 5.0


def render_page(figures: ReportFigures, pictures: Sequence[Picture]) -> str:
    """The page, with the files of the pictures in it: HTML without scripts and without anything to load."""
    unit = LengthUnit.of_heights()
    kept = "tolerances, bands of depth and limits of S-44 are in metres, as they say"
    units = [] if unit.name == "m" else [("lengths", f"in feet of {1.0 / unit.per_metre:.10g} m; {kept}")]
    draft_command = figures["settings"].get("command") if figures["plan"].quality == Quality.draft else None
    return _template().render(
        palette=palette,
        survey=figures["survey"],
        head=Rows([*photographs.taken_rows(figures["taken"]), *units]),
        verdict=headline(figures["verdict"], figures["warnings"], draft_command),
        cards=list(cards(figures)),
        num_warnings=len(figures["warnings"]),
        first_sections=[Section("Method", _method(figures)), Section("Limitations", _limitations(figures))],
        groups=_grouped(pictures, sections := [section for section in _sections(figures) if section.blocks]),
        sections=[section for section in sections if not any(section.title in titles for _, _, titles in _GROUPS)],
        settings=settings_text(figures["settings"]),
        version=figures["versions"].get("bathynerf", ""),
    )


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("survey.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["typeset"] = typeset
    return environment.get_template("page.html")


def _sections(figures: ReportFigures) -> list[Section]:
    """The parts of the page beside pictures; some may be empty."""
    comparison: Figures | None = figures["comparison"]
    uncertainty = None if comparison is None else comparison.uncertainty
    decisions = [(decision.name, decision.choice, decision.reason) for decision in figures["plan"].decisions]
    timings = [(name.replace("_", " "), clock(seconds)) for name, seconds in figures["timings_s"].items()]
    return [
        Section("Coverage", tables.coverage(figures["coverage"], len(figures["photographs_left_out"]))),
        Section("Comparison with the reference", compare_tables.comparison(comparison)),
        Section("Waves", tables.waves(figures["waves"])),
        Section("Check points", tables.checkpoints(figures["checkpoints"])),
        Section("Vertical uncertainty (IHO S-44)", compare_tables.iho_s44(uncertainty)),
        Section("Stated uncertainty of the cloud", checkpoints.table(figures["stated"])),
        Section("Adjustment", adjustment(figures["adjustment"])),
        Section("Point cloud", tables.cloud(figures["cloud"], figures["survey"]["crs"])),
        Section("Survey and water", tables.survey(figures["survey"], figures["water"], figures["plan"])),
        Section("Photographs", photographs.table(figures["photographs"], figures["photographs_left_out"])),
        Section("Processing decisions", [Table(("decision", "choice", "reason"), decisions, num_texts=3)]),
        *(
            Section(name.capitalize(), [Sentences(figures[name])] if figures[name] else [])
            for name in ("assumptions", "warnings")
        ),
        Section("Run time", [Table(("stage", "time"), timings)]),
        Section("Software versions", [Rows(list(figures["versions"].items()))] if figures["versions"] else []),
    ]


def _grouped(pictures: Sequence[Picture], sections: Sequence[Section]) -> list[tuple[str, list[dict], list[Section]]]:
    """Headings with their pictures, each with its file as text, and their sections."""
    shown = {
        picture.path.stem: {
            "title": picture.title,
            "caption": picture.caption,
            "data": png_data(picture.path),
            "is_wide": picture.path.stem in _WIDE,
        }
        for picture in pictures
    }
    if unknown := sorted(shown.keys() - {name for _, names, _ in _GROUPS for name in names}):
        raise ValueError(f"the pictures {', '.join(unknown)} have no place in the report")
    by_title = {section.title: section for section in sections}
    groups = [
        (heading, [shown[name] for name in names if name in shown], [by_title[t] for t in titles if t in by_title])
        for heading, names, titles in _GROUPS
    ]
    return [group for group in groups if group[1] or group[2]]


@dataclass(frozen=True)
class Headline:
    """A verdict in words."""

    colour: str  # "passed", "doubtful", "failed" or "unjudged"
    word: str
    sentence: str
    gates: tuple[Gate, ...] = ()


def headline(verdict: RunVerdict | None, warnings: Sequence[str], draft_command: str | None = None) -> Headline:
    """Green where all gates are met without a warning, amber with one, red where a gate failed.

    A draft, of which the command is given, is not judged by the gates of a cloud for use: it is amber.
    """
    if verdict is None:
        return Headline("unjudged", "Not judged", "No quality gates were applied to this run.")
    gates = verdict.gates
    if num_failed := sum(not gate.passed for gate in gates):
        message = f"{num_failed} of {len(gates)} quality gates {'is' if num_failed == 1 else 'are'} not met."
        if draft_command is None:
            return Headline("failed", "Failed", f"{message} Do not use the cloud without checking it.", gates)
        sentence = (
            "A first look: it shows where a bed is found, and whether settings and flight are right. Of a cloud "
            f"for use {message} {draft_command.replace('--quality draft', '--quality standard')} makes one."
        )
        return Headline("doubtful", "Draft", sentence, gates)
    if warnings:
        them = "the warning" if len(warnings) == 1 else f"the {len(warnings)} warnings"
        sentence = f"All quality gates are met; read {them} below before use."
        return Headline("doubtful", "Passed with warnings", sentence, gates)
    return Headline("passed", "Passed", "All quality gates are met, and there are no warnings.", gates)


@dataclass(frozen=True)
class Card:
    """A number with its name, and a line of detail."""

    label: str
    value: str
    detail: str = ""


def cards(figures: ReportFigures) -> Iterator[Card]:
    """The few numbers that matter most: heights, cloud, flight, check points, distance to a reference."""
    survey, cloud, comparison = figures["survey"], figures["cloud"], figures["comparison"]
    if (std := figures["height_std_m"]) is not None:
        shared = "" if std.shared is None else f"{length(std.shared)} shared by all, "
        detail = f"{shared}{length(std.random)} random; {length(LE95 * std.whole)} at 95{NO_BREAK}%"
        yield Card("Height, one sigma, all included", length(std.whole), detail)
        stated = figures["stated"]
        if comparison is None and stated is not None and stated.orders:
            order = stated.strictest
            detail = "strictest order for 95 % of the points, by what the cloud states"
            yield Card("IHO S-44, vertical, stated", "none" if order is None else order.name, detail)
    over = (
        f"{density(cloud['density_per_m2'])} over {area(cloud['covered_area_m2'])}" if cloud["density_per_m2"] else ""
    )
    yield Card("Points of the bed", count(cloud["points"]), over)
    if (depth := cloud["depth_m"]) is not None:
        yield Card("Median depth", height(depth["median"]), f"{height(depth['min'])} to {height(depth['max'])}")
    left_out = f"{survey['views_left_out']} left out" if survey["views_left_out"] else "all used"
    yield Card("Photographs", count(survey["views_used"]), left_out)
    yield Card("Ground resolution", length(figures["plan"].gsd_m), f"from {distance(figures['plan'].height_m)} above")
    if (accuracy := figures["checkpoints"]) is not None and accuracy.groups:
        group = accuracy.groups[0]
        detail = f"RMS at {group.num} of {len(accuracy.rows)}, mean {length(group.mean_m)}"
        detail += f"; own std {length(group.own_m)}, stated by {group.num_own}" if group.num_own else ""
        yield Card("Check points", length(group.rms_m), detail)
    if comparison is not None:
        yield from _cards_of_comparison(comparison)


def _cards_of_comparison(comparison: Figures) -> Iterator[Card]:
    mean_m, std_m = comparison.distances.mean_inner90_m, comparison.distances.std_inner90_m
    unit = LengthUnit.of([std_m, mean_m])
    surface, detail = comparison.reference_surface, "mean ± std, inner 90 %"
    if surface is not None:
        detail += f"; the reference itself ± {length(surface.std_median_m)} between its points"
    yield Card("From the reference", f"{unit.number(mean_m)}{NO_BREAK}±{NO_BREAK}{unit.text(std_m)}", detail)
    if comparison.uncertainty is not None:
        yield _card_of_orders(comparison.uncertainty.iho)


def _card_of_orders(iho: IhoS44) -> Card:
    """The strictest order that all points and every depth meet; where all points alone meet a stricter one, why not."""
    strictest = iho.strictest
    pooled = next((order for order in iho.orders if order.meets_tvu), None)
    detail = "strictest order whose TVU is met at every depth"
    if pooled is not None and pooled is not strictest:
        worst = min(pooled.failing + pooled.undecided, key=lambda band: band.share_within)
        depth = compare_tables.limits_label(worst.low_m, worst.high_m, "m")
        detail += f"; at {depth} only {share(worst.share_within)} are within {pooled.name}"
    doubtful = next((order for order in iho.orders if order.is_undecided), None)
    if doubtful is not None:
        detail += f"; {doubtful.name} is undecided, as heights between the points of the reference are too uncertain"
    worth = "none" if doubtful is None else "undecided"
    return Card("IHO S-44, vertical only", worth if strictest is None else strictest.name, detail)


def _method(figures: ReportFigures) -> list[Block]:
    """How the cloud was made, for whoever did not make it."""
    made = f"{count(figures['survey']['views_used'])} photographs, their poses from {figures['survey']['poses']}."
    if (water := figures["water"]) is not None:
        made += (
            f" Every ray was bent by Snell's law where it meets the water (level {height(water['level_m'])}, index "
            f"{water['refractive_index']:.4f}) before photographs were matched: no factor on depths, no shift, no fit "
            "to a reference."
        )
    refined = " and refined by least squares over all of them" if figures["plan"].solves else ""
    made += f" Heights were searched by matching them{refined}; each point was found at one height by two or more."
    return [Text(made)]


def _limitations(figures: ReportFigures) -> list[Block]:
    """Fitness of the cloud for purposes, in sentences with this run's figures."""
    parts, std = [], figures["height_std_m"]
    if std is not None:
        message = f"A typical height is within {length(LE95 * std.whole)} of the truth in 95 of 100 cases"
        if std.shared:
            shared = length(LE95 * std.shared)
            message += f"; of that, {shared} are a common shift of all heights, which averaging does not reduce"
        parts.append(f"{message}, if level, index and positions are as accurate as stated.")
    parts.append(
        f"Things smaller than about {length(_SMALLEST_GSD * figures['plan'].gsd_m)} are smoothed away or missing; what "
        "stands on a wall or under an overhang may be missing too."
    )
    if figures["water"] is not None:
        parts += [
            "The water was taken as at rest: waves add noise, and where they do not average out, a bias. What moves, "
            "as plants and fish, is wrong or missing.",
            "The top of plants counts as bed where they hide it. No statement is made on the ground below them, nor on "
            "what lies where no bed was found.",
            "Not a nautical survey: search for obstructions and full coverage were not tested.",
        ]
    if figures["checkpoints"] is None and figures["comparison"] is None:
        parts.append("Nothing independent was measured with it: no check points, no reference.")
    return [Sentences(parts)]
