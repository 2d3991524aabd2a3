"""Baselines over the same bed: straight rays, and corrections of their depth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evaluation import DistanceStatistics, apparent_points, distance_statistics, per_camera, times_index
from refract import FlatWater, crossing_point
from survey.report.figures import BaselineRow, Baselines

if TYPE_CHECKING:
    from survey.compare.figures import Comparison
    from survey.folder.survey import Survey
    from survey.report.facts import ReportFacts

# Places of the bed at which baselines are predicted: their mean is then sure to a few per cent of their spread.
_PLACES = 2000
_SEED = 20_060_619
# What refines the heights of the sweep, by the field of the plan.
_REFINED_BY = {"solver": "solver", "slab": "trained slab"}
_NOTE = (
    "Predicted: where the straight rays of all views with a place in their frame meet, in closed form and without "
    "matching noise, at places of the reference under water; occlusion is not considered. Slanted views count like "
    "steep ones; matching keeps the views that agree, so that a matched cloud of straight rays errs by less than "
    "predicted where photographs are slanted, but by a quarter of the depth in the median at the least. Poses and lens "
    "count as right: adjusted to straight rays they take up a part of the error. Measured: vertical differences of the "
    "points under water to the reference; at walls a small horizontal offset counts in full, which moves the mean and "
    "hardly the median. Positive is too shallow."
)


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
        rows=(*rows, *_measured(comparison, facts.sweep_comparison, facts.plan.field)),
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


def _measured(comparison: Comparison, of_sweep: Comparison | None, field: str) -> list[BaselineRow]:
    """The refractive sweep and what refined its heights; one row where nothing did.

    The solver goes on from a sweep whose heights are not refined to the end, a trained field from one alone.
    """
    whole = comparison.figures.wet
    if of_sweep is None:
        named = {"this run: sweep alone": whole}
    else:
        before = "sweep before the solver" if field == "solver" else "sweep alone"
        named = {before: of_sweep.figures.wet, f"this run: sweep and {_REFINED_BY[field]}": whole}
    return [_row(name, "measured", part) for name, part in named.items() if part]


def _row(name: str, kind: str, found: DistanceStatistics) -> BaselineRow:
    return BaselineRow(name, kind, found.median_m, found.nmad_m, found.mean_m)
