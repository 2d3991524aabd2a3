"""`bathynerf compare`: a cloud against a reference, in numbers and pictures, without alignment.

If the reference has no faces, distances are heights over local planes through its points.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from evaluation import Blocks, distance_statistics, is_outlier, reached_by_slope, spatial_blocks, vertical_difference
from evaluation.bootstrap import LEVEL, NUM_DRAWS
from evaluation.bootstrap import SEED as BOOTSTRAP_SEED
from evaluation.c2m import SEED, Sign
from geo import Cloud, Mesh
from geo.atl24 import SUFFIXES as ATL24
from geo.atl24 import read_atl24
from geo.files import existing_file, reporting_disk_errors
from geo.shapes import vertices_of
from survey.compare import measure
from survey.compare.figures import Comparison, Figures, numbers_of
from survey.compare.inputs import (
    InputPaths,
    Inputs,
    is_table,
    level_of_cloud,
    load_inputs,
    metres_in_crs,
    to_local,
    within,
)
from survey.compare.measure import ComparedScene, read_checkpoints
from survey.compare.options import Bounds, CompareOptions, as_text, check_options, outlier_filter
from survey.files.json_values import write_json
from survey.files.paths import ReadFiles, is_json, require_file, require_folder
from survey.files.point_table import Units
from survey.progress import current

__all__ = ["CompareOptions", "Comparison", "compare_files", "compare_surfaces"]

# Share of points beside the mesh that is reported; fewer do not change figures of the inner 90 %.
_BESIDE_SHARE = 0.01


def compare_files(cloud: str | Path, reference: str | Path, *, options: CompareOptions | None = None) -> Figures:
    """Compare a cloud with a reference, and write JSON and pictures where the options say.

    Files are read as by `geo.read_reference`. With a reference of points the comparison is by heights over a surface
    through them. Raises GeoError or SurveyError if a file or an option cannot be used.
    """
    options = options or CompareOptions()
    cloud, reference = Path(cloud), Path(reference)
    check_options(options)
    read = [Path(path) for path in (cloud, reference, options.visible, options.checkpoints) if path is not None]
    json_path, report_dir = (path and Path(path) for path in (options.json_path, options.report_dir))
    require_file("--json", json_path, ReadFiles.of(*read), kind="a JSON file", is_of_kind=is_json)
    require_folder("--report", report_dir, ReadFiles.of(*read), may_hold_inputs=True)
    comparison = compare_surfaces(cloud, reference, options)
    if report_dir is not None:
        # matplotlib, which numbers alone do not need.
        from survey.compare.pictures import drawings_of

        with current().stage("Pictures"):
            with reporting_disk_errors(report_dir):
                report_dir.mkdir(parents=True, exist_ok=True)
            for name, draw in drawings_of(comparison):
                draw(report_dir / f"{name}.png")
    if json_path is not None:
        write_json(json_path, numbers_of(comparison.figures))
    return comparison.figures


def compare_surfaces(cloud: Path, reference: Path, options: CompareOptions) -> Comparison:
    """The comparison itself, with its distances; writes nothing. Parameters as `compare_files`."""
    check_options(options)
    inputs, checkpoints = _read(cloud, reference, options)
    notes = list(inputs.notes)
    inputs, is_left = _without_outliers(inputs, options, notes)
    scene = ComparedScene.of(inputs, options.bounds, is_left, max(options.tolerances_m))
    distances, surface = measure.distances_of(scene, cast("Sign", options.sign), notes)
    blocks = spatial_blocks(scene.points[:, :2], distances.signed)
    depth = measure.bed_depth(scene, distances.nearest, options.water_level)
    reaches = []
    with current().stage("Completeness", len(options.tolerances_m)) as stage:
        for tolerance_m in options.tolerances_m:
            reaches.append(measure.completeness(scene, distances.signed, tolerance_m))
            stage.advance()
    scored, is_reached = zip(*reaches, strict=True)
    errors, slope_deg = None, distances.target_slope_deg
    if isinstance(inputs.reference, Mesh):
        with current().stage("Vertical differences", len(scene.points)) as stage:
            faces = inputs.reference.faces
            errors = vertical_difference(scene.points, scene.reference, faces, advance=stage.advance)
    notes += [*_visibility_note(inputs), *_bounds_note(inputs, options.bounds), *_edge_note(inputs, errors)]
    figures = Figures(
        n_cropped=inputs.num_cropped,
        distances=distance_statistics(distances.signed, blocks),
        tolerances=scored,
        parts=measure.parts(scene, distances, depth, blocks),
        reached=() if slope_deg is None else reached_by_slope(slope_deg, is_reached),
        vertical=None if errors is None else distance_statistics(errors, blocks),
        vertical_depth=None if errors is None else measure.depth_parts(errors, depth, blocks),
        uncertainty=measure.uncertainty(distances, errors, depth),
        checkpoints=None if checkpoints is None else measure.checkpoint_accuracy(scene, *checkpoints, notes),
        c2c=measure.cloud_to_cloud(scene) if options.c2c else None,
        m3c2=None if options.m3c2_radius_m is None else measure.m3c2(scene, options.m3c2_radius_m),
        reference_surface=surface,
        circumstances=_circumstances(scene, options, blocks, notes),
    )
    points, targets = inputs.cloud.points[inputs.inside], inputs.frame.crs_from_local(scene.targets)
    return Comparison(figures, points, distances.signed, distances.nearest, targets, is_reached[0], inputs)


def _read(cloud: Path, reference: Path, options: CompareOptions) -> tuple[Inputs, tuple[np.ndarray, Path] | None]:
    """Cloud and reference, and check points (K, 4) with their file, where there are any."""
    paths = InputPaths(Path(cloud), Path(reference), None if options.visible is None else Path(options.visible))
    places = None if options.checkpoints is None else Path(options.checkpoints)
    if places is None and (is_table(paths.reference) or paths.reference.suffix.lower() in ATL24):
        # Between measured points nothing is known, so that the cloud is also evaluated at each of them.
        places = paths.reference
    for path in (paths.cloud, paths.reference, paths.visible, places):
        if path is not None:
            existing_file(path)
    # Before the clouds and meshes, which take longer to read.
    if places is not None and places.suffix.lower() not in ATL24:
        # Units and depths need the cloud.
        read_checkpoints(places, 0.0)
    with current().stage("Reading"):
        inputs = load_inputs(paths, options.bounds, options.water_level)
    if places is None:
        return inputs, None
    if places.suffix.lower() in ATL24:
        if places == paths.reference and isinstance(inputs.reference, Cloud):
            photons = inputs.reference
        else:
            photons = read_atl24(places, inputs.crs, inputs.cloud.points)
            inputs = replace(inputs, notes=inputs.notes + photons.notes)
        return inputs, (np.column_stack([photons.points, photons.extra["std"]]), places)
    level = level_of_cloud(inputs.cloud) if options.water_level is None else options.water_level
    return inputs, (read_checkpoints(places, level, inputs.crs, Units.of(inputs.crs)), places)


def _circumstances(scene: ComparedScene, options: CompareOptions, blocks: Blocks, notes: list[str]) -> dict[str, Any]:
    is_mesh, crs, paths = isinstance(scene.inputs.reference, Mesh), scene.inputs.crs, scene.inputs.paths
    if blocks.is_narrow:
        notes.append(
            f"the errors are correlated over {blocks.correlation_m:.3g} m, too far for the extent of the cloud: the "
            "confidence intervals may be too short"
        )
    return {
        "outliers": options.outliers,
        "water_level": options.water_level,
        "method": "cloud to mesh" if is_mesh else "cloud to local planes of a cloud",
        "sign": options.sign if is_mesh else "up",
        "crs": None if crs is None else crs.name,
        "bounds": options.bounds,
        "cloud": str(paths.cloud),
        "reference": str(paths.reference),
        "visible": None if paths.visible is None else str(paths.visible),
        "n_samples": len(scene.samples),
        "seed": SEED if is_mesh else None,
        "notes": notes,
        "confidence": {
            "level": LEVEL,
            "method": "block bootstrap",
            "block_m": blocks.size_m,
            "correlation_length_m": blocks.correlation_m,
            "widening": blocks.widening,
            "draws": NUM_DRAWS,
            "seed": BOOTSTRAP_SEED,
        },
    }


def _without_outliers(inputs: Inputs, options: CompareOptions, notes: list[str]) -> tuple[Inputs, np.ndarray]:
    """The inputs without outliers among what is compared, and which points of the file (N,) are left; adds a note."""
    if options.outliers is None:
        return inputs, np.ones(len(inputs.inside), dtype=bool)
    neighbours, num_std = outlier_filter(options.outliers)
    with current().stage("Outliers"):
        points = to_local(inputs.frame, inputs.cloud.points, inputs.paths.cloud)
        is_left = ~is_outlier(points, neighbours=neighbours, num_std=num_std)
    notes.append(
        f"{int((inputs.inside & ~is_left).sum())} of {int(inputs.inside.sum())} points were left out as outliers "
        f"({options.outliers}: mean distance to {neighbours} neighbours over its mean plus {num_std:g} standard "
        "deviations)"
    )
    return replace(inputs, inside=inputs.inside & is_left), is_left


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
    if errors is None or (beyond_share := float(np.mean(np.isnan(errors)))) <= _BESIDE_SHARE:
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
    is_within = within(vertices_of(inputs.reference), bounds, metres_in_crs(inputs.frame, 0.01))
    outside = 1.0 - float(np.mean(is_within))
    if outside <= 0.001:
        return []
    return [
        f"{100.0 * outside:.1f} % of {inputs.paths.reference.name} lies outside the bounds: completeness counts it "
        "as not reached where the cropped cloud does not reach it"
    ]
