"""How far a run is from the truth: its cloud, rods, parameters of its adjustment, poses."""

import csv
import json
import math
import tempfile
import tomllib
from pathlib import Path

import numpy as np
from adjust_rows import Row, Truth
from bench_methods import run_bathynerf
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from evaluation import height_at, vertical_difference
from evaluation.summary import MAD_TO_STD
from geo import LocalFrame, parse_crs, read_cloud, read_reference
from refract.lens import Lens, undistorted
from survey.compare.measure import read_checkpoints
from survey.photos.poses import CAM_FROM_OPK_CAM

# Of a normal distribution, within so many standard deviations.
WITHIN_95 = 1.96
FIGURES = ("n_points", "mean_inner90_m", "std_inner90_m")
SHARES = ("accuracy_share", "completeness_visible")
# Points of a cloud that may belong to a rod.
NEAR_M = 0.5
# Of the grids of heights [m], and of the checkerboard, of which one colour decides the translation.
CELL_M, BOARD_M = 0.2, 2.0
# Where the translation is searched [m], and in which steps at first.
REACH_M, STEP_M = 10.0, 1.0
# The part of brighton_beach that the photographs see through water: east, north, low then high.
SHORE = (576721.0, 5188115.0, 576738.0, 5188129.0)


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


def brighton_errors(row: Row, run: Path) -> dict:
    """The cloud against model.laz on land, after one translation that half of the land decides.

    east_m, north_m and up_m say where the cloud lies, seen from the model.
    """
    cloud, model = read_cloud(run / "cloud.las").points, read_reference(row.truth.reference).points
    wet = (model[:, :2] > SHORE[:2]).all(axis=1) & (model[:, :2] < SHORE[2:]).all(axis=1)
    model, corner = model[~wet], model.min(axis=0)
    # The heights of both may be far apart; the grid of the cloud reaches as far as the search.
    found = _heights(cloud - corner, REACH_M, np.ptp(model[:, :2], axis=0))
    true = _heights(model - corner, 0.0, np.ptp(model[:, :2], axis=0))
    cells = np.argwhere(np.isfinite(true))
    places, true = (cells + 0.5) * CELL_M, true[tuple(cells.T)]
    board = np.floor(places / BOARD_M).astype(int).sum(axis=1) % 2 == 0

    def apart(shift: np.ndarray, which: np.ndarray) -> np.ndarray:
        at = ((places[which] + shift + REACH_M) / CELL_M - 0.5).T
        return map_coordinates(found, at, order=1, cval=np.nan) - true[which]

    def spread(shift: np.ndarray) -> float:
        """Without the bend of the block, which a translation along a slope would imitate."""
        off = apart(shift, board)
        return _nmad(_less_quadratic(places[board], off)) if np.isfinite(off).sum() > 0.3 * board.sum() else REACH_M

    steps = np.arange(-REACH_M, REACH_M + 0.5 * STEP_M, STEP_M)
    start = min(((x, y) for x in steps for y in steps), key=lambda s: spread(np.array(s)))
    shift = minimize(spread, start, method="Nelder-Mead", options={"xatol": 0.005, "fatol": 1e-5}).x
    lift = np.nanmedian(apart(shift, board))
    off = apart(shift, ~board) - lift
    straightened = _less_quadratic(places[~board], off)
    numbers = {
        "cells": int(np.isfinite(off).sum()),
        "share_seen": float(np.isfinite(off).mean()),
        "east_m": float(shift[0]),
        "north_m": float(shift[1]),
        "up_m": float(lift),
        "nmad_m": _nmad(off),
        "nmad_less_quadratic_m": _nmad(straightened),
        "bend_m": float(np.nanpercentile(off - straightened, 98) - np.nanpercentile(off - straightened, 2)),
    }
    return {"real": numbers}


def _heights(points: np.ndarray, margin: float, size: np.ndarray) -> np.ndarray:
    """Mean height in cells (east, north) from -margin to size + margin, NaN where there is none."""
    shape = np.ceil((size + 2.0 * margin) / CELL_M).astype(int)
    cell = np.floor((points[:, :2] + margin) / CELL_M).astype(int)
    inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    number = np.ravel_multi_index(tuple(cell[inside].T), shape)
    count = np.bincount(number, minlength=shape.prod())
    with np.errstate(invalid="ignore"):
        mean = np.bincount(number, points[inside, 2], minlength=shape.prod()) / count
    return mean.reshape(shape)


