"""The figures of a comparison as tables, for the terminal and for report.html."""

import math
from typing import Any

from evaluation import DistanceStatistics, Scores
from evaluation.standards import TvuOrder
from survey.compare.figures import CheckpointFigures, Figures, VerticalUncertainty
from survey.display.blocks import Block, Rows, Section, Sentences, Table, Text
from survey.display.quantities import NO_BREAK, LengthUnit, count, is_known, length, share


def sections_of(figures: Figures) -> list[Section]:
    """All that `bathynerf compare` prints, in the order in which it is to be read."""
    sections = (
        Section("", [Rows(_inputs(figures.circumstances))]),
        Section("Distances to the reference", comparison(figures)),
        Section("Check points (ASPRS, Edition 2)", _asprs(figures.checkpoints)),
        Section("Vertical uncertainty (IHO S-44)", iho_s44(figures.uncertainty)),
    )
    return [section for section in sections if section.blocks]


def _inputs(circumstances: dict[str, Any]) -> list[tuple[str, str]]:
    labels = {"crs": "CRS", "water_level": "water level"}
    rows = [(key, circumstances[key]) for key in ("cloud", "reference", "visible", "crs", "sign", "outliers")]
    if (level := circumstances["water_level"]) is not None:
        rows.append(("water_level", f"{level:.10g}"))
    return [(labels.get(key, key), text) for key, text in rows if text is not None]


def comparison(found: Figures | None) -> list[Block]:
    """Distances to the reference and completeness, whole and in parts; nothing without a reference."""
    if found is None:
        return []
    circumstances, distances, num_cropped = found.circumstances, found.distances, found.n_cropped
    cropped = f", {count(num_cropped)} outside the bounds left out" if num_cropped else ""
    beside = f", {count(distances.n_nan)} not among the points of the reference" if distances.n_nan else ""
    rows = [
        ("method", f"{circumstances['method']}, nothing aligned or shifted"),
        ("points compared", count(distances.n_points) + cropped + beside),
    ]
    if (surface := found.reference_surface) is not None:
        between = f"± {length(surface.std_median_m)} between them (median), 95 % below {length(surface.std_95_m)}"
        rows.append(("points of the reference", f"{length(surface.spacing_m)} apart, heights {between}"))
    unit = LengthUnit.of([distances.std_m])
    values = {
        "median": distances.median_m, "rms": distances.rms_m, "NMAD": distances.nmad_m,
        "95 % of |distance|": distances.p95_abs_m, "lowest": distances.min_m, "highest": distances.max_m,
    }  # fmt: skip
    rows += [(label, unit.text(value)) for label, value in values.items()]
    method = Rows(rows)
    notes = [Sentences(circumstances["notes"])] if circumstances["notes"] else []
    bias = _bias_and_spread("part", _parts(found), unit, "Bias and spread")
    bands = [
        _bias_and_spread(name, [(limits_label(b.low, b.high, of), b.distances) for b in bands], unit, f"By {name}")
        for _, name, of, bands in found.parts.banded
    ]
    return [method, _completeness(found.tolerances), *_reached(found), bias, *bands, *notes]


def _parts(found: Figures) -> list[tuple[str, DistanceStatistics]]:
    depth = found.parts.depth
    parts = {
        "all points": found.distances,
        "vertical difference": found.vertical,
        "wet points": None if depth is None else depth.wet,
        "dry points": None if depth is None else depth.dry,
        **{f"cloud to cloud, {name.replace('_', ' the ')}": part for name, part in (found.c2c or {}).items()},
    }
    if (m3c2 := found.m3c2) is not None:
        beyond = f"{share(m3c2.significant_share)} beyond the level of detection"
        parts[f"M3C2, radius {m3c2.radius_m:g} m, {beyond}"] = m3c2.distances
    return [(name, part) for name, part in parts.items() if part is not None]


