"""The measurements of a comparison: distances, completeness, depths, and the parts into which they fall."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation import (
    Blocks,
    by_band,
    by_depth,
    distance_statistics,
    distance_to_cloud,
    distance_to_mesh,
    iho_s44,
    is_reached,
    m3c2_distances,
    sample_mesh,
    vertical_difference,
)
from evaluation.c2m import Sign
from evaluation.completeness import NUM_SAMPLES, SEED
from evaluation.strata import INCIDENCE_EDGES_DEG, VIEWS_EDGES
from geo import Cloud, Mesh
from survey.compare.inputs import Bounds, Inputs, metres_in_crs, to_local, vertices_of, within
from survey.progress import current

# Extra bytes of a cloud: the depth below the water in metres, angle at the water in degrees, views that agree.
_DEPTH_NAMES = ("depth", "depth_m")
_INCIDENCE_NAMES = ("incidence", "incidence_deg")
_VIEWS_NAMES = ("num_views",)
# M3C2 is asked at this many places of the reference: enough for any statistics.
_CORE_POINTS = 20_000
# Half the length of its cylinders in radii.
_REACH = 10.0


@dataclass(frozen=True)
class Scene:
    """What is compared, local [m].

    Attributes
    ----------
    inputs : Inputs
    bounds : (E0, N0, E1, N1) or None, in crs
    around : (A,) int
        Numbers in the file of the points within the bounds and the largest tolerance more.
    cloud : (A, 3)
        Those points.
    points : (N, 3)
        Those of them that are within the bounds: the compared points.
    reference : (V, 3)
        Vertices, or points.
    samples, targets : (K, 3), (M, 3)
        Points that a complete cloud would reach: of the reference; of what cameras see, else the same.
    """

    inputs: Inputs
    bounds: Bounds | None
    around: np.ndarray
    cloud: np.ndarray
    points: np.ndarray
    reference: np.ndarray
    samples: np.ndarray
    targets: np.ndarray

    @staticmethod
    def of(
        inputs: Inputs,
        bounds: Bounds | None,
        is_left: np.ndarray,
        largest_m: float,
        paths: tuple[Path, Path, Path | None],
    ) -> Scene:
        """Bring the points that are left (N,) bool, the reference and the visible points into the local frame."""
        around = within(inputs.cloud.points, bounds, metres_in_crs(inputs.frame, largest_m)) & is_left
        cloud = to_local(inputs.frame, inputs.cloud.points[around], paths[0])
        reference = to_local(inputs.frame, vertices_of(inputs.reference), paths[1])
        samples = targets = _samples(reference, inputs.reference)
        if inputs.visible is not None:
            targets = _samples(to_local(inputs.frame, vertices_of(inputs.visible), paths[2]), inputs.visible)
        points = cloud[inputs.inside[around]]
        return Scene(inputs, bounds, np.flatnonzero(around), cloud, points, reference, samples, targets)

    def extra(self, names: tuple[str, ...]) -> np.ndarray | None:
        """Values (N,) of the compared points that the cloud carries under one of the names, else None."""
        name = next((name for name in names if name in self.inputs.cloud.extra), None)
        if name is None:
            return None
        return np.asarray(self.inputs.cloud.extra[name], dtype=np.float64)[self.inputs.inside]


def _samples(vertices: np.ndarray, shape: Mesh | Cloud) -> np.ndarray:
    """Points (M, 3) spread over a mesh by area; all points of a cloud."""
    return sample_mesh(vertices, shape.faces, NUM_SAMPLES) if isinstance(shape, Mesh) else vertices


def distances_of(scene: Scene, sign: Sign, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) of the compared points and nearest points (N, 3) of the reference, local [m]."""
    reference = scene.inputs.reference
    with current().stage("Distances", len(scene.points)) as stage:
        if not isinstance(reference, Mesh):
            notes.append("the reference is a cloud: distances are to its nearest point and have no sign")
            distances, numbers = distance_to_cloud(scene.points, scene.reference)
            return distances, scene.reference[numbers]
        result = distance_to_mesh(scene.points, scene.reference, reference.faces, sign=sign, advance=stage.advance)
    if result.num_degenerate:
        notes.append(f"{result.num_degenerate} triangles of the reference have no area and were left out")
    return result.signed, result.nearest


