"""The figures of a report, from the results of a run: what report.json holds and report.html shows.

A figure is named here, by its key with its unit (none: m, or [-] of an index), and where the page shows it.
"""

import math
from datetime import datetime
from typing import Any

import numpy as np

from geo.crs import crs_code
from geo.grid import plan_box
from geo.shapes import ComputedColumn
from refract import water_index
from refract.media import USUAL_SALINITY_PSU, USUAL_TEMPERATURE_C
from survey.adjust.result.adjustment import Status
from survey.compare.figures import numbers_of
from survey.display.canvas import unit_sign
from survey.display.plan_grid import PlanGrid, finite, median
from survey.files.json_values import plain
from survey.folder.observations import shutter_text
from survey.folder.survey import Survey
from survey.photos.images import list_images
from survey.report.adjustment import adjustment_of
from survey.report.checkpoints import checkpoint_warnings, stated_of
from survey.report.facts import ReportFacts, dry_warnings, height_std
from survey.report.photographs import photograph_warnings, taken_of
from survey.report.seen_cells import coverage_of
from survey.water.surface import height_above

# By their keys in report.json.
ReportFigures = dict[str, Any]

# Of the index that handbooks state.
_SODIUM_NM = 589.3
# Density is that of the ground that has points, found in cells of this many ground sampling distances.
_COVERED_CELL_GSD = 5.0
_OF_PLAN = ("quality", "device", "image_scale", "gsd_m", "height_m", "footprint_m", "decisions")


def figures_of(facts: ReportFacts) -> ReportFigures:
    """All figures of a report, in their order; a gate that was not met is one of its warnings.

    Verdict, plan, comparison and what `facts` has as figures already are as they come; `json_of` makes them plain.
    """
    survey, config, bed = facts.survey, facts.survey.config, facts.bed
    used = {view.name for view in survey.views}
    images = list_images(survey.folder / config.images.local_dir, deep=config.images.dir != ".")
    left_out = [name for name in images if name not in used]
    depth = ComputedColumn(lambda depth, wet: np.where(wet, depth, np.nan), bed.depth, bed.wet)
    return {
        "verdict": facts.verdict,
        "survey": _survey(survey, len(left_out)),
        "taken": taken_of(config.report, facts.headers, datetime.now().astimezone()) if facts.headers else None,
        "water": _water(facts),
        "plan": facts.plan,
        "cloud": _cloud(facts),
        "comparison": None if facts.comparison is None else facts.comparison.figures,
        "iho_s44": None,
        "checkpoints": facts.checkpoints,
        "height_std_m": height_std(bed.std, facts.std_common) if len(bed) else None,
        "stated": stated_of(facts.stated, depth),
        "coverage": _coverage(facts),
        "waves": facts.waves,
        "adjustment": adjustment_of(survey, facts.adjustment),
        "photographs": facts.photographs,
        "photographs_left_out": left_out,
        "timings_s": {**facts.timings, "total": sum(facts.timings.values())},
        "versions": facts.versions,
        "settings": plain(facts.settings),
        "assumptions": survey.findings.assumptions,
        "warnings": [
            *([gate.sentence for gate in facts.verdict.gates if not gate.passed] if facts.verdict else []),
            *dry_warnings(survey, bed),
            *photograph_warnings(facts.photographs),
            *checkpoint_warnings(facts.checkpoints),
            *survey.findings.warnings,
            *facts.warnings,
        ],
    }


def json_of(figures: ReportFigures) -> dict:
    """The figures as dicts, lists, numbers and texts, as report.json holds them; None where there is none."""
    verdict, plan, comparison = figures["verdict"], figures["plan"], figures["comparison"]
    numbers = None if comparison is None else numbers_of(comparison)
    return plain({
        **figures,
        "verdict": None if verdict is None else {"passed": verdict.passed, "gates": verdict.gates},
        "plan": {name: getattr(plan, name) for name in _OF_PLAN},
        "comparison": numbers,
        "iho_s44": None if numbers is None else numbers.get("iho_s44"),
    })  # fmt: skip


def _survey(survey: Survey, num_left_out: int) -> dict[str, Any]:
    config, crs = survey.config, survey.frame.crs
    camera, units = survey.views[0].camera, [unit_sign(crs, axis) for axis in range(len(crs.axis_info))]
    poses = config.cameras.poses or "structure from motion"
    return {
        "name": survey.name,
        "crs": {"name": crs.name, "code": crs_code(crs), "unit": units[0], "height_unit": units[-1]},
        "bounds": survey.bounds,
        "views_used": len(survey.views),
        "views_left_out": num_left_out,
        "image_size_px": (camera.width, camera.height),
        "focal_px": camera.fx,
        "poses": f"{poses}, adjusted" if survey.provenance.is_adjusted else poses,
        "shutter": shutter_text(config.cameras, survey.observations.velocities, survey.views, survey.water),
        "local_frame_origin": survey.frame.origin,
    }