def _bias_and_spread(title: str, parts: list[tuple[str, DistanceStatistics]], unit: LengthUnit, heading: str) -> Table:
    inner = f"inner{NO_BREAK}90{NO_BREAK}%"
    names = ("mean", f"mean, 95{NO_BREAK}% confidence", "std", f"mean, {inner}", f"std, {inner}")
    titles = (title, "points", *(f"{name} [{unit.name}]" for name in names))
    intervals = [p.mean_ci95_m or (math.nan, math.nan) for _, p in parts]
    known = ["unknown" if not all(map(is_known, ends)) else " to ".join(map(unit.number, ends)) for ends in intervals]
    rows = [
        (name, count(p.n_points), unit.number(p.mean_m), interval,
         unit.number(p.std_m), unit.number(p.mean_inner90_m), unit.number(p.std_inner90_m))
        for (name, p), interval in zip(parts, known, strict=True)
    ]  # fmt: skip
    return Table(titles, rows, heading=heading)


def _completeness(tolerances: tuple[Scores, ...]) -> Table:
    """Completeness, accuracy share and F-score at each tolerance."""
    is_visible = any(is_known(scores.completeness_visible) for scores in tolerances)
    titles = ("tolerance [m]", "completeness [%]", *(["of what cameras see [%]"] if is_visible else []),
              "accuracy [%]", "F-score [%]")  # fmt: skip
    rows = []
    for scores in tolerances:
        visible = [scores.completeness_visible] if is_visible else []
        shares = [scores.completeness, *visible, scores.accuracy_share, scores.f_score]
        rows.append((f"{scores.tolerance_m:g}", *(_percent(value) for value in shares)))
    return Table(titles, rows, num_texts=0, heading="Completeness")


def _reached(found: Figures) -> list[Table]:
    """Completeness by the slope of the reference, at each tolerance; nothing without a mesh."""
    if not found.reached:
        return []
    of = "reached" if found.circumstances["visible"] is None else "of what cameras see"
    titles = ("slope of the reference", "samples", *(f"{of}, {s.tolerance_m:g} m [%]" for s in found.tolerances))
    rows = [
        (limits_label(band.low, band.high, "deg"), count(band.n_samples), *(_percent(at) for at in band.completeness))
        for band in found.reached
    ]
    return [Table(titles, rows, heading="Completeness by slope")]


def iho_s44(found: VerticalUncertainty | None) -> list[Block]:
    """Orders of IHO S-44 whose TVU is met, and by how many points in each band of depth; nothing without."""
    if found is None:
        return []
    iho = found.iho
    labels = [limits_label(band.low_m, band.high_m, "m") for band in iho.orders[0].bands]
    rows = [
        (order.name, tvu_in_words(order), f"{order.tvu_at_median_depth_m:.2f}",
         _percent(order.share_within), *(_percent(band.share_within) for band in order.bands))
        for order in iho.orders
    ]  # fmt: skip
    titles = ("order", "result", "TVU at the median depth [m]", "wet points within their TVU [%]",
              *(f"{label.replace(' ', NO_BREAK)} [%]" for label in labels))  # fmt: skip
    message = (
        f"The error of 95 % of the {count(iho.n_points)} wet points is below {length(iho.error_95_m)} ({found.error})."
    )
    return [Text(message), Table(titles, rows, num_texts=2), Text(iho.note, is_soft=True)]


def _asprs(checkpoints: CheckpointFigures | None) -> list[Block]:
    """Vertical accuracy at check points; nothing without any."""
    if checkpoints is None:
        return []
    found = checkpoints.accuracy
    enough = "enough for a test" if found.is_enough else "too few for a test"
    lengths = {
        "mean": found.mean_m, "std": found.std_m, "lowest": found.min_m, "highest": found.max_m,
        "RMSE of the cloud": found.rmse_fit_m, "RMSE of the check points": found.rmse_checkpoints_m,
        "vertical RMSE": found.rmse_v_m,
    }  # fmt: skip
    rows = [("check points", f"{found.n_checkpoints} on the cloud, {found.n_not_covered} beside it: {enough}")]
    return [Rows([*rows, *((label, length(value)) for label, value in lengths.items() if is_known(value))])]


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


def _percent(value: float | None) -> str:
    """A share for a column whose title says per cent."""
    return share(value).removesuffix("%").rstrip()
