"""The figures of a comparison as lines for a terminal: what matters first, parts in tables after it."""

from __future__ import annotations

import math

from evaluation import Band, DistanceStatistics, Scores
from survey.compare.figures import Figures, VerticalUncertainty
from survey.compare.json_numbers import numbers_of

# What a surveyor reads for a key of the JSON; keys that are not here are read as they are.
_LABELS = {
    "n_points": "points",
    "n_cropped": "cropped",
    "n_nan": "not compared",
    "mean_m": "mean",
    "median_m": "median",
    "std_m": "standard deviation",
    "mean_inner90_m": "mean of the inner 90 %",
    "std_inner90_m": "standard deviation of the inner 90 %",
    "p95_abs_m": "95 % of |distance|",
    "tolerance_m": "tolerance",
    "completeness_visible": "completeness of what cameras see",
    "accuracy_share": "accuracy",
    "f_score": "F-score",
    "crs": "CRS",
}
# What only repeats a comparison, for the JSON.
_NOT_SHOWN = ("n_samples", "seed")

Section = tuple[str | None, list[tuple[str, str]]]


def sections_of(figures: Figures) -> list[Section]:
    """Titles (None: no title) with rows of label and text, in the order in which they are to be read."""
    numbers, depth = numbers_of(figures), figures.parts.depth
    sections: list[Section] = [(None, _rows(numbers))]
    if len(figures.tolerances) > 1:
        sections.append(("By tolerance", [(f"{s.tolerance_m:g} m", _scores(s)) for s in figures.tolerances]))
    if depth is not None:
        split = {"wet": depth.wet, "dry": depth.dry}
        sections.append(("Wet and dry", [(name, _short(part)) for name, part in split.items() if part is not None]))
        sections.append(("By depth", _bands(depth.bands, "m")))
    sections.append(("By incidence", _bands(figures.parts.incidence, "deg")))
    sections.append(("By number of views", _bands(figures.parts.views, "views")))
    sections.append(("Other distances", _others(figures)))
    sections.append(("Check points (ASPRS, Edition 2)", _rows(numbers.get("asprs", {}))))
    sections.append(("Vertical uncertainty (IHO S-44), share of the points under water", _orders(figures.uncertainty)))
    sections.append((None, [("note", note) for note in figures.circumstances.notes]))
    return [section for section in sections if section[1]]


def band_label(band: dict, unit: str) -> str:
    """Limits of a band of `numbers_of`, e.g. "2 to 3 m", "30 m and more", "4 to 5 views", "20 to 25°"."""
    high = band[f"to_{unit}"]
    return limits_label(band[f"from_{unit}"], math.inf if high is None else high, unit)


def limits_label(low: float, high: float, unit: str) -> str:
    """As `band_label`, of limits of which the upper one may be infinite; unit "m", "deg" or "views"."""
    shown = {"deg": "°", "m": " m", "views": " views"}[unit]
    if math.isinf(high):
        return f"{low:g}{shown} and more"
    if unit == "views":
        return f"{low:g}{shown}" if high == low + 1 else f"{low:g} to {high - 1:g}{shown}"
    return f"{low:g} to {high:g}{shown}"


def _bands(bands: tuple[Band, ...], unit: str) -> list[tuple[str, str]]:
    return [(limits_label(band.low, band.high, unit), _short(band.distances)) for band in bands]


def _rows(numbers: dict) -> list[tuple[str, str]]:
    """Single values, an interval beside its mean."""
    rows = []
    for name, value in numbers.items():
        if value is None or isinstance(value, dict | list) or name in _NOT_SHOWN:
            continue
        unit = " m" if name.endswith("_m") else ""
        shown = f"{_metres(value)}{unit}" if isinstance(value, float) else str(value)
        interval = numbers.get(f"{name.removesuffix('_m')}_ci95_m")
        if interval is not None and None not in interval:
            shown += f" ({_metres(interval[0])} to {_metres(interval[1])} with 95 % confidence)"
        rows.append((_LABELS.get(name, name.removesuffix("_m").replace("_", " ")), shown))
    return rows


def _scores(scores: Scores) -> str:
    visible = scores.completeness_visible
    seen = "" if visible is None else f", of what cameras see {_percent(visible)}"
    return (
        f"complete {_percent(scores.completeness)}{seen}, accuracy {_percent(scores.accuracy_share)}, "
        f"F-score {_percent(scores.f_score)}"
    )


def _short(part: DistanceStatistics) -> str:
    low, high = part.mean_ci95_m or (math.nan, math.nan)
    interval = "" if math.isnan(low) else f" ({_metres(low)} to {_metres(high)})"
    return (
        f"mean {_metres(part.mean_m)}{interval}, std {_metres(part.std_m)}; inner 90 %: mean "
        f"{_metres(part.mean_inner90_m)}, std {_metres(part.std_inner90_m)} m; {part.n_points} points"
    )


def _others(figures: Figures) -> list[tuple[str, str]]:
    rows = []
    if figures.vertical is not None:
        part = figures.vertical.distances
        rows.append(("vertical", f"{_short(part)}, {part.n_nan} more have no surface above or below"))
    if figures.c2c is not None:
        rows.append(("cloud to cloud, to reference", _short(figures.c2c.to_reference)))
        rows.append(("cloud to cloud, to cloud", _short(figures.c2c.to_cloud)))
    if (m3c2 := figures.m3c2) is not None:
        detection = f"{_percent(m3c2.significant_share)} over the level of detection"
        rows.append((f"M3C2, radius {m3c2.radius_m:g} m", f"{_short(m3c2.distances)}, {detection}"))
    return rows


def _orders(uncertainty: VerticalUncertainty | None) -> list[tuple[str, str]]:
    if uncertainty is None:
        return []
    rows = []
    for order in uncertainty.iho.orders:
        meets = "meets" if order.meets_tvu else "does not meet"
        shares = [f"{limits_label(band.low_m, band.high_m, 'm')} {_percent(band.share_within)}" for band in order.bands]
        rows.append((order.name, f"{_percent(order.share_within)}, {meets} the TVU ({', '.join(shares)})"))
    return [*rows, ("judged", f"the {uncertainty.error}. {uncertainty.iho.note}")]


def _metres(value: float) -> str:
    # Rounded first, so that a mean of -1e-6 m is not shown as -0.0000 m.
    return "unknown" if math.isnan(value) else f"{round(value, 4) + 0.0:.4f}"


def _percent(share: float) -> str:
    return "unknown" if math.isnan(share) else f"{100.0 * share:.1f} %"
