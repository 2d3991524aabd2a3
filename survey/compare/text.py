"""The figures of a comparison as lines for a terminal."""

from __future__ import annotations

import math

from evaluation import Band, DistanceStatistics, Scores
from evaluation.standards import TvuOrder
from survey.compare.figures import CheckpointFigures, Circumstances, Figures, ReferenceSurface, VerticalUncertainty

Section = tuple[str | None, list[tuple[str, str]]]


def sections_of(figures: Figures) -> list[Section]:
    """Titles (None: no title) with rows of label and text, in the order in which they are to be read."""
    depth = figures.parts.depth
    sections: list[Section] = [(None, _overall(figures))]
    if len(figures.tolerances) > 1:
        sections.append(("By tolerance", [(f"{s.tolerance_m:g} m", _scores(s)) for s in figures.tolerances]))
    if depth is not None:
        split = {"wet": depth.wet, "dry": depth.dry}
        sections.append(("Wet and dry", [(name, _short(part)) for name, part in split.items() if part is not None]))
        sections.append(("By depth", _bands(depth.bands, "m")))
    sections.append(("By incidence", _bands(figures.parts.incidence, "deg")))
    sections.append(("By number of views", _bands(figures.parts.views, "views")))
    sections.append(("By slope of the reference", _bands(figures.parts.slope, "deg")))
    sections.append((f"Completeness{_of_seen(figures)} by slope of the reference", _reached(figures)))
    sections.append(("Other distances", _others(figures)))
    sections.append(("Check points (ASPRS, Edition 2)", _asprs(figures.checkpoints)))
    sections.append(("Vertical uncertainty (IHO S-44), share of the points under water", _orders(figures.uncertainty)))
    sections.append((None, [("note", note) for note in figures.circumstances.notes]))
    return [section for section in sections if section[1]]


def limits_label(low: float, high: float, unit: str) -> str:
    """Limits of a band, the upper one perhaps infinite, in "m", "deg" or "views".

    Examples
    --------
    >>> limits_label(2.0, 3.0, "m"), limits_label(30.0, math.inf, "m"), limits_label(4, 6, "views")
    ('2 to 3 m', '30 m and more', '4 to 5 views')
    """
    shown = {"deg": "°", "m": " m", "views": " views"}[unit]
    if math.isinf(high):
        return f"{low:g}{shown} and more"
    if unit == "views":
        return f"{low:g}{shown}" if high == low + 1 else f"{low:g} to {high - 1:g}{shown}"
    return f"{low:g} to {high:g}{shown}"


def tvu_in_words(order: TvuOrder) -> str:
    """Whether an order's vertical uncertainty is met, and at which depths it is not although all points meet it."""
    if order.is_undecided:
        return "undecided, by heights between the points of the reference"
    if not order.meets_tvu:
        return "does not meet the TVU"
    parts = {"but not at": order.failing, "undecided at": order.undecided}
    at = [
        f", {limits} {', '.join(limits_label(band.low_m, band.high_m, 'm') for band in bands)}"
        for limits, bands in parts.items()
        if bands
    ]
    return "".join(["meets the TVU", *at])


def _bands(bands: tuple[Band, ...], unit: str) -> list[tuple[str, str]]:
    return [(limits_label(band.low, band.high, unit), _short(band.distances)) for band in bands]


def _overall(figures: Figures) -> list[tuple[str, str]]:
    """Figures of all points, at the first tolerance, with the method."""
    distances, scores = figures.summary.distances, figures.summary.scores
    return _known([
        ("points", str(distances.n_points)),
        ("cropped", str(figures.summary.n_cropped)),
        ("not compared", str(distances.n_nan)),
        ("mean", _length(distances.mean_m, distances.mean_ci95_m)),
        ("median", _length(distances.median_m)),
        ("standard deviation", _length(distances.std_m)),
        ("rms", _length(distances.rms_m)),
        ("mean of the inner 90 %", _length(distances.mean_inner90_m, distances.mean_inner90_ci95_m)),
        ("standard deviation of the inner 90 %", _length(distances.std_inner90_m)),
        ("NMAD", _length(distances.nmad_m)),
        ("95 % of |distance|", _length(distances.p95_abs_m)),
        ("min", _length(distances.min_m)),
        ("max", _length(distances.max_m)),
        ("completeness", _decimal(scores.completeness)),
        ("accuracy", _decimal(scores.accuracy_share)),
        ("F-score", _decimal(scores.f_score)),
        ("tolerance", _length(scores.tolerance_m)),
        *_reference_surface(figures.reference_surface),
        ("completeness of what cameras see", _decimal(scores.completeness_visible)),
        *_circumstances(figures.circumstances),
    ])  # fmt: skip


