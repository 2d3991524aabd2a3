"""Distances between clouds: to the nearest point, both ways, and by M3C2."""

from __future__ import annotations

import math

import numpy as np

from evaluation import distance_statistics, distance_to_cloud, m3c2_distances
from evaluation.completeness import SEED
from survey.compare.figures import M3C2, CloudToCloud
from survey.compare.scene import Scene
from survey.progress import current

# M3C2 is measured at this many places of the reference: enough for any statistics.
_CORE_POINTS = 20_000
# Half the length of its cylinders in radii.
_REACH = 10.0


def cloud_to_cloud(scene: Scene) -> CloudToCloud:
    """Distances without sign to the samples of the reference, and from them to the cloud."""
    with current().stage("Cloud to cloud"):
        there, _ = distance_to_cloud(scene.points, scene.samples)
        back, _ = distance_to_cloud(scene.samples, scene.points)
    return CloudToCloud(distance_statistics(there), distance_statistics(back))


def m3c2(scene: Scene, radius_m: float) -> M3C2:
    """M3C2 at some of the targets around the cloud: statistics, radius and share that is significant."""
    low, high = scene.points[:, :2].min(axis=0) - radius_m, scene.points[:, :2].max(axis=0) + radius_m
    near, core = (
        part[((part[:, :2] >= low) & (part[:, :2] <= high)).all(axis=1)] for part in (scene.samples, scene.targets)
    )
    core = core[np.random.default_rng(SEED).permutation(len(core))[:_CORE_POINTS]]
    with current().stage("M3C2"):
        found = m3c2_distances(near, scene.points, core, radius_m=radius_m, reach_m=_REACH * radius_m)
    known = np.isfinite(found.signed) & np.isfinite(found.detection_m)
    significant = np.abs(found.signed[known]) > found.detection_m[known]
    return M3C2(
        distance_statistics(found.signed),
        radius_m,
        float(np.median(found.detection_m[known])) if known.any() else math.nan,
        float(significant.mean()) if known.any() else math.nan,
    )
