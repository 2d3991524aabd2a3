"""The figures of a report as plain values: what report.json holds, key by key."""

from __future__ import annotations

from dataclasses import asdict

from survey.compare.json_numbers import numbers_of
from survey.files.json_values import plain
from survey.plan.plan import Plan
from survey.report.adjustment_figures import AdjustmentFigures
from survey.report.figures import CloudFigures, ReportFigures, Spread
from survey.report.verdict import Verdict


def json_of(figures: ReportFigures) -> dict:
    """The figures as dicts, lists, numbers and texts, the units in their names; None where there is none."""
    comparison = None if figures.comparison is None else numbers_of(figures.comparison)
    return plain({
        "verdict": None if figures.verdict is None else _verdict(figures.verdict),
        "survey": figures.survey,
        "taken": figures.taken,
        "water": figures.water,
        "plan": _plan(figures.plan),
        "cloud": _cloud(figures.cloud),
        "comparison": comparison,
        "iho_s44": None if comparison is None else comparison.get("iho_s44"),
        "checkpoints": figures.checkpoints,
        "height_std_m": figures.height_std,
        "stated": figures.stated,
        "coverage": figures.coverage,
        "adjustment": None if figures.adjustment is None else _adjustment(figures.adjustment),
        "baselines": figures.baselines,
        "photographs": figures.photographs,
        "photographs_left_out": figures.left_out,
        "timings_s": {**figures.timings_s, "total": figures.total_s},
        "versions": figures.versions,
        "settings": figures.settings,
        "assumptions": figures.assumptions,
        "warnings": figures.warnings,
        "notes": figures.notes,
    })  # fmt: skip


def _verdict(verdict: Verdict) -> dict:
    return {"passed": verdict.passed, "gates": verdict.gates}


def _adjustment(found: AdjustmentFigures) -> dict:
    common = found.common
    values = asdict(found)
    del values["common"]
    return values | {
        "height_std_common_m": None if common is None else {"mean": common.mean, "typical": common.typical},
    }


def _plan(plan: Plan) -> dict:
    return {
        "quality": plan.quality,
        "device": plan.device,
        "image_scale": plan.image_scale,
        "gsd_m": plan.gsd_m,
        "height_m": plan.height_m,
        "footprint_m": plan.footprint_m,
        "decisions": plan.decisions,
    }


def _cloud(cloud: CloudFigures) -> dict:
    return {
        "points": cloud.points,
        "points_wet": cloud.points_wet,
        "points_dry": cloud.points_dry,
        "extent": cloud.extent,
        "covered_area_m2": cloud.covered_area_m2,
        "density_per_m2": cloud.density_per_m2,
        "depth_m": _spread(cloud.depth_m, "min", "median", "p95", "max"),
        "std_m": _spread(cloud.std_m, "median", "p95"),
        "std_common_m": _spread(cloud.std_common_m, "median", "p95"),
        **({"plan_std_common_m": cloud.plan_std_common_m} if cloud.plan_std_common_m else {}),
        "views_per_point": _spread(cloud.views_per_point, "min", "median", "mean", "max"),
        "incidence_deg": _spread(cloud.incidence_deg, "median", "p95", "max"),
    }


def _spread(spread: Spread | None, *names: str) -> dict | None:
    """Named statistics of a spread; None without one."""
    return None if spread is None else {name: getattr(spread, name) for name in names}
