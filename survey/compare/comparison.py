"""`bathynerf compare`: a cloud against a reference, in numbers and pictures, without alignment.

If the reference has no faces, distances are heights over local planes through its points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from evaluation import (
    Blocks,
    distance_statistics,
    distance_to_cloud,
    is_outlier,
    m3c2_distances,
    spatial_blocks,
)
from evaluation.c2m import Sign
from evaluation.completeness import SEED
from geo import Mesh
from geo.files import existing_file, reporting_disk_errors
from geo.shapes import vertices_of
from survey.compare import measure
from survey.compare.figures import M3C2, Circumstances, CloudToCloud, Comparison, Figures, numbers_of
from survey.compare.frame import metres_in_crs, to_local, within
from survey.compare.inputs import InputPaths, Inputs, is_table, level_of_cloud, load_inputs
from survey.compare.measure import ComparedScene, checkpoint_accuracy, read_checkpoints
from survey.compare.options import Bounds, CompareOptions, as_text, check_options, outlier_filter
from survey.compare.pictures import write_report
from survey.files.json_values import write_json
from survey.files.outputs import ReadFiles, is_json, require_file, require_folder
from survey.files.point_table import Units
from survey.progress import current

__all__ = ["CompareOptions", "Comparison", "compare_files", "compare_surfaces"]
# M3C2 is measured at this many places of the reference: enough for any statistics.
_CORE_POINTS = 20_000
# Half the length of its cylinders in radii.
_REACH = 10.0

# Share of points beside the mesh that is reported; fewer do not change figures of the inner 90 %.
_BESIDE_SHARE = 0.01


def compare_files(cloud: str | Path, reference: str | Path, *, options: CompareOptions | None = None) -> Figures:
    """Compare a cloud with a reference, and write JSON and pictures where the options say.

    Raises GeoError or SurveyError if a file or an option cannot be used; see `survey.compare.inputs.load_inputs`.

    Parameters
    ----------
    cloud, reference : as `geo.read_reference`
        The reference a mesh, or points: then the comparison is by heights over a surface through them.
    """
    options = options or CompareOptions()
    cloud, reference = Path(cloud), Path(reference)
    check_options(options)
    read = [Path(path) for path in (cloud, reference, options.visible, options.checkpoints) if path is not None]
    json_path, report_dir = (path and Path(path) for path in (options.json_path, options.report_dir))
    require_file("--json", json_path, ReadFiles.of(*read), kind="a JSON file", is_of_kind=is_json)
    require_folder("--report", report_dir, ReadFiles.of(*read), may_hold_inputs=True)
    comparison = compare_surfaces(cloud, reference, options)
    if options.report_dir is not None:
        with current().stage("Pictures"):
            folder = Path(options.report_dir)
            with reporting_disk_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
            write_report(comparison, folder)
    if options.json_path is not None:
        write_json(options.json_path, numbers_of(comparison.figures))
    return comparison.figures


def compare_surfaces(cloud: Path, reference: Path, options: CompareOptions) -> Comparison:
    """The comparison itself, with its distances; writes nothing. Parameters as `compare_files`."""
    check_options(options)
    inputs, checkpoints = _read(cloud, reference, options)
    inputs, is_left, of_outliers = _without_outliers(inputs, options)
    scene = ComparedScene.of(inputs, options.bounds, is_left, max(options.tolerances_m))
    distances, surface, of_distances = measure.distances_of(scene, cast("Sign", options.sign))
    blocks = spatial_blocks(scene.points[:, :2], distances.signed)
    depth = measure.bed_depth(scene, distances.nearest, options.water_level)
    reaches = []
    with current().stage("Completeness", len(options.tolerances_m)) as stage:
        for tolerance_m in options.tolerances_m:
            reaches.append(measure.reached_at(scene, tolerance_m))
            stage.advance()
    first = reaches[0]
    vertical, errors = measure.vertical(scene, depth, blocks)
    notes = [
        *inputs.notes,
        *of_outliers,
        *of_distances,
        *_visibility_note(inputs),
        *_bounds_note(inputs, options.bounds),
    ]
    notes += _edge_note(inputs, errors)
    found = None
    if checkpoints is not None:
        found, of_checkpoints = checkpoint_accuracy(scene, *checkpoints)
        notes += of_checkpoints
    figures = Figures(
        n_cropped=inputs.num_cropped,
        distances=distance_statistics(distances.signed, blocks),
        tolerances=tuple(reach.scores(distances.signed) for reach in reaches),
        parts=measure.parts(scene, distances, depth, blocks),
        reached=measure.reached_by_slope_of(distances, reaches),
        vertical=vertical,
        uncertainty=measure.uncertainty(distances, errors, depth),
        checkpoints=found,
        c2c=cloud_to_cloud(scene) if options.c2c else None,
        m3c2=None if options.m3c2_radius_m is None else m3c2(scene, options.m3c2_radius_m),
        reference_surface=surface,
        circumstances=_circumstances(scene, options, blocks, notes),
    )
    points, targets = inputs.cloud.points[inputs.inside], inputs.frame.crs_from_local(scene.targets)
    return Comparison(figures, points, distances.signed, distances.nearest, depth, targets, first.targets, inputs)


def _read(cloud: Path, reference: Path, options: CompareOptions) -> tuple[Inputs, tuple[np.ndarray, Path] | None]:
    """Cloud and reference, and check points (K, 4) with their file, where there are any."""
    paths = InputPaths(Path(cloud), Path(reference), None if options.visible is None else Path(options.visible))
    places = None if options.checkpoints is None else Path(options.checkpoints)
    if places is None and is_table(paths.reference):
        # Between measured points nothing is known, so that the cloud is also evaluated at each of them.
        places = paths.reference
    for path in (paths.cloud, paths.reference, paths.visible):
        if path is not None:
            existing_file(path)
    # Before the clouds and meshes, which take longer to read.
    if places is not None:
        # Units and depths need the cloud.
        read_checkpoints(places, 0.0)
    with current().stage("Reading"):
        inputs = load_inputs(paths, options.bounds, options.water_level)
    if places is None:
        return inputs, None
    level = level_of_cloud(inputs.cloud) if options.water_level is None else options.water_level
    return inputs, (read_checkpoints(places, level, inputs.crs, Units.of(inputs.crs)), places)


def _circumstances(
    scene: ComparedScene, options: CompareOptions, blocks: Blocks, notes: Sequence[str]
) -> Circumstances:
    is_mesh, crs, paths = isinstance(scene.inputs.reference, Mesh), scene.inputs.crs, scene.inputs.paths
    narrow = (
        f"the errors are correlated over {blocks.correlation_m:.3g} m, too far for the extent of the cloud: the "
        "confidence intervals may be too short"
    )
    return Circumstances(
        outliers=options.outliers,
        block_m=blocks.size_m,
        correlation_length_m=blocks.correlation_m,
        widening=blocks.widening,
        water_level=options.water_level,
        method="cloud to mesh" if is_mesh else "cloud to local planes of a cloud",
        sign=cast("Sign", options.sign) if is_mesh else "up",
        crs=None if crs is None else crs.name,
        bounds=options.bounds,
        cloud=str(paths.cloud),
        reference=str(paths.reference),
        visible=None if paths.visible is None else str(paths.visible),
        n_samples=len(scene.samples),
        seed=SEED if is_mesh else None,
        notes=(*notes, narrow) if blocks.is_narrow else tuple(notes),
    )


def _without_outliers(inputs: Inputs, options: CompareOptions) -> tuple[Inputs, np.ndarray, list[str]]:
    """The inputs without outliers among what is compared, which points of the file (N,) are left, and a note."""
    is_left = np.ones(len(inputs.inside), dtype=bool)
    if options.outliers is None:
        return inputs, is_left, []
    neighbours, num_std = outlier_filter(options.outliers)
    with current().stage("Outliers"):
        points = to_local(inputs.frame, inputs.cloud.points, inputs.paths.cloud)
        is_left = ~is_outlier(points, neighbours=neighbours, num_std=num_std)
    lost = int((inputs.inside & ~is_left).sum())
    note = (
        f"{lost} of {int(inputs.inside.sum())} points were left out as outliers ({options.outliers}: mean distance to "
        f"{neighbours} neighbours over its mean plus {num_std:g} standard deviations)"
    )
    return replace(inputs, inside=inputs.inside & is_left), is_left, [note]


def _visibility_note(inputs: Inputs) -> list[str]:
    """A note where it is not known which parts of a mesh the cameras see."""
    if not isinstance(inputs.reference, Mesh) or inputs.visible is not None:
        return []
    return [
        f"completeness counts all of {inputs.paths.reference.name}, also what no camera sees (undersides, ground "
        "beside the photographs): give the points that cameras see as --visible; --bounds crops the cloud alone"
    ]


def _edge_note(inputs: Inputs, errors: np.ndarray | None) -> list[str]:
    """A note on points beside the mesh, whose distance is that to the edge of the mesh."""
    if errors is None:
        return []
    beyond_share = float(np.mean(np.isnan(errors)))
    if beyond_share <= _BESIDE_SHARE:
        return []
    low, high = (corner(vertices_of(inputs.reference), axis=0)[:2].tolist() for corner in (np.min, np.max))
    name, box = inputs.paths.reference.name, (*low, *high)
    message = (
        f"{100.0 * beyond_share:.1f} % of the points have no surface of {name} above or below: their distance is that "
        "to its nearest edge, not an error of the cloud"
    )
    around = np.isnan(errors) & ~within(inputs.cloud.points[inputs.inside], box, metres_in_crs(inputs.frame, 0.01))
    if around.mean() > _BESIDE_SHARE:
        return [f"{message}; crop the cloud to the reference by --bounds {as_text(box)}, or less"]
    return [
        f"{message}; they are in holes of {name}, or between its edge and the box around it: fill it, or give --bounds"
    ]


def _bounds_note(inputs: Inputs, bounds: Bounds | None) -> list[str]:
    """A note on a reference that reaches beyond the bounds."""
    if bounds is None:
        return []
    vertices = vertices_of(inputs.reference)
    outside = 1.0 - float(np.mean(within(vertices, bounds, metres_in_crs(inputs.frame, 0.01))))
    if outside <= 0.001:
        return []
    return [
        f"{100.0 * outside:.1f} % of {inputs.paths.reference.name} lies outside the bounds: completeness counts it "
        "as not reached where the cropped cloud does not reach it"
    ]


def cloud_to_cloud(scene: ComparedScene) -> CloudToCloud:
    """Distances without sign to the samples of the reference, and from them to the cloud."""
    with current().stage("Cloud to cloud"):
        to_reference, _ = distance_to_cloud(scene.points, scene.samples)
        to_cloud, _ = distance_to_cloud(scene.samples, scene.points)
    return CloudToCloud(distance_statistics(to_reference), distance_statistics(to_cloud))


def m3c2(scene: ComparedScene, radius_m: float) -> M3C2:
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