def _less_quadratic(places: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Differences (N,) at places (N, 2) less a quadratic polynomial that most of them follow."""
    x, y = ((places - places.mean(axis=0)) / 50.0).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    left, inlier = off, np.isfinite(off)
    for _ in range(4):
        fit = np.linalg.lstsq(terms[inlier], off[inlier], rcond=None)[0]
        left = off - terms @ fit
        inlier = np.abs(left) < 3.0 * _nmad(left)
    return left


def _nmad(off: np.ndarray) -> float:
    return MAD_TO_STD * float(np.nanmedian(np.abs(off - np.nanmedian(off))))


def copr_errors(row: Row, run: Path) -> dict:
    """Control points that were left out: where their rays meet, and by how many pixels they miss each other.

    across_m and across_gsd are root mean squares, and contain how wrong the coordinates of these points are;
    height_m is the spread of their heights, which nobody measured.
    """
    if not (run / "cameras.csv").is_file() or not (run / "adjustment.json").is_file():
        return {"real": {}}
    settings = tomllib.loads((row.survey / "survey.toml").read_text(encoding="utf-8"))
    poses, lens = read_poses(run / "cameras.csv"), _lens(run)
    frame = LocalFrame(parse_crs(settings["crs"]), tuple(np.mean([c for c, _ in poses.values()], axis=0)))
    marks: dict[str, list] = {}
    for line in (row.survey / "left_out.txt").read_text(encoding="utf-8").splitlines()[1:]:
        e, n, _, u, v, image, point = line.split()
        if image in poses:
            marks.setdefault(point, []).append((float(e), float(n), float(u) + 0.5, float(v) + 0.5, image))
    off, off_gsd, meet_px, heights = [], [], [], []
    for seen in marks.values():
        if len(seen) < 2:
            continue
        plane = undistorted(lens, np.array([mark[2:4] for mark in seen]))
        centres = np.array([poses[mark[4]][0] for mark in seen])
        origin, axes = frame.local_from_crs(centres), frame.local_from_grid(centres)
        turns = [a @ poses[mark[4]][1] @ CAM_FROM_OPK_CAM for a, mark in zip(axes, seen, strict=True)]
        rays = np.array([t @ [x, y, 1.0] for t, (x, y) in zip(turns, plane, strict=True)])
        point = _where_rays_meet(origin, rays / np.linalg.norm(rays, axis=1, keepdims=True))
        known = frame.local_from_crs(np.array([[*seen[0][:2], frame.crs_from_local(point[None])[0, 2]]]))[0]
        gsd = float(np.linalg.norm(origin - point, axis=1).mean()) / lens.focal[0]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        apart = np.linalg.norm(np.cross(point - origin, rays), axis=1) / gsd
        off.append(np.linalg.norm((point - known)[:2]))
        off_gsd.append(off[-1] / gsd)
        meet_px.append(np.sqrt(np.mean(apart**2)))
        heights.append(float(frame.crs_from_local(point[None])[0, 2]))
    if not off:
        return {"real": {}}
    numbers = {
        "left_out": len(off),
        "across_m": _rms(off),
        "across_gsd": _rms(off_gsd),
        "meet_px": _rms(meet_px),
        "height_m": float(np.ptp(heights)),
    }
    return {"real": numbers}


def _rms(values: list) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _lens(run: Path) -> Lens:
    """The adjusted lens of the only camera, and the size of its photographs."""
    found = json.loads((run / "adjustment.json").read_text(encoding="utf-8"))
    values = {p["name"].split(".")[-1]: p["value"] for p in found["parameters"] if p["name"].startswith("camera0.")}
    settings = tomllib.loads((run / "settings.toml").read_text(encoding="utf-8"))
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    params = [values.get(name, values.get("f", 0.0) if name[0] == "f" else 0.0) for name in names]
    return Lens("OPENCV", tuple(params), *settings["cameras"]["size_px"])


def _where_rays_meet(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to all rays (N, 3), in least squares."""
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, origin))
