"""report.html: the figures of a report as one page that needs nothing else, for screen and paper."""

from __future__ import annotations

import base64
from html import escape

from survey.progress import clock
from survey.report import tables
from survey.report.shading import Picture
from survey.report.tables import count, length

_CSS = """
:root { --ink: #22303c; --soft: #5d6a76; --line: #dfe4e8; --wash: #f4f7f8; --blue: #2f6f9f; --warn: #a05a00; }
* { box-sizing: border-box; }
body { margin: 0; background: white; color: var(--ink);
  font: 15px/1.5 "Segoe UI", "Helvetica Neue", Helvetica, Arial, "Liberation Sans", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0; letter-spacing: -0.01em; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 0.8rem; padding-bottom: 0.3rem;
  border-bottom: 2px solid var(--line); }
p { margin: 0.4rem 0; max-width: 46rem; }
.soft, figcaption, .cards span { color: var(--soft); }
.cards { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1.6rem 0; }
.cards div { flex: 1 1 9rem; background: var(--wash); border-radius: 6px; padding: 0.7rem 0.9rem; }
.cards b { display: block; font-size: 1.45rem; line-height: 1.3; font-weight: 600; }
.cards span { font-size: 0.85rem; }
.notes { border-left: 4px solid var(--blue); background: var(--wash); padding: 0.5rem 1rem;
  margin: 0.8rem 0; }
.notes.warn { border-color: var(--warn); background: #fbf5ec; }
.notes ul { margin: 0.2rem 0; padding-left: 1.2rem; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
table + table { margin-top: 1.2rem; }
th, td { text-align: left; vertical-align: top; padding: 0.32rem 0.9rem 0.32rem 0;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; }
tbody th { font-weight: 400; color: var(--soft); width: 15rem; }
td:first-child { white-space: nowrap; }
td.number, th.number { text-align: right; padding-right: 0; padding-left: 0.9rem; }
figure { margin: 0 0 1.8rem; max-width: 46rem; break-inside: avoid; }
figure.wide { max-width: none; }
figure img { width: 100%; height: auto; display: block; }
figcaption { font-size: 0.85rem; margin-top: 0.3rem; }
pre { font: 0.8rem/1.45 ui-monospace, Consolas, "DejaVu Sans Mono", monospace; background: var(--wash);
  padding: 0.8rem 1rem; border-radius: 6px; white-space: pre-wrap; overflow-wrap: anywhere; }
@media print { @page { margin: 16mm; } body { font-size: 10pt; } main { padding: 0; max-width: none; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } figure { max-width: 34rem; }
  .cards div, .notes, pre { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
"""
# These show several things side by side and take the whole width.
_WIDE = ("view", "histograms", "profile", "error_bands")


def render_page(figures: dict, pictures: list[Picture]) -> str:
    """The page.

    Parameters
    ----------
    figures : dict
        From `survey.report.facts.figures_of`.
    pictures : list of Picture
        Their files are put into the page.

    Returns
    -------
    str
        HTML without scripts and without anything to load.
    """
    name = figures["survey"]["name"]
    sections = [
        _head(figures),
        _sentences(figures),
        _section("Pictures", "".join(_figure(p) for p in pictures)),
        _section("Against the reference", tables.comparison(figures["comparison"])),
        _section("Vertical uncertainty (IHO S-44)", tables.iho_s44(figures["iho_s44"])),
        _section("What bending the rays is worth", tables.baselines(figures["baselines"])),
        _section("The cloud", tables.cloud(figures["cloud"])),
        _section("Survey and water", tables.survey(figures["survey"], figures["water"], figures["plan"])),
        _section("What was done, and why", tables.decisions(figures["plan"]["decisions"])),
        _section("Time", tables.rows([(stage, clock(s)) for stage, s in figures["timings_s"].items()])),
        _section("Versions", tables.rows(list(figures["versions"].items()))),
        _section("Settings", f"<pre>{escape(tables.settings(figures['settings']))}</pre>"),
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(name)}: report of bathynerf</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        "<main>\n" + "\n".join(section for section in sections if section) + "\n</main>\n</body>\n</html>\n"
    )


def _head(figures: dict) -> str:
    survey, cloud, comparison = figures["survey"], figures["cloud"], figures["comparison"]
    code = f" ({survey['crs']['code']})" if survey["crs"]["code"] else ""
    cards = [(count(cloud["points"]), "points of the bed")]
    if cloud["depth_m"]:
        depth = cloud["depth_m"]
        cards.append((f"{depth['median']:.2f} m", f"median depth, {depth['min']:.2f} to {depth['max']:.2f} m"))
    if cloud["std_m"]:
        cards.append((length(cloud["std_m"]["median"]), "median standard deviation"))
    if cloud["density_per_m2"]:
        cards.append((count(cloud["density_per_m2"]), "points per m²"))
    cards.append((str(survey["views_used"]), "views used"))
    if comparison:
        inner = f"{length(comparison['mean_inner90_m'])} ± {length(comparison['std_inner90_m'])}"
        cards.append((inner, "from the reference, inner 90 %"))
    return (
        f"<header><h1>{escape(survey['name'])}</h1>"
        f'<p class="soft">Point cloud of the bed, in {escape(survey["crs"]["name"] + code)}</p>'
        '<div class="cards">'
        + "".join(f"<div><b>{escape(value)}</b><span>{escape(label)}</span></div>" for value, label in cards)
        + "</div></header>"
    )


def _sentences(figures: dict) -> str:
    boxes = []
    for key, title, kind in (
        ("warnings", "Warnings", "notes warn"),
        ("notes", "Notes", "notes"),
        ("assumptions", "Assumed, because nothing said otherwise", "notes"),
    ):
        if figures[key]:
            items = "".join(f"<li>{escape(text)}</li>" for text in figures[key])
            boxes.append(f'<div class="{kind}"><b>{title}</b><ul>{items}</ul></div>')
    return "".join(boxes)


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode()
    kind = ' class="wide"' if picture.path.stem in _WIDE else ""
    return (
        f'<figure{kind}><img alt="{escape(picture.title)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>" if body else ""
