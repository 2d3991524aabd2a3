"""The measurements of a comparison with a reference: distances, completeness, depths, and figures by parts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

import evaluation
from evaluation.c2m import NUM_SAMPLES, SEED, Sign, area_vectors, num_inconsistent_edges, slope_deg
from evaluation.standards import MIN_CHECKPOINTS
from evaluation.summary import INCIDENCE_EDGES_DEG, SLOPE_EDGES_DEG, VIEWS_EDGES
from geo import Cloud, Mesh
from geo.compatibility import require_same_crs, require_same_place
from geo.crs import height_unit_m
from geo.files import existing_file
from geo.shapes import excluded_points, vertices_of
from survey.compare.figures import M3C2, CheckpointFigures, Parts, ReferenceSurface, VerticalUncertainty
from survey.compare.inputs import DEPTH_NAMES, GIVE_LEVEL, Inputs, metres_in_crs, to_local, within
from survey.compare.options import Bounds, CompareError
from survey.display.quantities import named
from survey.files.foreign_text import crs_of_comment
from survey.files.point_table import PLACE, Units, point_table, read_points, require_exact, several_heights
from survey.progress import current

# Extra bytes of a cloud: the depth below the water in metres, angle at the water in degrees, views that agree.
_INCIDENCE_NAMES = ("incidence", "incidence_deg")
_VIEWS_NAMES = ("num_views",)
# M3C2 is measured at this many places of the reference: enough for any statistics.
_CORE_POINTS = 20_000
# Half the length of its cylinders in radii.
_REACH = 10.0


@dataclass(frozen=True)
class ComparedScene:
    """The data of a comparison in the local frame [m]."""

    inputs: Inputs
    bounds: Bounds | None  # (E0, N0, E1, N1) or None, in crs
    around: np.ndarray  # (A,) int: numbers in the file of the points within the bounds and the largest tolerance more
    cloud: np.ndarray  # (A, 3): those points
    points: np.ndarray  # (N, 3): those of them that are within the bounds: the compared points
    reference: np.ndarray  # (V, 3): Vertices, or points
    # samples, targets (K, 3), (M, 3): points that a complete cloud would reach: of the reference, and those that
    # cameras see, if known
    samples: np.ndarray
    targets: np.ndarray
    slope_deg: np.ndarray  # (K,) [deg]: of a mesh at its samples; (0,) of a cloud

    @staticmethod
    def of(inputs: Inputs, bounds: Bounds | None, is_left: np.ndarray, largest_m: float) -> ComparedScene:
        """Bring the points that are left (N,) bool, the reference and the visible points into the local frame."""
        near = within(inputs.cloud.points, bounds, metres_in_crs(inputs.frame, largest_m))
        around = near & is_left & ~excluded_points(inputs.cloud)[0]
        cloud = to_local(inputs.frame, inputs.cloud.points[around], inputs.paths.cloud)
        reference = to_local(inputs.frame, vertices_of(inputs.reference), inputs.paths.reference)
        samples, slope = _samples(reference, inputs.reference)
        targets = samples
        if inputs.visible is not None and inputs.paths.visible is not None:
            visible = to_local(inputs.frame, vertices_of(inputs.visible), inputs.paths.visible)
            targets, _ = _samples(visible, inputs.visible)
        points = cloud[inputs.inside[around]]
        return ComparedScene(inputs, bounds, np.flatnonzero(around), cloud, points, reference, samples, targets, slope)

    def extra(self, names: tuple[str, ...]) -> np.ndarray | None:
        """Values (N,) of the compared points that the cloud has under one of the names, else None."""
        name = next((name for name in names if name in self.inputs.cloud.extra), None)
        if name is None:
            return None
        return np.asarray(self.inputs.cloud.extra[name], dtype=np.float64)[self.inputs.inside]


def _samples(vertices: np.ndarray, shape: Mesh | Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) spread over a mesh by area, and its slopes (M,) [deg] there; all points of a cloud, and none."""
    if isinstance(shape, Cloud):
        return vertices, np.empty(0)
    samples, face = evaluation.sample_mesh(vertices, shape.faces, NUM_SAMPLES)
    return samples, slope_deg(area_vectors(vertices, shape.faces))[face]


@dataclass(frozen=True)
class Distances:
    """Distances of the compared points."""

    # (N,) [m]: to a mesh; heights over the surface through the points of a cloud, NaN where these do not surround a
    # place
    signed: np.ndarray
    nearest: np.ndarray  # (N, 3) [m], local: points of the reference, or of that surface
    slope_deg: np.ndarray | None  # (N,) [deg] or None: of the reference there; None where it is a cloud
    target_slope_deg: np.ndarray | None  # (K,) [deg] or None: of the reference at the targets of the completeness
    # (N,) [m] or None: of the heights of the surface through a cloud; None of a mesh
    reference_std: np.ndarray | None = None


