"""`bathynerf compare`: a cloud against a reference, in numbers and pictures; nothing is aligned."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation import distance_to_cloud, distance_to_mesh, is_reached, sample_mesh, summarise
from evaluation.c2m import Sign
from evaluation.completeness import NUM_SAMPLES, SEED
from geo import Cloud, Mesh, write_whole
from survey.compare_inputs import (
    Bounds,
    CompareError,
    Inputs,
    check_bounds,
    load_inputs,
    metres_in_crs,
    to_local,
    vertices_of,
    within,
)
from survey.compare_report import write_report
from survey.progress import current

# Extra bytes that hold the depth below the water, in metres.
_DEPTH_NAMES = ("depth", "depth_m")


@dataclass(frozen=True)
class CompareOptions:
    """How a cloud is compared.

    Attributes
    ----------
    tolerance_m : float [m]
        For completeness, accuracy share and F-score.
    visible : Path, optional
        Points of the reference that cameras see.
    bounds : (E0, N0, E1, N1), optional, in crs
        Crop the cloud to this first.
    sign : {"up", "winding"}
        See `evaluation.distance_to_mesh`.
    json_path, report_dir : Path, optional
        Where the numbers and the pictures go.
    """

    tolerance_m: float = 0.2
    visible: Path | None = None
    bounds: Bounds | None = None
    sign: Sign = "up"
    json_path: Path | None = None
    report_dir: Path | None = None


@dataclass(frozen=True)
class Comparison:
    """A finished comparison.

    Attributes
    ----------
    numbers : dict
        As `compare_files` returns it.
    points : (N, 3), in crs
        The compared points.
    distances : (N,) [m]
        Theirs; signed unless the reference is a cloud.
    targets : (M, 3), in crs
        What should be reached: the visible points, else samples of the reference.
    is_reached : (M,) bool
    inputs : Inputs
    """

    numbers: dict
    points: np.ndarray
    distances: np.ndarray
    targets: np.ndarray
    is_reached: np.ndarray
    inputs: Inputs

    @property
    def distances_of_cloud(self) -> np.ndarray:
        """Distances of all points of the file [m], in its order, NaN outside the bounds."""
        distances = np.full(len(self.inputs.inside), np.nan)
        distances[self.inputs.inside] = self.distances
        return distances


def compare_files(cloud: Path, reference: Path, *, options: CompareOptions | None = None) -> dict:
    """Compare a cloud with a reference, and write JSON and pictures where the options say.

    Parameters
    ----------
    cloud : LAS, LAZ or PLY
    reference : PLY, OBJ, LAS or LAZ
        A mesh, or points: then the comparison is cloud to cloud, without sign.

    Returns
    -------
    dict
        Everything of `evaluation.summarise`, and ``method``, ``sign``, ``crs``, ``bounds``, ``cloud``,
        ``reference``, ``visible``, ``n_samples``, ``seed`` and ``notes``, a list of sentences. Values that do
        not exist are None.

    Raises
    ------
    GeoError, SurveyError
        If a file or an option cannot be used; see `survey.compare_inputs.load_inputs`.
    """
    options = options or CompareOptions()
    for folder in (options.json_path and Path(options.json_path).parent, options.report_dir):
        if folder is not None:
            _make_folder(Path(folder))
    comparison = compare_surfaces(cloud, reference, options)
    if options.report_dir is not None:
        with current().stage("Pictures"):
            write_report(comparison, Path(options.report_dir))
    if options.json_path is not None:
        text = json.dumps(comparison.numbers, indent=2, allow_nan=False) + "\n"
        with write_whole(options.json_path) as stream:
            stream.write(text.encode())
    return comparison.numbers


def compare_surfaces(cloud: Path, reference: Path, options: CompareOptions) -> Comparison:
    """The comparison itself, with its distances; writes nothing. Parameters as `compare_files`."""
    _check_options(options)
    cloud, reference = Path(cloud), Path(reference)
    visible = Path(options.visible) if options.visible is not None else None
    with current().stage("Reading"):
        inputs = load_inputs(cloud, reference, visible, options.bounds)
    notes = list(inputs.notes)
    points = inputs.cloud.points[inputs.inside]
    points_local = to_local(inputs.frame, points, cloud)
    reference_local = to_local(inputs.frame, vertices_of(inputs.reference), reference)
    distances, nearest = _distances(points_local, reference_local, inputs.reference, options.sign, notes)

    around = within(inputs.cloud.points, options.bounds, metres_in_crs(inputs.frame, options.tolerance_m))
    around_local = to_local(inputs.frame, inputs.cloud.points[around], cloud)
    with current().stage("Completeness"):
        samples = _samples(reference_local, inputs.reference)
        reached = is_reached(samples, around_local, tolerance_m=options.tolerance_m)
        targets, reached_targets = samples, reached
        if inputs.visible is not None:
            targets = _samples(to_local(inputs.frame, vertices_of(inputs.visible), visible), inputs.visible)
            reached_targets = is_reached(targets, around_local, tolerance_m=options.tolerance_m)
    _note_extent(inputs, options.bounds, reference, notes)
    numbers = summarise(
        distances,
        tolerance_m=options.tolerance_m,
        is_reached=reached,
        is_reached_visible=reached_targets if inputs.visible is not None else None,
        num_cropped=int((~inputs.inside).sum()),
        depth_m=_bed_depth(inputs, points_local, nearest),
    )
    is_mesh = isinstance(inputs.reference, Mesh)
    numbers |= {
        "method": "cloud to mesh" if is_mesh else "cloud to cloud",
        "sign": options.sign if is_mesh else None,
        "crs": inputs.crs.name if inputs.crs is not None else None,
        "bounds": [float(v) for v in options.bounds] if options.bounds is not None else None,
        "cloud": str(cloud),
        "reference": str(reference),
        "visible": str(visible) if visible is not None else None,
        "n_samples": len(samples),
        "seed": SEED if is_mesh else None,
        "notes": notes,
    }
    targets_crs = inputs.frame.crs_from_local(targets)
    return Comparison(without_nan(numbers), points, distances, targets_crs, reached_targets, inputs)


def without_nan(value):
    """A tree of dicts and lists with None in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _check_options(options: CompareOptions) -> None:
    if not (math.isfinite(options.tolerance_m) and options.tolerance_m > 0.0):
        raise CompareError(f"--tolerance is {options.tolerance_m:g}, expected metres above zero, e.g. 0.2")
    if options.sign not in ("up", "winding"):
        raise CompareError(f'--sign is "{options.sign}", expected up or winding')
    check_bounds(options.bounds)


