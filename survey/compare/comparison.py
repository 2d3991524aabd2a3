"""`bathynerf compare`: a cloud against a reference, in numbers and pictures; nothing is aligned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from evaluation import Blocks, is_outlier, scores, spatial_blocks, summarise
from evaluation.bootstrap import LEVEL, NUM_DRAWS
from evaluation.bootstrap import SEED as SEED_OF_DRAWS
from evaluation.completeness import SEED
from geo import Mesh
from geo.files import disk_refusals
from survey.compare import measure
from survey.compare.checkpoints import checkpoint_accuracy, read_checkpoints
from survey.compare.inputs import (
    Bounds,
    Inputs,
    load_inputs,
    metres_in_crs,
    to_local,
    vertices_of,
    within,
)
from survey.compare.options import CompareOptions, check_options, check_outputs, outlier_filter
from survey.compare.pictures import write_report
from survey.compare.result import Comparison
from survey.json_values import plain, write_json
from survey.progress import current

__all__ = ["CompareOptions", "Comparison", "compare_files", "compare_surfaces"]


def compare_files(cloud: Path, reference: Path, *, options: CompareOptions | None = None) -> dict:
    """Compare a cloud with a reference, and write JSON and pictures where the options say.

    Parameters
    ----------
    cloud, reference : as `geo.read_reference`
        The reference a mesh, or points: then the comparison is cloud to cloud, without sign.

    Returns
    -------
    dict
        Everything of `evaluation.summarise` and `survey.compare.measure.parts`; ``tolerances``, a list of
        `evaluation.scores` at each; ``vertical``, ``iho_s44``, ``asprs``, ``c2c``, ``m3c2`` where there is such;
        ``outliers``, ``water_level``, ``confidence``, ``method``, ``sign``, ``crs``, ``bounds``, ``cloud``,
        ``reference``, ``visible``, ``n_samples``, ``seed`` and ``notes``, a list of sentences. Values that do not
        exist are None.

    Raises
    ------
    GeoError, SurveyError
        If a file or an option cannot be used; see `survey.compare.inputs.load_inputs`.
    """
    options = options or CompareOptions()
    check_outputs(options, cloud, reference)
    comparison = compare_surfaces(cloud, reference, options)
    if options.report_dir is not None:
        with current().stage("Pictures"):
            folder = Path(options.report_dir)
            with disk_refusals(folder):
                folder.mkdir(parents=True, exist_ok=True)
            write_report(comparison, folder)
    if options.json_path is not None:
        write_json(options.json_path, comparison.numbers)
    return comparison.numbers


def compare_surfaces(cloud: Path, reference: Path, options: CompareOptions) -> Comparison:
    """The comparison itself, with its distances; writes nothing. Parameters as `compare_files`."""
    check_options(options)
    paths = Path(cloud), Path(reference), Path(options.visible) if options.visible is not None else None
    with current().stage("Reading"):
        inputs = load_inputs(*paths, options.bounds)
        checkpoints = None if options.checkpoints is None else read_checkpoints(Path(options.checkpoints))
    notes = list(inputs.notes)
    num_cropped = int((~inputs.inside).sum())
    inputs, is_left = _without_outliers(inputs, options, paths[0], notes)
    scene = measure.Scene.of(inputs, options.bounds, is_left, max(options.tolerances_m), paths)
    distances, nearest = measure.distances_of(scene, options.sign, notes)
    blocks = spatial_blocks(scene.points[:, :2], distances)
    depth = measure.bed_depth(scene, nearest, options.water_level, paths[0])
    with current().stage("Completeness", len(options.tolerances_m)) as stage:
        reaches = []
        for tolerance_m in options.tolerances_m:
            reaches.append(measure.reached_at(scene, tolerance_m))
            stage.advance()
    _note_extent(inputs, options.bounds, paths[1], notes)
    numbers = summarise(distances, num_cropped=num_cropped, blocks=blocks, **reaches[0])
    numbers["tolerances"] = [scores(distances, **reach) for reach in reaches]
    numbers |= measure.parts(scene, distances, depth, blocks) | measure.vertical(scene, distances, depth, blocks)
    if checkpoints is not None:
        numbers["asprs"] = checkpoint_accuracy(scene, checkpoints, Path(options.checkpoints), notes)
    if options.c2c:
        numbers["c2c"] = measure.cloud_to_cloud(scene)
    if options.m3c2_radius_m is not None:
        numbers["m3c2"] = measure.m3c2(scene, options.m3c2_radius_m)
    numbers |= _circumstances(scene, options, blocks, paths, notes)
    reached = reaches[0].get("is_reached_visible", reaches[0]["is_reached"])
    targets = inputs.frame.crs_from_local(scene.targets)
    points = inputs.cloud.points[inputs.inside]
    return Comparison(plain(numbers), points, distances, nearest, depth, targets, reached, inputs)


def _circumstances(
    scene: measure.Scene, options: CompareOptions, blocks: Blocks, paths: tuple, notes: list[str]
) -> dict:
    """How the numbers came about."""
    is_mesh, crs = isinstance(scene.inputs.reference, Mesh), scene.inputs.crs
    if blocks.is_narrow:
        notes.append(
            f"the errors are correlated over {blocks.correlation_m:.3g} m, too far for the extent of the cloud: the "
            "intervals of confidence may be too short"
        )
    return {
        "outliers": options.outliers,
        "confidence": {
            "level": LEVEL,
            "method": "block bootstrap",
            "block_m": blocks.size_m,
            "correlation_length_m": blocks.correlation_m,
            "widening": blocks.widening,
            "draws": NUM_DRAWS,
            "seed": SEED_OF_DRAWS,
        },
        "water_level": options.water_level,
        "method": "cloud to mesh" if is_mesh else "cloud to cloud",
        "sign": options.sign if is_mesh else None,
        "crs": crs.name if crs is not None else None,
        "bounds": [float(v) for v in options.bounds] if options.bounds is not None else None,
        "cloud": str(paths[0]),
        "reference": str(paths[1]),
        "visible": str(paths[2]) if paths[2] is not None else None,
        "n_samples": len(scene.samples),
        "seed": SEED if is_mesh else None,
        "notes": notes,
    }


def _without_outliers(
    inputs: Inputs, options: CompareOptions, path: Path, notes: list[str]
) -> tuple[Inputs, np.ndarray]:
    """The inputs without outliers among what is compared, and which points of the file (N,) are left."""
    is_left = np.ones(len(inputs.inside), dtype=bool)
    if options.outliers is None:
        return inputs, is_left
    neighbours, num_std = outlier_filter(options.outliers)
    with current().stage("Outliers"):
        points = to_local(inputs.frame, inputs.cloud.points, path)
        is_left = ~is_outlier(points, neighbours=neighbours, num_std=num_std)
    lost = int((inputs.inside & ~is_left).sum())
    notes.append(
        f"{lost} of {int(inputs.inside.sum())} points were left out as outliers ({options.outliers}: mean distance to "
        f"{neighbours} neighbours over its mean plus {num_std:g} standard deviations)"
    )
    return replace(inputs, inside=inputs.inside & is_left), is_left


def _note_extent(inputs: Inputs, bounds: Bounds | None, path: Path, notes: list[str]) -> None:
    if bounds is None:
        return
    vertices = vertices_of(inputs.reference)
    outside = 1.0 - float(np.mean(within(vertices, bounds, metres_in_crs(inputs.frame, 0.01))))
    if outside > 0.001:
        notes.append(
            f"{100.0 * outside:.1f} % of {path.name} lies outside the bounds: completeness counts it as not "
            "reached where the cropped cloud does not reach it"
        )