def distances_of(scene: ComparedScene, sign: Sign, notes: list[str]) -> tuple[Distances, ReferenceSurface | None]:
    """Distances of the compared points, and what the surface through a reference of points is like; adds notes."""
    reference = scene.inputs.reference
    if not isinstance(reference, Mesh):
        with current().stage("Distances", len(scene.points)) as stage:
            return _over_surface(
                scene, evaluation.local_surface(scene.reference, scene.points[:, :2], advance=stage.advance), notes
            )
    # Slopes are known where the mesh was sampled; of other targets that of the nearest triangle is looked up.
    is_sampled = scene.targets is scene.samples
    num, places = len(scene.points), scene.points if is_sampled else np.concatenate([scene.points, scene.targets])
    with current().stage("Distances", len(places)) as stage:
        result = evaluation.distance_to_mesh(places, scene.reference, reference.faces, sign=sign, advance=stage.advance)
    num_edges = num_inconsistent_edges(reference.faces) if sign == "winding" else 0
    if num_edges:
        notes.append(
            f"triangles of {scene.inputs.paths.reference.name} have opposite winding along {num_edges} edges, where "
            "the sign changes; use --sign up, or orient the mesh"
        )
    if result.num_degenerate:
        notes.append(f"{result.num_degenerate} triangles of the reference have no area and were left out")
    of_targets = scene.slope_deg if is_sampled else result.slope_deg[num:]
    return Distances(result.signed[:num], result.nearest[:num], result.slope_deg[:num], of_targets), None


def _over_surface(
    scene: ComparedScene, surface: evaluation.LocalSurface, notes: list[str]
) -> tuple[Distances, ReferenceSurface]:
    name, known = scene.inputs.paths.reference.name, np.isfinite(surface.height)
    if not known.any():
        raise CompareError(
            f"none of the {len(known)} points of the cloud lies among the {len(scene.reference)} points of {name}: a "
            "height between them needs four of them around it; give a denser reference, or --checkpoints for single "
            "points"
        )
    std_median, std_95 = np.quantile(surface.std[known], [0.5, 0.95]).tolist()
    notes.append(
        f"{name} is a cloud, its points about {surface.spacing_m:.2g} m apart: distances are heights over the plane "
        f"through its twelve nearest points in plan, positive above; such a height is known to ± "
        f"{1e3 * std_median:.2g} mm (median, one sigma) by the scatter of the points about the plane"
    )
    if not known.all():
        notes.append(
            f"{int((~known).sum())} of {len(known)} points are not compared: points of {name} do not surround them"
        )
    nearest = np.column_stack([scene.points[:, :2], surface.height])
    distances = Distances(scene.points[:, 2] - surface.height, nearest, None, None, surface.std)
    return distances, ReferenceSurface(surface.spacing_m, std_median, std_95)


def completeness(scene: ComparedScene, signed: np.ndarray, tolerance_m: float) -> tuple[evaluation.Scores, np.ndarray]:
    """Scores at one tolerance of the cloud, cropped to the bounds and the tolerance more, and the targets reached (M,).

    Distances (N,) [m] are those of the compared points.
    """
    margin = metres_in_crs(scene.inputs.frame, tolerance_m)
    cloud = scene.cloud[within(scene.inputs.cloud.points[scene.around], scene.bounds, margin)]
    reached, visible = evaluation.is_reached(scene.samples, cloud, tolerance_m=tolerance_m), None
    if scene.inputs.visible is not None:
        visible = evaluation.is_reached(scene.targets, cloud, tolerance_m=tolerance_m)
    scored = evaluation.scores(signed, tolerance_m=tolerance_m, is_reached=reached, is_reached_visible=visible)
    return scored, reached if visible is None else visible


def bed_depth(scene: ComparedScene, nearest: np.ndarray, water_level: float | None) -> np.ndarray | None:
    """Depth (N,) [m] of the nearest point of the reference; None if neither a level nor the cloud gives it.

    Depths of the cloud itself would sort its points by their errors. The sum of depth and height is the water surface,
    which does not depend on the bed.
    """
    inputs = scene.inputs
    if water_level is not None:
        surface = inputs.cloud.points[inputs.inside].copy()
        surface[:, 2] = water_level
        return to_local(inputs.frame, surface, inputs.paths.cloud)[:, 2] - nearest[:, 2]
    depth = scene.extra(DEPTH_NAMES)
    return None if depth is None else depth + scene.points[:, 2] - nearest[:, 2]


def parts(scene: ComparedScene, distances: Distances, depth: np.ndarray | None, blocks: evaluation.Blocks) -> Parts:
    """Statistics by depth, incidence, number of views and slope, as far as these are known."""
    incidence, views, slope = (
        () if values is None else evaluation.by_band(distances.signed, values, edges, blocks)
        for values, edges in (
            (scene.extra(_INCIDENCE_NAMES), INCIDENCE_EDGES_DEG),
            (scene.extra(_VIEWS_NAMES), VIEWS_EDGES),
            (distances.slope_deg, SLOPE_EDGES_DEG),
        )
    )
    return Parts(depth_parts(distances.signed, depth, blocks), incidence, views, slope)


