"""The figures of a comparison as plain values: what ``compare --json`` and report.json hold, key by key."""

from __future__ import annotations

import math
from dataclasses import asdict

from evaluation import Band, DepthParts, DistanceStatistics, ReachedBand, Scores
from evaluation.bootstrap import LEVEL, NUM_DRAWS, SEED
from evaluation.standards import TvuOrder
from survey.compare.figures import Checkpoints, Circumstances, Figures, Parts, Vertical, VerticalUncertainty
from survey.files.json_values import plain


def numbers_of(figures: Figures) -> dict:
    """The figures as dicts, lists, numbers and texts.

    Returns
    -------
    dict
        At the top `evaluation.DistanceStatistics` and `evaluation.Scores` over all points (the latter at the first
        tolerance), ``n_cropped``, ``wet``, ``dry``, the bands, ``completeness_by_slope`` (one share for each
        tolerance) and the circumstances; below it ``tolerances``,
        ``vertical``, ``iho_s44``, ``reference_surface``, ``asprs``, ``c2c`` and ``m3c2``. What was not requested is
        missing; a value that does not exist is None.
    """
    summary = figures.summary
    statistics = _known(summary.distances)
    numbers = {"n_points": statistics.pop("n_points"), "n_cropped": summary.n_cropped} | statistics
    numbers |= _known(summary.scores) | {"tolerances": [_known(s) for s in figures.tolerances]}
    numbers |= _parts(figures.parts) | _reached(figures.reached)
    if figures.vertical is not None:
        numbers["vertical"] = _vertical(figures.vertical)
    if figures.uncertainty is not None:
        numbers["iho_s44"] = _iho_s44(figures.uncertainty)
    if figures.reference_surface is not None:
        numbers["reference_surface"] = asdict(figures.reference_surface)
    if figures.checkpoints is not None:
        numbers["asprs"] = _asprs(figures.checkpoints)
    if figures.c2c is not None:
        numbers["c2c"] = {
            "to_reference": _known(figures.c2c.to_reference),
            "to_cloud": _known(figures.c2c.to_cloud),
        }
    if (m3c2 := figures.m3c2) is not None:
        numbers["m3c2"] = _known(m3c2.distances) | {
            "radius_m": m3c2.radius_m,
            "detection_median_m": m3c2.detection_median_m,
            "significant_share": m3c2.significant_share,
        }
    return plain(numbers | _circumstances(figures.circumstances))


def _known(record: DistanceStatistics | Scores) -> dict:
    """Figures of a record, without those that are None."""
    return {name: value for name, value in asdict(record).items() if value is not None}


def _parts(parts: Parts) -> dict:
    numbers = {} if parts.depth is None else _depth_parts(parts.depth)
    kinds = (
        ("incidence_bands", parts.incidence, "deg"),
        ("views_bands", parts.views, "views"),
        ("slope_bands", parts.slope, "deg"),
    )
    for key, bands, unit in kinds:
        numbers |= {key: _bands(bands, unit)} if bands else {}
    return numbers


def _reached(bands: tuple[ReachedBand, ...]) -> dict:
    rows = [
        _limits(band.low, band.high, "deg") | {"n_samples": band.n_samples, "completeness": list(band.completeness)}
        for band in bands
    ]
    return {"completeness_by_slope": rows} if rows else {}


def _depth_parts(parts: DepthParts) -> dict:
    split = {"wet": parts.wet, "dry": parts.dry}
    numbers = {name: _known(part) for name, part in split.items() if part is not None}
    return numbers | {"depth_bands": _bands(parts.bands, "m")}


def _bands(bands: tuple[Band, ...], unit: str) -> list[dict]:
    return [_limits(band.low, band.high, unit) | _known(band.distances) for band in bands]


def _limits(low: float, high: float, unit: str) -> dict:
    return {f"from_{unit}": low, f"to_{unit}": None if math.isinf(high) else high}


def _vertical(vertical: Vertical) -> dict:
    numbers = _known(vertical.distances) | {"n_holes": vertical.distances.n_nan}
    return numbers if vertical.depth is None else numbers | _depth_parts(vertical.depth)


def _iho_s44(uncertainty: VerticalUncertainty) -> dict:
    iho = uncertainty.iho
    return {
        "points": iho.n_points,
        "error_95_m": iho.error_95_m,
        "orders": [_order(order) for order in iho.orders],
        "note": iho.note,
        "error": uncertainty.error,
    }


def _order(order: TvuOrder) -> dict:
    bands = [
        _limits(band.low_m, band.high_m, "m") | {"n_points": band.n_points, "share_within": band.share_within}
        for band in order.bands
    ]
    return {
        "order": order.name,
        "tvu_at_median_depth_m": order.tvu_at_median_depth_m,
        "share_within": order.share_within,
        "meets_tvu": order.meets_tvu,
        "meets_tvu_at_all_depths": order.meets_tvu_at_all_depths,
        "undecided": order.is_undecided,
        "depth_bands": bands,
    }


def _asprs(checkpoints: Checkpoints) -> dict:
    rows = [
        {"easting": e, "northing": n, "height": h, "residual_m": residual}
        for (e, n, h), residual in zip(checkpoints.places.tolist(), checkpoints.residuals.tolist(), strict=True)
    ]
    return asdict(checkpoints.accuracy) | {"residuals": rows}


def _circumstances(held: Circumstances) -> dict:
    return {
        "outliers": held.outliers,
        "confidence": {
            "level": LEVEL,
            "method": "block bootstrap",
            "block_m": held.block_m,
            "correlation_length_m": held.correlation_length_m,
            "widening": held.widening,
            "draws": NUM_DRAWS,
            "seed": SEED,
        },
        "water_level": held.water_level,
        "method": held.method,
        "sign": held.sign,
        "crs": held.crs,
        "bounds": None if held.bounds is None else [float(v) for v in held.bounds],
        "cloud": held.cloud,
        "reference": held.reference,
        "visible": held.visible,
        "n_samples": held.n_samples,
        "seed": held.seed,
        "notes": list(held.notes),
    }