def _reference_surface(surface: ReferenceSurface | None) -> list[tuple[str, str | None]]:
    if surface is None:
        return []
    between = f"± {_metres(surface.std_median_m)} m (median), 95 % below {_metres(surface.std_95_m)} m"
    return [("spacing of the reference", _length(surface.spacing_m)), ("its heights between points", between)]


def _circumstances(circumstances: Circumstances) -> list[tuple[str, str | None]]:
    return [
        ("outliers", circumstances.outliers),
        ("water level", _decimal(circumstances.water_level)),
        ("method", circumstances.method),
        ("sign", circumstances.sign),
        ("CRS", circumstances.crs),
        ("cloud", circumstances.cloud),
        ("reference", circumstances.reference),
        ("visible", circumstances.visible),
    ]


def _asprs(checkpoints: CheckpointFigures | None) -> list[tuple[str, str]]:
    if checkpoints is None:
        return []
    accuracy = checkpoints.accuracy
    return _known([
        ("check points", str(accuracy.n_checkpoints)),
        ("not covered", str(accuracy.n_not_covered)),
        ("enough", "yes" if accuracy.is_enough else "no"),
        ("mean", _length(accuracy.mean_m)),
        ("std", _length(accuracy.std_m)),
        ("min", _length(accuracy.min_m)),
        ("max", _length(accuracy.max_m)),
        ("RMSE of the cloud", _length(accuracy.rmse_fit_m)),
        ("RMSE of the check points", _length(accuracy.rmse_checkpoints_m)),
        ("vertical RMSE", _length(accuracy.rmse_v_m)),
    ])  # fmt: skip


def _known(rows: list[tuple[str, str | None]]) -> list[tuple[str, str]]:
    return [(label, text) for label, text in rows if text is not None]


def _length(value: float, interval: tuple[float, float] | None = None) -> str | None:
    """A length [m] with its confidence interval, if there is one; None where it is not known."""
    if not math.isfinite(value):
        return None
    if interval is None or not all(math.isfinite(end) for end in interval):
        return f"{_metres(value)} m"
    low, high = interval
    return f"{_metres(value)} m ({_metres(low)} to {_metres(high)} with 95 % confidence)"


def _decimal(value: float | None) -> str | None:
    """A number without a unit; None where it is not known."""
    return None if value is None or not math.isfinite(value) else _metres(value)


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


def _of_seen(figures: Figures) -> str:
    return "" if figures.circumstances.visible is None else " of what cameras see"


def _reached(figures: Figures) -> list[tuple[str, str]]:
    rows = []
    for band in figures.reached:
        at = zip(figures.tolerances, band.completeness, strict=True)
        shares = ", ".join(f"{_percent(share)} at {scores.tolerance_m:g} m" for scores, share in at)
        rows.append((limits_label(band.low, band.high, "deg"), f"{shares}; {band.n_samples} samples"))
    return rows


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
        shares = [f"{limits_label(band.low_m, band.high_m, 'm')} {_percent(band.share_within)}" for band in order.bands]
        rows.append((order.name, f"{_percent(order.share_within)}, {tvu_in_words(order)} ({', '.join(shares)})"))
    return [*rows, ("judged", f"the {uncertainty.error}. {uncertainty.iho.note}")]


def _metres(value: float) -> str:
    # Rounded first, so that a mean of -1e-6 m is not shown as -0.0000 m.
    return "unknown" if math.isnan(value) else f"{round(value, 4) + 0.0:.4f}"


def _percent(share: float) -> str:
    return "unknown" if math.isnan(share) else f"{100.0 * share:.1f} %"
