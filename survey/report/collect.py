"""Collects the figures of a report from the results of a run."""

from __future__ import annotations

import math
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from evaluation import DistanceStatistics, apparent_points, distance_statistics, per_camera, times_index
from geo.crs import crs_code
from geo.grid import plan_box
from geo.shapes import ComputedColumn
from refract import FlatWater, crossing_point, water_index
from refract.media import USUAL_SALINITY_PSU, USUAL_TEMPERATURE_C
from survey.adjust.result.adjustment import Status
from survey.display.column import finite, median
from survey.display.plan_grid import PlanGrid
from survey.files.json_values import plain
from survey.folder.motion import shutter_text
from survey.folder.survey import Survey
from survey.photos.images import list_images
from survey.photos.texture import MatchedLight
from survey.report.adjustment_figures import adjustment_of
from survey.report.checkpoints import checkpoint_warnings, stated_of
from survey.report.facts import ReportFacts, dry_warnings, stated_std
from survey.report.figures import (
    BaselineRow,
    Baselines,
    CloudFigures,
    CrsFigures,
    Extent,
    HeightStd,
    LightFigures,
    ReportFigures,
    Spread,
    SurveyFigures,
    WaterFigures,
)
from survey.report.photographs import photograph_warnings, taken_of

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints
    from survey.compare.figures import Comparison

# Places of the bed at which baselines are predicted: their mean is then sure to a few per cent of their spread.
_PLACES = 2000
_SEED = 20_060_619
_NOTE = (
    "Predicted: where the straight rays of all views with a place in their frame meet, in closed form and without "
    "matching noise, at places of the reference under water; occlusion is not considered. Slanted views count like "
    "steep ones; matching keeps the views that agree, so that a matched cloud of straight rays errs by less than "
    "predicted where photographs are slanted, but by a quarter of the depth in the median at the least. Poses and lens "
    "count as right: adjusted to straight rays they take up a part of the error. Measured: vertical differences of the "
    "points under water to the reference; at walls a small horizontal offset counts in full, which moves the mean and "
    "hardly the median. Positive is too shallow."
)
# Of the index that handbooks state.
_SODIUM_NM = 589.3
# Density is that of the ground that has points, found in cells of this many ground sampling distances.
_COVERED_CELL_GSD = 5.0
_UNITS = {"metre": "m", "degree": "°"}


def baselines_of(facts: ReportFacts) -> Baselines | None:
    """Vertical errors of baselines and of this run; None without water, reference or points under water."""
    comparison, water = facts.comparison, facts.survey.water
    if comparison is None or water is None or comparison.depth is None:
        return None
    bed = _places(facts.survey, water, comparison, comparison.depth)
    centres, directions, is_seen = _rays(facts.survey, water, bed)
    apparent = apparent_points(centres, directions, is_seen)
    known = np.isfinite(apparent).all(axis=1)
    if not known.any():
        return None
    centres, is_seen, apparent = centres[known], is_seen[known], apparent[known]
    true, seen = np.asarray(water.depth(bed[known])), np.asarray(water.depth(apparent))
    to_camera = centres - apparent[:, None]
    cos = (to_camera @ np.array(water.up)) / np.linalg.norm(to_camera, axis=-1)
    n = float(water.n_water)
    predicted = {
        "straight rays": seen,
        "straight rays, depth times n": times_index(seen, n),
        "per-camera correction (Dietrich)": per_camera(seen, np.arccos(np.clip(cos, -1.0, 1.0)), is_seen, n),
    }
    rows = [_row(name, "predicted", distance_statistics(true - depth)) for name, depth in predicted.items()]
    return Baselines(
        places=int(known.sum()),
        views_per_place=float(np.median(is_seen.sum(axis=1))),
        rows=(*rows, *_measured(comparison, facts.sweep_comparison)),
        note=_NOTE,
    )


