"""The numbers of a comparison as lines for a terminal: what matters first, parts in tables after it."""

from __future__ import annotations

Section = tuple[str | None, list[tuple[str, str]]]

_BANDS = (
    ("depth_bands", "By depth", "m"),
    ("incidence_bands", "By incidence", "deg"),
    ("views_bands", "By number of views", "views"),
)


def sections_of(numbers: dict) -> list[Section]:
    """Titles (None: no title) with rows of label and text, in the order in which they are to be read."""
    sections = [(None, _rows(numbers))]
    tolerances = numbers.get("tolerances") or []
    if len(tolerances) > 1:
        sections.append(("By tolerance", [(f"{t['tolerance_m']:g} m", _scores(t)) for t in tolerances]))
    split = [(name, _short(numbers[name])) for name in ("wet", "dry") if numbers.get(name)]
    sections.append(("Wet and dry", split))
    for key, title, unit in _BANDS:
        sections.append((title, [(band_label(band, unit), _short(band)) for band in numbers.get(key) or []]))
    sections.append(("Other distances", _others(numbers)))
    sections.append(("Check points (ASPRS, Edition 2)", _rows(numbers.get("asprs") or {})))
    sections.append(
        ("Vertical uncertainty (IHO S-44), share of the points under water", _orders(numbers.get("iho_s44")))
    )
    sections.append((None, [("note", note) for note in numbers.get("notes") or []]))
    return [section for section in sections if section[1]]


def band_label(band: dict, unit: str) -> str:
    """Limits of a band, e.g. "2 to 3 m", "30 m and more", "4 to 5 views", "20 to 25°"."""
    low, high = band[f"from_{unit}"], band[f"to_{unit}"]
    shown = {"deg": "°", "m": " m", "views": " views"}[unit]
    if high is None:
        return f"{low:g}{shown} and more"
    if unit == "views":
        return f"{low:g}{shown}" if high == low + 1 else f"{low:g} to {high - 1:g}{shown}"
    return f"{low:g} to {high:g}{shown}"


def _rows(numbers: dict) -> list[tuple[str, str]]:
    """Single values, an interval beside its mean."""
    rows = []
    for name, value in numbers.items():
        if value is None or isinstance(value, dict | list):
            continue
        unit = " m" if name.endswith("_m") else ""
        shown = f"{_metres(value)}{unit}" if isinstance(value, float) else str(value)
        interval = numbers.get(f"{name.removesuffix('_m')}_ci95_m")
        if interval is not None and None not in interval:
            shown += f" ({_metres(interval[0])} to {_metres(interval[1])} with 95 % confidence)"
        rows.append((name.removesuffix("_m").replace("_", " "), shown))
    return rows


def _scores(t: dict) -> str:
    visible = (
        "" if t.get("completeness_visible") is None else f", of what cameras see {_percent(t['completeness_visible'])}"
    )
    return (
        f"complete {_percent(t['completeness'])}{visible}, accuracy {_percent(t['accuracy_share'])}, "
        f"F-score {_percent(t['f_score'])}"
    )


def _short(part: dict) -> str:
    low, high = part.get("mean_ci95_m") or (None, None)
    interval = "" if low is None else f" ({_metres(low)} to {_metres(high)})"
    return (
        f"mean {_metres(part['mean_m'])}{interval}, std {_metres(part['std_m'])}; inner 90 %: mean "
        f"{_metres(part['mean_inner90_m'])}, std {_metres(part['std_inner90_m'])} m; {part['n_points']} points"
    )


def _others(numbers: dict) -> list[tuple[str, str]]:
    rows = []
    if vertical := numbers.get("vertical"):
        rows.append(("vertical", f"{_short(vertical)}, {vertical['n_holes']} more have no surface above or below"))
    for name, part in (numbers.get("c2c") or {}).items():
        rows.append((f"cloud to cloud, {name.replace('_', ' ')}", _short(part)))
    if m3c2 := numbers.get("m3c2"):
        detection = f"{_percent(m3c2['significant_share'])} over the level of detection"
        rows.append((f"M3C2, radius {m3c2['radius_m']:g} m", f"{_short(m3c2)}, {detection}"))
    return rows


def _orders(iho: dict | None) -> list[tuple[str, str]]:
    if not iho:
        return []
    rows = []
    for order in iho["orders"]:
        meets = "meets" if order["meets_tvu"] else "does not meet"
        by_depth = ", ".join(f"{band_label(b, 'm')} {_percent(b['share_within'])}" for b in order["depth_bands"])
        rows.append((order["order"], f"{_percent(order['share_within'])}, {meets} the TVU ({by_depth})"))
    return [*rows, ("judged", f"the {iho['error']}. {iho['note']}")]


def _metres(value: float | None) -> str:
    # Rounded first, so that a mean of -1e-6 m is not shown as -0.0000 m.
    return "unknown" if value is None else f"{round(value, 4) + 0.0:.4f}"


def _percent(share: float | None) -> str:
    return "unknown" if share is None else f"{100.0 * share:.1f} %"
