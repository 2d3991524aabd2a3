"""The tables of report.html, from the figures of a report."""

from __future__ import annotations

import json
from html import escape

from survey.compare.text import band_label


def comparison(c: dict | None) -> str:
    """Distances to the reference and completeness, whole and in parts; empty without a reference."""
    if not c:
        return ""
    within = f"closer than {c['tolerance_m']:g} m"
    lines = [
        ("method", f"{c['method']}, nothing aligned or shifted"),
        ("points compared", f"{count(c['n_points'])} ({count(c['n_cropped'])} outside the bounds)"),
        (
            "inner 90 %",
            f"mean {length(c['mean_inner90_m'])}, standard deviation {length(c['std_inner90_m'])}",
        ),
        ("median", length(c["median_m"])),
        (
            "all points",
            f"mean {length(c['mean_m'])} ({_interval(c.get('mean_ci95_m'))} with 95 % confidence), standard deviation "
            f"{length(c['std_m'])}, root mean square {length(c['rms_m'])}",
        ),
        ("completeness", f"{share(c['completeness'])} of the reference {within}"),
    ]
    if c.get("completeness_visible") is not None:
        lines.append(("completeness, visible", f"{share(c['completeness_visible'])} of what cameras see {within}"))
    lines += [
        ("accuracy share", f"{share(c['accuracy_share'])} of the points {within}"),
        ("F-score", share(c["f_score"])),
    ]
    notes = "".join(f"<li>{escape(text)}</li>" for text in c["notes"])
    return rows(lines) + _by_tolerance(c) + _parts(c) + (f'<ul class="soft">{notes}</ul>' if notes else "")


def _parts(c: dict) -> str:
    """Tables of bias and spread: wet and dry, by depth, by incidence, by number of views, where there are any."""
    vertical = [("vertical difference", c["vertical"])] if c.get("vertical") else []
    parts = [("all", c), *vertical, *((name, c[name]) for name in ("wet", "dry") if c.get(name))]
    tables = [_bias_and_spread("part", parts)]
    for key, title, unit in (
        ("depth_bands", "depth", "m"),
        ("incidence_bands", "incidence at the water", "deg"),
        ("views_bands", "views that agree", "views"),
    ):
        bands = [(band_label(band, unit), band) for band in c.get(key) or []]
        tables.append(_bias_and_spread(title, bands) if bands else "")
    return "".join(tables)


def _bias_and_spread(title: str, parts: list[tuple[str, dict]]) -> str:
    titles = (title, "points", "mean", "95 % confidence", "standard deviation", "mean, inner 90 %", "std, inner 90 %")
    lines = [
        (name, count(p["n_points"]), length(p["mean_m"]), _interval(p.get("mean_ci95_m")), length(p["std_m"]),
         length(p["mean_inner90_m"]), length(p["std_inner90_m"]))
        for name, p in parts
    ]  # fmt: skip
    return table(titles, lines)


def _interval(interval: list | None) -> str:
    if interval is None or None in interval:
        return "unknown"
    return f"{length(interval[0])} to {length(interval[1])}"


def _by_tolerance(c: dict) -> str:
    tolerances = c.get("tolerances") or []
    if len(tolerances) < 2:
        return ""
    titles = ("tolerance", "complete", "complete, of what cameras see", "accuracy share", "F-score")
    lines = [
        (f"{t['tolerance_m']:g} m", share(t["completeness"]), share(t.get("completeness_visible")),
         share(t["accuracy_share"]), share(t["f_score"]))
        for t in tolerances
    ]  # fmt: skip
    return table(titles, lines)


def iho_s44(iho: dict | None) -> str:
    """Which orders' vertical uncertainty is met, and by how many points in each band of depth; empty without."""
    if not iho:
        return ""
    bands = [band_label(band, "m") for band in iho["orders"][0]["depth_bands"]]
    lines = [
        (o["order"], length(o["tvu_at_median_depth_m"]), share(o["share_within"]),
         "meets TVU" if o["meets_tvu"] else "does not meet TVU", *(share(b["share_within"]) for b in o["depth_bands"]))
        for o in iho["orders"]
    ]  # fmt: skip
    titles = ("order", "TVU at the median depth", "wet points within their TVU", "", *bands)
    said = f"95 % of {count(iho['points'])} wet points err by less than {length(iho['error_95_m'])} ({iho['error']})."
    return f"<p>{escape(said)}</p>" + table(titles, lines) + f'<p class="soft">{escape(iho["note"])}</p>'


def baselines(b: dict | None) -> str:
    """Vertical errors of other ways beside those of this run; empty without water or reference."""
    if not b:
        return ""
    lines = [
        (row["name"], row["kind"], length(row["median_m"]), length(row["nmad_m"]), length(row["mean_m"]))
        for row in b["rows"]
    ]
    titles = ("way", "", "median", "spread (NMAD)", "mean")
    return table(titles, lines, num_texts=2) + f'<p class="soft">{escape(b["note"])}</p>'


