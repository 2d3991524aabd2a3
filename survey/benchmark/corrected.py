"""Baseline of the benchmark: straight rays, depths corrected afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation import per_camera, times_index
from geo import LocalFrame, read_cloud, write_cloud
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.folder import local_frame
from survey.folder.found import find_survey
from survey.run.flight import load_flight

# Points at a time: each has an angle for every camera.
_BATCH = 100_000


@dataclass(frozen=True)
class _Scene:
    frame: LocalFrame
    cameras: tuple[PinholeCamera, ...]
    water: FlatWater


def write_corrected(path: Path, run: Path, survey: Path, correction: str) -> None:
    """The cloud of a run over straight rays, of the survey without its water, its depths corrected, as LAS.

    `survey` is the folder with water, whose level and index are taken. The correction is "times_index" or "per_camera".
    """
    cloud = read_cloud(run / "cloud.las")
    scene = _scene(run, survey)
    points = scene.frame.local_from_crs(cloud.points)
    depth = np.asarray(scene.water.depth(points))
    wet = np.flatnonzero(depth > 0.0)
    true = np.concatenate(
        [_depths(points[rows], depth[rows], scene, correction) for rows in np.array_split(wet, len(wet) // _BATCH + 1)]
    )
    moved, new_depth = points.copy(), depth.copy()
    moved[wet] -= (true - depth[wet])[:, None] * np.asarray(scene.water.up)
    new_depth[wet] = true
    # Where no camera sees a point there is no factor, and no corrected point.
    known = np.isfinite(moved).all(axis=1)
    colours = np.zeros((len(points), 3), dtype=np.uint8) if cloud.rgb is None else cloud.rgb
    write_cloud(
        path,
        scene.frame.crs_from_local(moved[known]),
        scene.frame.crs,
        rgb=colours[known],
        depth_m=new_depth[known],
        std_m=cloud.extra["std"][known],
        num_views=cloud.extra["num_views"][known],
        incidence_deg=cloud.extra["incidence"][known],
        is_wet=new_depth[known] > 0.0,
    )


def _depths(points: np.ndarray, apparent: np.ndarray, scene: _Scene, correction: str) -> np.ndarray:
    n = float(scene.water.n_water)
    if correction == "times_index":
        return times_index(apparent, n)
    up, incidence, is_seen = np.asarray(scene.water.up), [], []
    for camera in scene.cameras:
        towards = camera.centre - points
        cos = (towards @ up) / np.linalg.norm(towards, axis=1)
        is_seen.append(camera.sees(camera.project(points, None)))
        incidence.append(np.arccos(np.clip(cos, -1.0, 1.0)))
    return per_camera(apparent, np.stack(incidence, axis=1), np.stack(is_seen, axis=1), n)


def _scene(run: Path, survey: Path) -> _Scene:
    """The cameras of the run, with the water of the survey."""
    flight = load_flight(run)
    plane = local_frame.water_in_local(find_survey(survey).config, flight.frame, list(flight.views))[1]
    if plane is None:
        raise SurveyError(f"{survey} has no water whose refraction could be corrected")
    return _Scene(flight.frame, tuple(view.camera for view in flight.views), plane)
