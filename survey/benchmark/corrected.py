"""Baseline of the benchmark: straight rays, depths corrected afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation import per_camera, times_index
from geo import read_cloud, write_cloud
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.folder.found import find_survey
from survey.folder.local_frame import water_in_local
from survey.run.flight import load_flight

# Points at a time: each has an angle for every camera.
_BATCH = 100_000


def write_corrected(path: Path, run: Path, survey: Path, correction: str) -> None:
    """The cloud of a run over straight rays, of the survey without its water, its depths corrected, as LAS.

    `survey` is the folder with water, whose level and index are taken. The correction is "times_index" or "per_camera".
    """
    cloud = read_cloud(run / "cloud.las")
    flight = load_flight(run)
    water = water_in_local(find_survey(survey).config, flight.frame, list(flight.views))[1]
    if water is None:
        raise SurveyError(f"{survey} has no water whose refraction could be corrected")
    cameras = [view.camera for view in flight.views]
    points = flight.frame.local_from_crs(cloud.points)
    depth = np.asarray(water.depth(points))
    wet = np.flatnonzero(depth > 0.0)
    true = np.concatenate(
        [
            _depths(points[rows], depth[rows], cameras, water, correction)
            for rows in np.array_split(wet, len(wet) // _BATCH + 1)
        ]
    )
    moved, new_depth = points.copy(), depth.copy()
    moved[wet] -= (true - depth[wet])[:, None] * np.asarray(water.up)
    new_depth[wet] = true
    # Where no camera sees a point there is no factor, and no corrected point.
    known = np.isfinite(moved).all(axis=1)
    colours = np.zeros((len(points), 3), dtype=np.uint8) if cloud.rgb is None else cloud.rgb
    write_cloud(
        path,
        flight.frame.crs_from_local(moved[known]),
        flight.frame.crs,
        rgb=colours[known],
        depth_m=new_depth[known],
        std_m=cloud.extra["std"][known],
        num_views=cloud.extra["num_views"][known],
        incidence_deg=cloud.extra["incidence"][known],
        is_wet=new_depth[known] > 0.0,
    )


def _depths(
    points: np.ndarray, apparent: np.ndarray, cameras: list[PinholeCamera], water: FlatWater, correction: str
) -> np.ndarray:
    n = float(water.n_water)
    if correction == "times_index":
        return times_index(apparent, n)
    up, incidence, is_seen = np.asarray(water.up), [], []
    for camera in cameras:
        towards = camera.centre - points
        cos = (towards @ up) / np.linalg.norm(towards, axis=1)
        is_seen.append(camera.sees(camera.project(points, None)))
        incidence.append(np.arccos(np.clip(cos, -1.0, 1.0)))
    return per_camera(apparent, np.stack(incidence, axis=1), np.stack(is_seen, axis=1), n)
