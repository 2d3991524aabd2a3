"""The tables of report.html about the distance to a reference, from the figures of a report."""

from __future__ import annotations

from survey.compare.text import band_label
from survey.display.quantities import NO_BREAK, LengthUnit, count, length, share
from survey.report.blocks import Block, Rows, Sentences, Table, Text

_BANDS = (
    ("depth_bands", "depth", "m"),
    ("incidence_bands", "incidence", "deg"),
    ("views_bands", "views that agree", "views"),
)


def comparison(c: dict | None) -> list[Block]:
    """Distances to the reference and completeness, whole and in parts; nothing without a reference."""
    if not c:
        return []
    cropped = f", {count(c['n_cropped'])} outside the bounds left out" if c["n_cropped"] else ""
    method = Rows([
        ("method", f"{c['method']}, nothing aligned or shifted"),
        ("points compared", count(c["n_points"]) + cropped),
    ])  # fmt: skip
    unit = LengthUnit.of([c["std_m"]])
    vertical = [("vertical difference", c["vertical"])] if c.get("vertical") else []
    parts = [("all points", c), *vertical, *((f"{name} points", c[name]) for name in ("wet", "dry") if c.get(name))]
    tables = [_bias_and_spread("part", parts, unit, "Bias and spread")]
    for key, title, of in _BANDS:
        bands = [(band_label(band, of), band) for band in c.get(key) or []]
        if bands:
            tables.append(_bias_and_spread(title, bands, unit, f"By {title}"))
    notes = [Sentences(c["notes"])] if c["notes"] else []
    return [method, _completeness(c), *tables, *notes]


def _bias_and_spread(title: str, parts: list[tuple[str, dict]], unit: LengthUnit, heading: str) -> Table:
    inner = f"inner{NO_BREAK}90{NO_BREAK}%"
    names = ("mean", f"mean, 95{NO_BREAK}% confidence", "std", f"mean, {inner}", f"std, {inner}")
    titles = (title, "points", *(f"{name} [{unit.name}]" for name in names))
    rows = [
        (name, count(p["n_points"]), unit.number(p["mean_m"]), _interval(p.get("mean_ci95_m"), unit),
         unit.number(p["std_m"]), unit.number(p["mean_inner90_m"]), unit.number(p["std_inner90_m"]))
        for name, p in parts
    ]  # fmt: skip
    return Table(titles, rows, heading=heading)


def _interval(interval: list | None, unit: LengthUnit) -> str:
    if interval is None or None in interval:
        return "unknown"
    return f"{unit.number(interval[0])} to {unit.number(interval[1])}"


def _completeness(c: dict) -> Table:
    """Completeness, accuracy share and F-score at each tolerance."""
    tolerances = c.get("tolerances") or [c]
    is_visible = any(t.get("completeness_visible") is not None for t in tolerances)
    titles = ("tolerance [m]", "reference reached [%]", *(["of what cameras see [%]"] if is_visible else []),
              "points this near [%]", "F-score [%]")  # fmt: skip
    rows = []
    for t in tolerances:
        visible = [t.get("completeness_visible")] if is_visible else []
        shares = [t["completeness"], *visible, t["accuracy_share"], t["f_score"]]
        rows.append((f"{t['tolerance_m']:g}", *(_percent(value) for value in shares)))
    return Table(titles, rows, num_texts=0, heading="Completeness")


def iho_s44(iho: dict | None) -> list[Block]:
    """Which orders' vertical uncertainty is met, and by how many points in each band of depth; nothing without."""
    if not iho:
        return []
    bands = [f"{band_label(band, 'm').replace(' ', NO_BREAK)} [%]" for band in iho["orders"][0]["depth_bands"]]
    rows = [
        (o["order"], "meets TVU" if o["meets_tvu"] else "does not meet TVU", f"{o['tvu_at_median_depth_m']:.2f}",
         _percent(o["share_within"]), *(_percent(band["share_within"]) for band in o["depth_bands"]))
        for o in iho["orders"]
    ]  # fmt: skip
    titles = ("order", "", "TVU at the median depth [m]", "wet points within their TVU [%]", *bands)
    said = (
        f"The error of 95 % of the {count(iho['points'])} wet points is below {length(iho['error_95_m'])} "
        f"({iho['error']})."
    )
    return [Text(said), Table(titles, rows, num_texts=2), Text(iho["note"], is_soft=True)]


def baselines(b: dict | None) -> list[Block]:
    """Vertical errors of other methods beside those of this run; nothing without water or reference."""
    if not b:
        return []
    keys = ("median_m", "nmad_m", "mean_m")
    # In the digits of what was measured, of which the predictions have too few.
    measured = [row for row in b["rows"] if row["kind"] == "measured"] or b["rows"]
    unit = LengthUnit.of([row[key] for row in measured for key in keys])
    rows = [(row["name"], row["kind"], *(unit.number(row[key]) for key in keys)) for row in b["rows"]]
    titles = ("method", "", *(f"{name} [{unit.name}]" for name in ("median", "spread (NMAD)", "mean")))
    return [Table(titles, rows, num_texts=2), Text(b["note"], is_soft=True)]


def _percent(value: float | None) -> str:
    """A share for a column whose title says per cent."""
    return share(value).removesuffix("%").rstrip()