def _water(facts: ReportFacts) -> dict[str, Any] | None:
    """The water plane, and where its values come from; None for a dry survey."""
    survey, adjustment = facts.survey, facts.adjustment
    if survey.water is None:
        return None
    free = set() if adjustment is None else {row.name for row in adjustment.parameters if row.status == Status.FREE}

    def source(names: set[str], otherwise: str) -> str:
        return "found by the adjustment" if names & free else otherwise

    water, config = survey.require_water()
    assumed = [text for text in survey.findings.assumptions if text.startswith("refractive_index")]
    level = [text for text in survey.findings.assumptions if text.startswith("level_m")]
    return {
        "level_m": config.known_level_m,
        "level_at": config.known_level_at,
        "level_from": source({"level_m"}, level[-1] if level else "survey.toml, [water] level_m"),
        "slope_east": config.slope_east,
        "slope_north": config.slope_north,
        "slope_from": source({"slope_east", "slope_north"}, "survey.toml; level if not given"),
        "refractive_index": float(water.n_water),
        "refractive_index_from": source({"refractive_index"}, f"assumed: {assumed[0]}" if assumed else "survey.toml"),
        "light": _light(facts, float(water.n_water)),
    }


def _light(facts: ReportFacts, n_water: float) -> dict[str, Any] | None:
    """The light that is matched; straight down, the depth is the apparent one times the index."""
    light, bed = facts.light, facts.bed
    if light is None:
        return None
    sodium = float(water_index(_SODIUM_NM, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU))
    over = light.index(USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU) - sodium
    return {
        **dict(zip(("red", "green", "blue"), light.shares, strict=True)),
        "is_measured": light.is_measured,
        "wavelength_nm": light.wavelength_nm,
        "over_sodium": over,
        "over_sodium_m": median(bed.depth, bed.wet) * over / n_water if bed.wet.any() else None,
    }


def _cloud(facts: ReportFacts) -> dict[str, Any]:
    """The points of the bed, wet and dry, and how their values are distributed."""
    bed, points, wet = facts.bed, len(facts.bed), int(facts.bed.wet.sum())
    area, extent = 0.0, None
    if points:
        west_south, east_north = plan_box(bed.xyz)
        area = PlanGrid.within(bed.xyz, west_south, east_north, _COVERED_CELL_GSD * facts.plan.gsd_m).covered_m2
        extent = {"low": facts.points_crs.min(axis=0).tolist(), "high": facts.points_crs.max(axis=0).tolist()}
    common, shift = facts.std_common, facts.survey.plan_std_m
    return {
        "points": points,
        "points_wet": wet,
        "points_dry": points - wet,
        "extent": extent,
        "covered_area_m2": area,
        "density_per_m2": points / area if area else None,
        "depth_m": _spread(finite(bed.depth, bed.wet), "min", "median", "p95", "max"),
        "std_m": _spread(finite(bed.std), "median", "p95"),
        "std_common_m": None if common is None else _spread(finite(common), "median", "p95"),
        # Of all places in plan, by a transformation of datums.
        **({"plan_std_common_m": shift} if shift else {}),
        "views_per_point": _spread(finite(bed.num_views), "min", "median", "mean", "max"),
        "incidence_deg": _spread(np.degrees(finite(bed.incidence)), "median", "p95", "max"),
    }


def _coverage(facts: ReportFacts) -> dict[str, Any] | None:
    """Coverage of the ground; None where nobody has looked."""
    survey, cells = facts.survey, facts.cells
    if survey.water is None or cells is None:
        return None if cells is None else coverage_of(cells, None, None)
    places, shared = cells.middles, math.nan if facts.std_common is None else median(facts.std_common)
    above = height_above(survey.water, survey.observations.departure, places.reshape(-1, 3))
    return coverage_of(cells, -above.reshape(places.shape[:2]), None if math.isnan(shared) else shared)


def _spread(values: np.ndarray, *names: str) -> dict[str, float] | None:
    """Some statistics of values (N,); None of none."""
    if not len(values):
        return None
    # In float64, as the share in an array is: a number by itself would be rounded to the type of the values.
    mean, (p95,) = values.mean(dtype=np.float64), np.quantile(values, [0.95])
    known = {"min": values.min(), "median": np.median(values), "mean": mean, "p95": p95, "max": values.max()}
    return {name: float(known[name]) for name in names}