def _make_folder(folder: Path) -> None:
    """Before anything is computed, so that a wrong path costs no time."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise CompareError(f"{folder} cannot be a folder, because a file is in the way; name another one") from error


def _distances(
    points: np.ndarray, vertices: np.ndarray, reference: Mesh | Cloud, sign: Sign, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) and nearest points (N, 3) of the reference, local [m]."""
    with current().stage("Distances", len(points)) as stage:
        if not isinstance(reference, Mesh):
            notes.append("the reference is a cloud: distances are to its nearest point and have no sign")
            distances, numbers = distance_to_cloud(points, vertices)
            return distances, vertices[numbers]
        result = distance_to_mesh(points, vertices, reference.faces, sign=sign, advance=stage.advance)
    if result.num_degenerate:
        notes.append(f"{result.num_degenerate} triangles of the reference have no area and were left out")
    return result.signed, result.nearest


def _samples(vertices: np.ndarray, shape: Mesh | Cloud) -> np.ndarray:
    """Points (M, 3) that a complete cloud would reach: spread over a mesh by area, all points of a cloud."""
    return sample_mesh(vertices, shape.faces, NUM_SAMPLES) if isinstance(shape, Mesh) else vertices


def _bed_depth(inputs: Inputs, points_local: np.ndarray, nearest: np.ndarray) -> np.ndarray | None:
    """Depth (N,) [m] of the nearest point of the reference, if the cloud carries depths; else None.

    The cloud's depth alone would sort its points by what it got wrong; its sum with the height is the water
    surface, which does not depend on the bed.
    """
    name = next((name for name in _DEPTH_NAMES if name in inputs.cloud.extra), None)
    if name is None:
        return None
    depth = np.asarray(inputs.cloud.extra[name], dtype=np.float64)[inputs.inside]
    return depth + points_local[:, 2] - nearest[:, 2]


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
