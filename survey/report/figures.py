"""The figures of a report, that both report.json and report.html show, from its facts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pyproj import CRS

from geo.crs import horizontal_crs, vertical_crs
from survey.display.plan_grid import PlanGrid
from survey.files.json_values import plain
from survey.folder.survey import Survey
from survey.photos.images import list_images
from survey.plan.plan import Plan
from survey.report.baselines import baselines_of
from survey.report.facts import ReportFacts
from survey.report.verdict import Verdict

# Density is asked over the ground that has points; cells of this many ground sampling distances tell which.
_COVERED_CELL_GSD = 5.0
_UNITS = {"metre": "m", "degree": "°"}


def figures_of(facts: ReportFacts) -> dict:
    """All figures of a report as plain values, the units in their names; None where there is none."""
    survey = facts.survey
    failed = [gate.sentence for gate in facts.verdict.gates if not gate.passed] if facts.verdict else []
    figures = {
        "verdict": _verdict(facts.verdict),
        "survey": _survey(survey),
        "water": _water(survey),
        "plan": _plan(facts.plan),
        "cloud": _cloud(facts),
        "comparison": None if facts.comparison is None else facts.comparison.numbers,
        "iho_s44": None if facts.comparison is None else facts.comparison.numbers.get("iho_s44"),
        "baselines": baselines_of(facts),
        "timings_s": {**facts.timings, "total": sum(facts.timings.values())},
        "versions": facts.versions,
        "settings": facts.settings,
        "assumptions": list(survey.assumptions),
        "warnings": [*failed, *survey.warnings],
        "notes": list(facts.notes),
    }
    return plain(figures)


def _verdict(verdict: Verdict | None) -> dict | None:
    return None if verdict is None else {"passed": verdict.passed, "gates": verdict.gates}


def _survey(survey: Survey) -> dict:
    config = survey.config
    camera = survey.views[0].camera
    images = list_images(survey.folder / config.images.dir, deep=config.images.dir != ".")
    return {
        "name": survey.name,
        "crs": _crs(survey.frame.crs),
        "bounds": survey.bounds,
        "views_used": len(survey.views),
        "views_left_out": max(len(images) - len(survey.views), 0),
        "image_size_px": (camera.width, camera.height),
        "focal_px": camera.fx,
        "poses": config.cameras.poses or "structure from motion",
        "local_frame_origin": survey.frame.origin,
    }


def _crs(crs: CRS) -> dict:
    units = [_UNITS.get(axis.unit_name, axis.unit_name) for axis in crs.axis_info]
    return {"name": crs.name, "code": crs_code(crs), "unit": units[0], "height_unit": units[-1]}


def crs_code(crs: CRS) -> str | None:
    """Codes of a CRS, e.g. "EPSG:25832+5778"; None where it has none."""
    whole = crs.to_authority()
    if whole is not None:
        return ":".join(whole)
    parts = [part.to_authority() for part in (horizontal_crs(crs), vertical_crs(crs)) if part is not None]
    if len(parts) != 2 or None in parts:
        return None
    (authority, first), (other, second) = parts
    return f"{authority}:{first}+" + (second if authority == other else f"{other}:{second}")


def _water(survey: Survey) -> dict | None:
    water = survey.config.water
    if water is None:
        return None
    assumed = [text for text in survey.assumptions if text.startswith("refractive_index")]
    level = [text for text in survey.assumptions if text.startswith("level_m")]
    return {
        "level_m": water.level_m,
        "level_at": water.level_at,
        "level_from": level[-1] if level else "survey.toml, [water] level_m",
        "slope_east": water.slope_east,
        "slope_north": water.slope_north,
        "slope_from": "survey.toml; level where it says nothing",
        "refractive_index": water.refractive_index,
        "refractive_index_from": f"assumed: {assumed[0]}" if assumed else "survey.toml",
    }


def _plan(plan: Plan) -> dict:
    return {
        "quality": plan.quality,
        "device": plan.device,
        "image_scale": plan.image_scale,
        "gsd_m": plan.gsd_m,
        "height_m": plan.height_m,
        "footprint_m": plan.footprint_m,
        "decisions": [{"name": d.name, "choice": d.choice, "reason": d.reason} for d in plan.decisions],
    }


def _cloud(facts: ReportFacts) -> dict:
    bed = facts.bed
    area = PlanGrid.of_cells(bed.xyz, _COVERED_CELL_GSD * facts.plan.gsd_m).covered_m2 if len(bed) else 0.0
    wet = int(bed.wet.sum())
    depth = bed.depth[bed.wet]
    return {
        "points": len(bed),
        "points_wet": wet,
        "points_dry": len(bed) - wet,
        "extent": None if not len(bed) else {"low": facts.points_crs.min(axis=0), "high": facts.points_crs.max(axis=0)},
        "covered_area_m2": area,
        "density_per_m2": len(bed) / area if area else None,
        "depth_m": _spread(depth, "min", "median", "p95", "max"),
        "std_m": _spread(bed.std, "median", "p95"),
        "views_per_point": _spread(bed.num_views, "min", "median", "mean", "max"),
        "incidence_deg": _spread(np.degrees(bed.incidence), "median", "p95", "max"),
    }


_STATISTICS: dict[str, Callable[[np.ndarray], np.floating]] = {
    "min": np.min,
    "median": np.median,
    "mean": np.mean,
    "p95": lambda values: np.quantile(values, 0.95),
    "max": np.max,
}


def _spread(values: np.ndarray, *names: str) -> dict | None:
    """Statistics by name, over what is finite; None where nothing is."""
    values = values[np.isfinite(values)].astype(np.float64)
    return {name: float(_STATISTICS[name](values)) for name in names} if values.size else None
