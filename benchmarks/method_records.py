"""Records of a benchmark: cost of each process, accuracy of its cloud against the truth, and their file.

Methods are the whole chain, parts of it, and the baselines of the literature. Baselines get the same photographs, poses
and sweep as the whole chain; only the refraction is taken away, by a survey without water, and put back afterwards as
the literature does.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from baselines import per_camera, times_index
from method_cases import Case
from std_coverage import WALL_DEG, Coverage, slope_below

from evaluation import vertical_difference
from geo import Mesh, read_cloud, write_cloud
from geo.files import write_text
from refract import FlatWater, PinholeCamera
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.compare.figures import Comparison
from survey.compare.inputs import to_local
from survey.errors import SurveyError
from survey.files.foreign_text import read_foreign_json
from survey.files.json_values import plain
from survey.folder.found import find_survey
from survey.folder.local_frame import water_in_local
from survey.run.flight import load_flight

# Version of the layout of the file; another one is not read.
VERSION = 2
_TABLE = ("version", "machine", "versions", "commit", "records")
TOLERANCES_M = (0.05, 0.1, 0.2)
_STD, _STD_COMMON = "std", "std_common"
# Points at a time: each has an angle for every camera.
_BATCH = 100_000


@dataclass(frozen=True)
class Cost:
    """Cost of a process, start and imports included."""

    # wall_s, processor_s [s]: processor time is that of all threads
    wall_s: float
    processor_s: float
    peak_bytes: int  # [B]: largest resident memory of the process and its children


@dataclass(frozen=True)
class Errors:
    """Errors of a cloud against the true bed, within the bounds of the survey."""

    n_points: int
    # mean_m, std_m [m]: of the signed distances of the inner 90 %
    mean_m: float
    std_m: float
    rms_m: float  # [m]: of all distances
    completeness: dict[str, float]  # dict: share of the points that cameras see, by tolerance in metres, e.g. "0.05".
    # Share of vertical errors, their median taken off, below 1.96 times the `std` that the points carry, where the
    # surface is not a wall; None where they carry none
    coverage: float | None
    # median_m, common_m [m] or None: that median, and the median of `std_common`; within 2.6 times it in 99 % of cases
    median_m: float | None = None
    common_m: float | None = None

    @property
    def error_m(self) -> float:
        """Root of mean squared and std squared [m]: what the picture has over the time."""
        return (self.mean_m**2 + self.std_m**2) ** 0.5


@dataclass(frozen=True)
class Record:
    """Record of a method on a survey."""

    # case, method, quality, poses, device: Together the name of the record, see `key`
    case: str
    method: str
    quality: str
    poses: str
    device: str
    exit_code: int  # Of `process`; 3 where a quality gate failed
    costs: tuple[Cost, ...]  # One for each repeat
    errors: Errors | None  # None where no cloud was written; `words` has the reason
    words: str = ""

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """Key by which records of two files are paired."""
        return self.case, self.method, self.quality, self.poses, self.device


@dataclass(frozen=True)
class Results:
    """All records of a benchmark and where they were measured."""

    # machine, versions: dict of str to str
    machine: dict[str, str]
    versions: dict[str, str]
    commit: str  # Of the working tree, else the hash of the code
    records: tuple[Record, ...]


def write_results(path: Path, results: Results) -> None:
    """Write the results as JSON, a line for each record, whole or not at all."""
    table = {"version": VERSION} | plain(replace(results, records=()))
    head = json.dumps(table, ensure_ascii=False).removesuffix("[]}")
    lines = ",\n".join(json.dumps(plain(record), ensure_ascii=False) for record in results.records)
    write_text(path, f"{head}[\n{lines}\n]}}\n")


def read_results(path: Path) -> Results:
    """The results in a file of `write_results`."""
    table = read_foreign_json(Path(path), SurveyError)
    if isinstance(table, dict) and table.get("version", VERSION) != VERSION:
        raise SurveyError(f"{path} has the layout {table['version']!r}, expected {VERSION}; measure it again")
    missing = [name for name in _TABLE if not isinstance(table, dict) or name not in table]
    if missing:
        raise SurveyError(
            f"{path} has no {missing[0]!r}, expected {', '.join(_TABLE)}; name a results.json that `bathynerf "
            "benchmark` wrote"
        )
    records = []
    try:
        for entry in table["records"]:
            errors = None if entry["errors"] is None else Errors(**entry["errors"])
            costs = tuple(Cost(**cost) for cost in entry["costs"])
            records.append(Record(**(entry | {"costs": costs, "errors": errors})))
    except (KeyError, TypeError, AttributeError) as error:
        raise SurveyError(
            f"record {len(records) + 1} of {path} has not the fields of layout {VERSION}; measure it again"
        ) from error
    return Results(table["machine"], table["versions"], table["commit"], tuple(records))


def errors_of(cloud: Path, case: Case) -> Errors:
    """The errors of a cloud."""
    found = compare_surfaces(
        cloud, case.reference, CompareOptions(TOLERANCES_M, visible=case.visible, bounds=case.bounds)
    )
    of_all = found.figures.distances
    shares = {
        f"{scores.tolerance_m:g}": scores.completeness if case.visible is None else scores.completeness_visible
        for scores in found.figures.tolerances
    }
    coverage, median_m, common_m = _stated(found)
    return Errors(
        n_points=of_all.n_points,
        mean_m=of_all.mean_inner90_m,
        std_m=of_all.std_inner90_m,
        rms_m=of_all.rms_m,
        completeness={tolerance: float(share) for tolerance, share in shares.items() if share is not None},
        coverage=coverage,
        median_m=median_m,
        common_m=common_m,
    )


def _stated(found: Comparison) -> tuple[float | None, float | None, float | None]:
    """`Errors.coverage`, `median_m` and `common_m`, of points with a std, over a mesh, where that is not a wall."""
    reference, extra = found.inputs.reference, found.inputs.cloud.extra
    if _STD not in extra or not isinstance(reference, Mesh):
        return None, None, None
    paths = found.inputs.paths
    points = to_local(found.inputs.frame, found.points, paths.cloud)
    vertices = to_local(found.inputs.frame, reference.vertices, paths.reference)
    error = vertical_difference(points, vertices, reference.faces)
    known = np.isfinite(error) & (slope_below(points, vertices, reference.faces) < WALL_DEG)
    if not known.any():
        return None, None, None
    std = {name: extra[name][found.inputs.inside][known] for name in (_STD, _STD_COMMON) if name in extra}
    error, median = error[known], float(np.median(error[known]))
    common = std.get(_STD_COMMON, np.empty(0))
    common = common[np.isfinite(common)]
    covered = Coverage.of(error - median, std[_STD], np.isfinite(std[_STD]))
    return covered.share, median, float(np.median(common)) if len(common) else None


@dataclass(frozen=True)
class Method:
    """Method: a way from photographs to a cloud."""

    name: str
    words: str  # For tables and pictures
    field: str = "auto"  # The option of `process`
    is_refracted: bool = True  # False: the survey is processed as if it were dry
    # "", "times_index" or "per_camera": what is done to the depths of the cloud afterwards, see `write_corrected`
    correction: str = ""


METHODS = {
    method.name: method
    for method in (
        Method("full", "whole chain"),
        Method("sweep", "sweep alone", field="off"),
        Method("straight", "straight rays", is_refracted=False),
        Method("times_index", "straight rays, depth times n", is_refracted=False, correction="times_index"),
        Method("per_camera", "straight rays, corrected per camera", is_refracted=False, correction="per_camera"),
    )
}


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
