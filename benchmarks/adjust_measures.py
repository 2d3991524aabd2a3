"""How far a run is from the truth: its cloud, rods, parameters of its adjustment, poses."""

from __future__ import annotations

import csv
import json
import math
import tempfile
import tomllib
from pathlib import Path

import numpy as np
from adjust_rows import Row, Truth

from evaluation import height_at, vertical_difference
from geo import LocalFrame, parse_crs, read_cloud, read_reference
from survey.benchmark.benchmark import run_bathynerf
from survey.compare.measure import read_checkpoints

# Of a normal distribution, within so many standard deviations.
WITHIN_95 = 1.96
FIGURES = ("n_points", "mean_inner90_m", "std_inner90_m")
SHARES = ("accuracy_share", "completeness_visible")
# Points of a cloud that may belong to a rod.
NEAR_M = 0.5


def errors_of(row: Row, run: Path) -> dict:
    """All that can be measured of a finished run over a drawn survey."""
    truth = row.truth
    record = compared(row.survey, run, truth.reference, truth.visible)
    if truth.checkpoints is not None:
        record |= rod_errors(run / "cloud.las", truth.checkpoints, truth.reference)
    return record | parameter_errors(run, truth) | pose_errors(row.survey, run, truth)


def compared(survey: Path, run: Path, reference: Path, visible: Path) -> dict:
    """The errors of the cloud of a run within the bounds of its survey."""
    bounds = [str(v) for v in tomllib.loads((survey / "survey.toml").read_text(encoding="utf-8"))["area"]["bounds"]]
    record = {}
    for tolerance in ("0.2", "0.05"):
        out = run / f"compare_{tolerance}.json"
        options = ["--visible", str(visible), "--tolerance", tolerance, "--bounds", *bounds, "--json", str(out), "-q"]
        with tempfile.TemporaryDirectory() as home:
            code, _, words = run_bathynerf(["compare", str(run / "cloud.las"), str(reference), *options], Path(home))
        if code != 0:
            raise SystemExit(words)
        numbers = json.loads(out.read_text(encoding="utf-8"))
        record |= {k: numbers[k] for k in FIGURES} | {f"{k}_{tolerance}": numbers[k] for k in SHARES}
        for part in ("wet", "dry"):
            record |= {f"{part}_{k}": numbers[part][k] for k in FIGURES} if numbers.get(part) else {}
    return record


def rod_errors(cloud: Path, rods: Path, reference: Path) -> dict:
    """Height of the cloud over rods that stood on the bed, and that of the true bed at the points of the cloud."""
    table, points, bed = read_checkpoints(rods), read_cloud(cloud).points, read_reference(reference)
    off = height_at(points, table[:, :2]) - table[:, 2]
    known = np.isfinite(off)
    if not known.any():
        return {"rods": 0}
    near = np.min([np.hypot(*(points[:, :2] - place).T) for place in table[known, :2]], axis=0) < NEAR_M
    middle = bed.vertices.mean(axis=0)
    true = points[near].copy()
    true[:, 2] -= vertical_difference(true - middle, bed.vertices - middle, bed.faces)
    true = true[np.isfinite(true[:, 2])]
    least = height_at(true, table[:, :2]) - table[:, 2]
    rms, floor = (math.sqrt(np.nanmean(each[known] ** 2)) for each in (off, least))
    mean = float(np.mean(off[known]))
    return {"rods": int(known.sum()), "rods_rms_m": rms, "rods_mean_m": mean, "rods_floor_rms_m": floor}


def parameter_errors(run: Path, truth: Truth) -> dict:
    """Error, stated standard deviation and status of every parameter in adjustment.json whose truth is known."""
    path = run / "adjustment.json"
    if not path.is_file():
        return {}
    found = {}
    for parameter in json.loads(path.read_text(encoding="utf-8"))["parameters"]:
        name = parameter["name"]
        last = name.split(".")[-1]
        true = truth.water.get(name, truth.lens.get({"fx": "f", "fy": "f"}.get(last, last)))
        if true is None or parameter.get("value") is None:
            continue
        off, std = parameter["value"] - true, parameter.get("std")
        found[name] = {"error": off, "std": std, "status": parameter.get("status")}
        if std and parameter.get("status") == "free":
            found[name]["in_95"] = abs(off) <= WITHIN_95 * std
    return {"parameters": found}


def pose_errors(survey: Path, run: Path, truth: Truth) -> dict:
    """Of the poses in cameras.csv of a run, against the true ones."""
    path = run / "cameras.csv"
    if truth.cameras is None or not path.is_file():
        return {}
    found, true = read_poses(path), read_poses(truth.cameras)
    names = sorted(set(found) & set(true))
    settings = tomllib.loads((survey / "survey.toml").read_text(encoding="utf-8"))
    places = np.array([[true[name][0], found[name][0]] for name in names])
    frame = LocalFrame(parse_crs(settings["crs"]), tuple(places[:, 0].mean(axis=0)))
    off = frame.local_from_crs(places[:, 1]) - frame.local_from_crs(places[:, 0])
    turned = [math.degrees(rotation_angle(true[name][1] @ found[name][1].T)) for name in names]
    return {
        "poses": len(names),
        "missing_poses": len(set(true) - set(found)),
        "position_rms_m": np.sqrt(np.mean(off**2, axis=0)).tolist(),
        "position_mean_m": off.mean(axis=0).tolist(),
        "rotation_rms_deg": math.sqrt(np.mean(np.square(turned))),
    }


def read_poses(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Centre (3,) in crs and grid-from-camera (3, 3) of each image of a cameras.csv."""
    poses = {}
    with path.open(encoding="utf-8", newline="") as stream:
        for line in csv.DictReader(stream):
            centre = np.array([float(line[k]) for k in ("easting", "northing", "height")])
            omega, phi, kappa = (math.radians(float(line[k])) for k in ("omega", "phi", "kappa"))
            poses[line["image"]] = (centre, _turn(0, omega) @ _turn(1, phi) @ _turn(2, kappa))
    return poses


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about an axis."""
    matrix, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i], matrix[i, j] = math.sin(angle), -math.sin(angle)
    return matrix


def rotation_angle(rotation: np.ndarray) -> float:
    """Angle [rad] of a rotation matrix."""
    axis = [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    return math.atan2(float(np.linalg.norm(axis)), float(np.trace(rotation)) - 1.0)