def reached_at(scene: Scene, tolerance_m: float) -> dict:
    """What `evaluation.scores` needs at one tolerance; the cloud is cropped to the bounds and the tolerance."""
    margin = metres_in_crs(scene.inputs.frame, tolerance_m)
    cloud = scene.cloud[within(scene.inputs.cloud.points[scene.around], scene.bounds, margin)]
    reached = {"tolerance_m": tolerance_m, "is_reached": is_reached(scene.samples, cloud, tolerance_m=tolerance_m)}
    if scene.inputs.visible is not None:
        reached["is_reached_visible"] = is_reached(scene.targets, cloud, tolerance_m=tolerance_m)
    return reached


def bed_depth(scene: Scene, nearest: np.ndarray, water_level: float | None, name: Path) -> np.ndarray | None:
    """Depth (N,) [m] of the nearest point of the reference; None if neither a level nor the cloud tells it.

    The cloud's depth alone would sort its points by what it got wrong; its sum with the height is the water
    surface, which does not depend on the bed.
    """
    inputs = scene.inputs
    if water_level is not None:
        surface = inputs.cloud.points[inputs.inside].copy()
        surface[:, 2] = water_level
        return to_local(inputs.frame, surface, name)[:, 2] - nearest[:, 2]
    depth = scene.extra(_DEPTH_NAMES)
    return None if depth is None else depth + scene.points[:, 2] - nearest[:, 2]


def parts(scene: Scene, distances: np.ndarray, depth: np.ndarray | None, blocks: Blocks) -> dict:
    """Statistics by depth, incidence and number of views, of what is known of the points.

    Returns
    -------
    dict
        Those of `evaluation.by_depth`; ``incidence_bands`` with ``from_deg`` and ``to_deg``; ``views_bands`` with
        ``from_views`` and ``to_views`` (excluded). What is not known is not there.
    """
    numbers = {}
    if depth is not None and np.isfinite(depth).any():
        numbers |= by_depth(distances, depth, blocks)
    for key, names, edges, unit in (
        ("incidence_bands", _INCIDENCE_NAMES, INCIDENCE_EDGES_DEG, "deg"),
        ("views_bands", _VIEWS_NAMES, VIEWS_EDGES, "views"),
    ):
        values = scene.extra(names)
        bands = [] if values is None else by_band(distances, values, edges, unit, blocks)
        numbers |= {key: bands} if bands else {}
    return numbers


def vertical(scene: Scene, distances: np.ndarray, depth: np.ndarray | None, blocks: Blocks) -> dict:
    """Vertical differences to a mesh, and the vertical uncertainty of IHO S-44 where depths are known.

    Returns
    -------
    dict
        ``vertical``: `evaluation.distance_statistics`, ``n_holes`` (points with no surface straight above or below
        them) and the parts by depth; not there if the reference is a cloud. ``iho_s44``: `evaluation.iho_s44` and
        ``error``, of what; not there without depths.
    """
    errors, error, numbers = distances, "distance to the nearest point of the reference", {}
    if isinstance(scene.inputs.reference, Mesh):
        with current().stage("Vertical differences", len(scene.points)) as stage:
            faces = scene.inputs.reference.faces
            errors = vertical_difference(scene.points, scene.reference, faces, advance=stage.advance)
        error = "vertical difference to the reference; at walls an offset to the side counts whole"
        statistics = distance_statistics(errors, blocks)
        numbers["vertical"] = statistics | {"n_holes": statistics["n_nan"]}
        if depth is not None and np.isfinite(depth).any():
            numbers["vertical"] |= by_depth(errors, depth, blocks)
    order = None if depth is None else iho_s44(errors, depth)
    return numbers | ({} if order is None else {"iho_s44": order | {"error": error}})


def cloud_to_cloud(scene: Scene) -> dict:
    """Distances without sign to the samples of the reference, and from them to the cloud."""
    with current().stage("Cloud to cloud"):
        there, _ = distance_to_cloud(scene.points, scene.samples)
        back, _ = distance_to_cloud(scene.samples, scene.points)
    return {"to_reference": distance_statistics(there), "to_cloud": distance_statistics(back)}


def m3c2(scene: Scene, radius_m: float) -> dict:
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
    return {
        **distance_statistics(found.signed),
        "radius_m": radius_m,
        "detection_median_m": float(np.median(found.detection_m[known])) if known.any() else float("nan"),
        "significant_share": float(significant.mean()) if known.any() else float("nan"),
    }