def _places(survey: Survey, water: FlatWater, comparison: Comparison, depth: np.ndarray) -> np.ndarray:
    """Some places (K, 3) of the reference under water, its depth (N,) above zero, in the local frame of the survey."""
    wet = np.flatnonzero((depth > 0.0) & np.isfinite(comparison.nearest).all(axis=1))
    some = np.random.default_rng(_SEED).permutation(wet)[:_PLACES]
    in_crs = comparison.inputs.frame.crs_from_local(comparison.nearest[some])
    places = survey.frame.local_from_crs(in_crs)
    return places[np.asarray(water.depth(places)) > 0.0]


def _rays(survey: Survey, water: FlatWater, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres and directions in air (K, V, 3) of the views, and which of them have each place in their frame."""
    centres, directions, is_seen = [], [], []
    for view in survey.views:
        camera, down = view.camera, np.array([0.0, 0.0, -view.camera.tide])
        towards = crossing_point(places + down, camera.centre + down, water) - (camera.centre + down)
        centres.append(np.broadcast_to(camera.centre, places.shape))
        directions.append(towards / np.linalg.norm(towards, axis=1, keepdims=True))
        is_seen.append(camera.sees(camera.project(places, water)))
    return np.stack(centres, axis=1), np.stack(directions, axis=1), np.stack(is_seen, axis=1)


def _measured(comparison: Comparison, of_sweep: Comparison | None) -> list[BaselineRow]:
    """The refractive sweep, whose heights are not refined to the end, and the solver; one row where it is off."""
    of_run = comparison.figures.wet
    if of_sweep is None:
        named = {"this run: sweep alone": of_run}
    else:
        named = {"sweep before the solver": of_sweep.figures.wet, "this run: sweep and solver": of_run}
    return [_row(name, "measured", part) for name, part in named.items() if part]


def _row(name: str, kind: str, found: DistanceStatistics) -> BaselineRow:
    return BaselineRow(name, kind, found.median_m, found.nmad_m, found.mean_m)


def figures_of(facts: ReportFacts) -> ReportFigures:
    """All figures of a report; a gate that was not met is one of its warnings."""
    survey = facts.survey
    adjustment = adjustment_of(survey, facts.adjustment)
    failed = [gate.sentence for gate in facts.verdict.gates if not gate.passed] if facts.verdict else []
    config, used, checkpoints = survey.config, {view.name for view in survey.views}, facts.checkpoints
    images = list_images(survey.folder / config.images.local_dir, deep=config.images.dir != ".")
    left_out = tuple(name for name in images if name not in used)
    return ReportFigures(
        verdict=facts.verdict,
        survey=_survey(survey, len(left_out)),
        left_out=left_out,
        water=_water(facts),
        plan=facts.plan,
        cloud=_cloud(facts),
        comparison=None if facts.comparison is None else facts.comparison.figures,
        baselines=baselines_of(facts),
        timings_s=facts.timings,
        versions=facts.versions,
        settings=plain(facts.settings),
        assumptions=tuple(survey.findings.assumptions),
        warnings=(
            *failed,
            *dry_warnings(survey, facts.bed),
            *photograph_warnings(facts.photographs),
            *checkpoint_warnings(checkpoints),
            *survey.findings.warnings,
            *facts.warnings,
        ),
        checkpoints=checkpoints,
        height_std=height_std(facts.bed.std, facts.std_common) if len(facts.bed) else None,
        adjustment=adjustment,
        photographs=facts.photographs,
        stated=stated_of(
            facts.stated,
            ComputedColumn(lambda depth, wet: np.where(wet, depth, np.nan), facts.bed.depth, facts.bed.wet),
        ),
        coverage=facts.coverage,
        waves=facts.waves,
        taken=taken_of(config.report, facts.headers, datetime.now().astimezone()) if facts.headers else None,
    )


def height_std(std: np.ndarray, std_common: np.ndarray | None) -> HeightStd:
    """Std of the height of a point, all included: medians over points (N,), one at least."""
    shared = math.nan if std_common is None else median(std_common)
    return HeightStd(median(stated_std(std, std_common)), None if math.isnan(shared) else shared, median(std))


def _survey(survey: Survey, num_left_out: int) -> SurveyFigures:
    config, crs = survey.config, survey.frame.crs
    camera, units = survey.views[0].camera, [_UNITS.get(axis.unit_name, axis.unit_name) for axis in crs.axis_info]
    return SurveyFigures(
        name=survey.name,
        crs=CrsFigures(crs.name, crs_code(crs), units[0], units[-1]),
        bounds=survey.bounds,
        views_used=len(survey.views),
        views_left_out=num_left_out,
        image_size_px=(camera.width, camera.height),
        focal_px=camera.fx,
        poses=(config.cameras.poses or "structure from motion")
        + (", adjusted" if survey.provenance.is_adjusted else ""),
        shutter=shutter_text(config.cameras, survey.observations.velocities, survey.views, survey.water),
        local_frame_origin=survey.frame.origin,
    )


def _water(facts: ReportFacts) -> WaterFigures | None:
    survey, adjustment = facts.survey, facts.adjustment
    if survey.water is None:
        return None
    found = set() if adjustment is None else {row.name for row in adjustment.parameters if row.status == Status.FREE}

    def source(names: set[str], otherwise: str) -> str:
        return "found by the adjustment" if names & found else otherwise

    water, config = survey.require_water()
    assumed = [text for text in survey.findings.assumptions if text.startswith("refractive_index")]
    level = [text for text in survey.findings.assumptions if text.startswith("level_m")]
    return WaterFigures(
        level_m=config.known_level_m,
        level_at=config.known_level_at,
        level_from=source({"level_m"}, level[-1] if level else "survey.toml, [water] level_m"),
        slope_east=config.slope_east,
        slope_north=config.slope_north,
        slope_from=source({"slope_east", "slope_north"}, "survey.toml; level if not given"),
        refractive_index=float(water.n_water),
        refractive_index_from=source({"refractive_index"}, f"assumed: {assumed[0]}" if assumed else "survey.toml"),
        light=None if facts.light is None else _light(facts.light, float(water.n_water), facts.bed),
    )


def _light(light: MatchedLight, n_water: float, bed: BedPoints) -> LightFigures:
    """The light that is matched; straight down, the depth is the apparent one times the index."""
    over = light.index(USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU) - float(
        water_index(_SODIUM_NM, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU)
    )
    depth = median(bed.depth, bed.wet) if bed.wet.any() else None
    moved = None if depth is None else depth * over / n_water
    return LightFigures(*light.shares, light.is_measured, light.wavelength_nm, over, moved)


def _cloud(facts: ReportFacts) -> CloudFigures:
    bed = facts.bed
    area, extent = 0.0, None
    if len(bed):
        west_south, east_north = plan_box(bed.xyz)
        area = PlanGrid.within(bed.xyz, west_south, east_north, _COVERED_CELL_GSD * facts.plan.gsd_m).covered_m2
        low, high = facts.points_crs.min(axis=0).tolist(), facts.points_crs.max(axis=0).tolist()
        extent = Extent((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    return CloudFigures(
        points=len(bed),
        points_wet=int(bed.wet.sum()),
        extent=extent,
        covered_area_m2=area,
        depth_m=_spread(finite(bed.depth, bed.wet)),
        std_m=_spread(finite(bed.std)),
        std_common_m=None if facts.std_common is None else _spread(finite(facts.std_common)),
        views_per_point=_spread(finite(bed.num_views)),
        incidence_deg=_spread(finite(bed.incidence), math.degrees(1.0)),
        plan_std_common_m=facts.survey.plan_std_m,
    )


def _spread(values: np.ndarray, scale: float = 1.0) -> Spread | None:
    """Statistics of values (N,) times a scale; None of none."""
    if not len(values):
        return None
    # In float64, as the share in an array is: a number by itself would be rounded to the type of the values.
    mean, (p95,) = values.mean(dtype=np.float64), np.quantile(values, [0.95])
    return Spread(*(scale * float(value) for value in (values.min(), np.median(values), mean, p95, values.max())))