def cloud(c: dict) -> str:
    """Number of points, density, and how depth, spread, views and incidence are distributed."""
    parts = f"{count(c['points_wet'])} wet, {count(c['points_dry'])} dry"
    lines = [("points", f"{count(c['points'])}: {parts}")]
    if c["density_per_m2"]:
        area = f"{count(c['density_per_m2'])} points per m² over {c['covered_area_m2']:.0f} m²"
        lines.append(("density", area))
    if c["wet_pixel_share"] is not None:
        lines.append(("wet pixels with a point", share(c["wet_pixel_share"])))
    distributions = (
        ("depth_m", "true depth", lambda v: f"{v:.2f} m"),
        ("std_m", "standard deviation", length),
        ("views_per_point", "views per point", lambda v: f"{v:.3g}"),
        ("incidence_deg", "incidence", lambda v: f"{v:.1f}°"),
    )
    lines += [(label, _spread(c[key], show)) for key, label, show in distributions if c[key]]
    if c["extent"]:
        low, high = c["extent"]["low"], c["extent"]["high"]
        names = ("easting", "northing", "height")
        said = ", ".join(f"{n} {a:.10g} to {b:.10g}" for n, a, b in zip(names, low, high, strict=True))
        lines.append(("extent", said))
    return rows(lines)


def survey(s: dict, water: dict | None, plan: dict) -> str:
    """Where, with what, from how high, and through which water."""
    code = f", {s['crs']['code']}" if s["crs"]["code"] else ""
    width, height = s["image_size_px"]
    lines = [
        ("coordinate reference system", s["crs"]["name"] + code),
        ("views", f"{s['views_used']} used, {s['views_left_out']} left out"),
        ("images", f"{width} x {height} px, focal length {s['focal_px']:.1f} px"),
        ("poses", s["poses"]),
        ("flying height", f"{plan['height_m']:.1f} m, one image covers {_by(plan['footprint_m'])} m"),
        ("ground sampling distance", length(plan["gsd_m"])),
    ]
    if s["bounds"]:
        e0, n0, e1, n1 = (f"{v:.10g}" for v in s["bounds"])
        lines.append(("bounds", f"{e0} to {e1} east, {n0} to {n1} north"))
    if water is None:
        return rows([*lines, ("water", "none: a dry survey")])
    at = ", ".join(f"{v:.10g}" for v in water["level_at"])
    slope = f"{water['slope_east']:g} to the east, {water['slope_north']:g} to the north"
    lines += [
        ("water level", f"{water['level_m']:g} m at {at} (from {water['level_from']})"),
        ("slope of the water", f"{slope} (from {water['slope_from']})"),
        ("refractive index", f"{water['refractive_index']:g} (from {water['refractive_index_from']})"),
    ]
    return rows(lines)


def decisions(plan: list[dict]) -> str:
    """The plan with its reasons."""
    lines = [(d["name"], d["choice"], d["reason"]) for d in plan]
    return table(("decision", "choice", "reason"), lines, num_texts=3)


def settings(values: dict, prefix: str = "") -> str:
    """Settings as lines of ``section.key = value``, those without a value left out."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict):
            lines.append(settings(value, f"{prefix}{name}."))
        elif value is not None:
            lines.append(f"{prefix}{name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(line for line in lines if line)


def rows(lines: list[tuple[str, str]]) -> str:
    """A table of labels and texts."""
    body = "".join(f"<tr><th>{escape(label)}</th><td>{escape(text)}</td></tr>" for label, text in lines)
    return f"<table><tbody>{body}</tbody></table>"


def table(titles: tuple[str, ...], lines: list[tuple[str, ...]], num_texts: int = 1) -> str:
    """A table with a line of titles; all but the first ``num_texts`` columns hold numbers."""
    kinds = ["" if i < num_texts else ' class="number"' for i in range(len(titles))]
    head = "".join(f"<th{k}>{escape(t)}</th>" for k, t in zip(kinds, titles, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{k}>{escape(t)}</td>" for k, t in zip(kinds, line, strict=True)) + "</tr>"
        for line in lines
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def length(value_m: float | None) -> str:
    """A length [m]: 12.3 mm below half a metre, else 1.23 m; with a true minus sign."""
    if value_m is None:
        return "unknown"
    text = f"{1000.0 * value_m:z.1f} mm" if abs(value_m) < 0.5 else f"{value_m:.2f} m"
    return text.replace("-", "−")


def share(value: float | None) -> str:
    """A share of one as per cent."""
    return "unknown" if value is None else f"{100.0 * value:.1f} %"


def count(value: float) -> str:
    """A whole number in groups of three, e.g. 1 234 567, that does not break."""
    return f"{round(value):,}".replace(",", "\u202f")


def _spread(values: dict[str, float], show) -> str:
    names = {"p95": "95 % below"}
    return ", ".join(f"{names.get(name, name)} {show(value)}" for name, value in values.items())


def _by(sides: list[float]) -> str:
    return " x ".join(f"{side:.1f}" for side in sides)