def depth_parts(
    distances: np.ndarray, depth: np.ndarray | None, blocks: evaluation.Blocks
) -> evaluation.DepthParts | None:
    """Statistics of distances (N,) [m] by depth (N,) [m]; None where no depth is known."""
    return None if depth is None or not np.isfinite(depth).any() else evaluation.by_depth(distances, depth, blocks)


def uncertainty(
    distances: Distances, errors: np.ndarray | None, depth: np.ndarray | None
) -> VerticalUncertainty | None:
    """The vertical uncertainty of IHO S-44 by vertical differences (N,) [m] to a mesh, by heights over a cloud.

    None where no depth is known.
    """
    message = "vertical difference to the reference; at walls a horizontal offset counts in full"
    if errors is None:
        errors, message = distances.signed, "height over the plane through the nearest points of the reference"
    iho = None if depth is None else evaluation.iho_s44(errors, depth, distances.reference_std)
    return None if iho is None else VerticalUncertainty(iho, message)


def cloud_to_cloud(scene: ComparedScene) -> dict[str, evaluation.DistanceStatistics]:
    """Distances without sign to the samples of the reference, and from them to the cloud."""
    with current().stage("Cloud to cloud"):
        to_reference, _ = evaluation.distance_to_cloud(scene.points, scene.samples)
        to_cloud, _ = evaluation.distance_to_cloud(scene.samples, scene.points)
    return {
        "to_reference": evaluation.distance_statistics(to_reference),
        "to_cloud": evaluation.distance_statistics(to_cloud),
    }


def m3c2(scene: ComparedScene, radius_m: float) -> M3C2:
    """M3C2 at some of the targets around the cloud: statistics, radius and share that is significant."""
    low, high = scene.points[:, :2].min(axis=0) - radius_m, scene.points[:, :2].max(axis=0) + radius_m
    near, core = (
        part[((part[:, :2] >= low) & (part[:, :2] <= high)).all(axis=1)] for part in (scene.samples, scene.targets)
    )
    core = core[np.random.default_rng(SEED).permutation(len(core))[:_CORE_POINTS]]
    with current().stage("M3C2"):
        found = evaluation.m3c2_distances(near, scene.points, core, radius_m=radius_m, reach_m=_REACH * radius_m)
    known = np.isfinite(found.signed) & np.isfinite(found.detection_m)
    detection, statistics = found.detection_m[known], evaluation.distance_statistics(found.signed)
    if not len(detection):
        return M3C2(statistics, radius_m, math.nan, math.nan)
    significant = float((np.abs(found.signed[known]) > detection).mean())
    return M3C2(statistics, radius_m, float(np.median(detection)), significant)


def read_checkpoints(
    path: Path, water_level: float | None = None, crs: CRS | None = None, units: Units | None = None
) -> np.ndarray:
    """Check points (K, 4) of a CSV: easting, northing, height in the CRS of the cloud, standard deviation [m].

    The last column may be missing (0 then). A first line names the columns, in any order; numbers alone have this
    order. Depths count from the level of the water, in the CRS of the cloud. See `survey.files.point_table`.
    """
    existing_file(path)
    require_same_crs(crs, crs_of_comment(path, CompareError), "the cloud", str(path))
    head = point_table(path, CompareError)
    rows = read_points(head, optional=("std",), by_place=True, level=water_level, give_level=GIVE_LEVEL, units=units)
    require_exact(rows, head)
    table = np.array([[*(row.number(name) for name in PLACE), row.number("std", default=0.0)] for row in rows])
    if not rows:
        raise CompareError(f"{path} has no check points; expected lines of easting, northing, height, std")
    for row, sigma in zip(rows, table[:, 3], strict=True):
        if sigma < 0.0:
            raise CompareError(f"{row.where}: std is {sigma:g}, expected metres, not negative")
    return table


def checkpoint_accuracy(scene: ComparedScene, table: np.ndarray, path: Path, notes: list[str]) -> CheckpointFigures:
    """Vertical accuracy of the compared cloud at check points (K, 4); adds notes on their shortcomings as a test."""
    places = to_local(scene.inputs.frame, table[:, :3], path)
    residuals = evaluation.height_at(scene.points, places[:, :2]) - places[:, 2]
    if not np.isfinite(residuals).any():
        require_same_place(scene.points, places, "the cloud", path.name)
        raise CompareError(f"none of the {len(places)} check points of {path.name} has points of the cloud around it")
    accuracy = evaluation.asprs_vertical(residuals, table[:, 3])
    lines, crs = [f"point {i}" for i in range(1, len(table) + 1)], scene.inputs.crs
    several = several_heights(lines, table, 1.0 if crs is None else height_unit_m(crs))
    notes += named(several, "place", f"of {path.name} with several heights, of which one is true at most")
    if not accuracy.is_enough:
        notes.append(
            f"{accuracy.n_checkpoints} check points of {path.name} lie on the cloud: ASPRS (Edition 2) requires "
            f"at least {MIN_CHECKPOINTS}, so that this is not a test of the product"
        )
    if not table[:, 3].any():
        notes.append(f"{path.name} gives no standard deviations: its check points are taken as free of error")
    return CheckpointFigures(accuracy, table[:, :3], residuals)
