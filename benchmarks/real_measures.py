"""Measures of bench_real.py: a cloud along a lidar profile, targets left out of a block, points of other programs."""

from __future__ import annotations

import csv
import shutil
import tomllib
from pathlib import Path

import numpy as np
import tomli_w
from bench_real_points import corrected, palau, read_stream
from pyproj import Transformer

from geo import read_cloud
from survey.adjust.applied import apply_adjustment
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment, ControlResidual
from survey.adjust.result.std_common import place_jacobian
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import TiePoints

# Of greenland_lake (SOURCE.txt): water, index of the lidar's green light, and where its profile fits best.
LEVEL_M, LIDAR_INDEX, SHIFT_M, LAKE_CRS = 611.42, 1.339, (5.0, 3.0), 32622
# Points of the cloud that are compared: as near to the profile, over as much water.
STRIP_M, LEAST_DEPTH_M = 7.0, 0.5
# Lidar heights nearer to the water than this are of its surface, and clouds higher over it are no bed.
SURFACE_M, OVER_WATER_M = 0.12, 0.5
# Of the lake's photographs, what the area of the survey has of the profile: northings [m].
NORTH_M = (7658030.0, 7658255.0)
TO_95, STEP_M = 1.959964, 0.01


def profile(cloud: Path, lidar: Path) -> dict:
    """Depths of the cloud under water beside the lidar profile, against those of the lidar over its index."""
    east, north, height = lidar_places(lidar)
    used = (height < LEVEL_M - SURFACE_M) & (north > NORTH_M[0]) & (north < NORTH_M[1])
    order = np.argsort(north[used])
    east, north, true = (each[used][order] for each in (east, north, (LEVEL_M - height) / LIDAR_INDEX))
    found = read_cloud(cloud)
    x, y, z = found.points.T
    beside = np.abs(x - np.interp(y, north, east)) < STRIP_M
    deep = np.interp(y, north, true)
    rows = beside & (y > north[0]) & (y < north[-1]) & (deep > LEAST_DEPTH_M)
    depth, deep, std = LEVEL_M - z[rows], deep[rows], np.asarray(found.extra["std"])[rows]
    off = depth - deep
    inner = np.median(off)
    return {
        "points": int(rows.sum()),
        "ratio": float(depth @ deep / (deep @ deep)),
        "median_ratio": float(np.median(depth / deep)),
        "bias_m": float(off.mean()),
        "scatter_m": float(off.std()),
        "nmad_m": float(1.4826 * np.median(np.abs(off - inner))),
        "std_m": float(np.median(std)),
        "within": float((np.abs(off) < TO_95 * std).mean()),
        "over_water": int((depth < -OVER_WATER_M).sum()),
    }


def lidar_places(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Easting, northing and height [m] of the lidar's points, shifted to where they fit best."""
    table = np.genfromtxt(path, delimiter=",")
    east, north = Transformer.from_crs(4326, LAKE_CRS, always_xy=True).transform(table[:, 0], table[:, 1])
    return east + SHIFT_M[0], north + SHIFT_M[1], table[:, 2]


def left_out(source: Path, folder: Path) -> dict:
    """Each target of a survey left out in turn: where its marks meet less its coordinates, and the std of that."""
    with (source / "gcps.csv").open(encoding="utf-8") as stream:
        targets = list(csv.DictReader(stream))
    rows, warnings = {}, []
    for target in targets:
        name = target["name"]
        survey = load_survey(_without(source, folder / name, targets, name), workspace=folder / "sfm")
        found = adjust_survey(survey, use_windows=False)
        residual = next((each for each in found.control if each.name == name), None)
        if residual is None:
            continue
        std = _std(survey, found, residual, (float(target["std_horizontal"]),) * 2 + (float(target["std_height"]),))
        rows[name] = {"off_m": list(residual.residual_m), "std_m": std.tolist(), "marks": residual.num_marks}
        warnings += [text for text in found.warnings if "control" in text and text not in warnings]
    return {"targets": rows, "warnings": warnings}


# What a rolling shutter is asked with: its readout, known to as much, and the speed of a small aircraft.
SHUTTER = {"rolling_shutter_s": 0.03, "rolling_shutter_std_s": 0.03, "speed_m_s": 12.0}


def shutter(source: Path, folder: Path, workspace: Path) -> dict:
    """The readout that a block finds, and heights of check targets with a global and with a rolling shutter."""
    with (source / "gcps.csv").open(encoding="utf-8") as stream:
        checks = {target["name"] for target in csv.DictReader(stream) if target["role"] == "check"}
    found: dict = {}
    for name, asked in {"global": {}, "rolling": SHUTTER}.items():
        survey = folder / name
        if not survey.is_dir():
            survey.mkdir(parents=True)
            (survey / "images").symlink_to((source / "images").resolve())
            for each in ("marks.csv", "gcps.csv"):
                shutil.copy(source / each, survey / each)
            table = tomllib.loads((source / "survey.toml").read_text(encoding="utf-8"))
            table["cameras"] |= asked
            (survey / "survey.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
        adjusted = adjust_survey(load_survey(survey, workspace=workspace), use_windows=False)
        up = [each.residual_m[2] for each in adjusted.control if each.name in checks]
        found[name] = {"check_up_m": up}
        if asked:
            readout = adjusted.parameter("camera0.readout_s")
            found[name] |= {"readout_s": readout.value, "std_s": readout.std}
    return found


def _without(source: Path, folder: Path, targets: list[dict], name: str) -> Path:
    """The survey with one target as a check point, and all others as control."""
    if not folder.is_dir():
        folder.mkdir(parents=True)
        (folder / "images").symlink_to((source / "images").resolve())
        for each in ("marks.csv", "survey.toml"):
            shutil.copy(source / each, folder / each)
        with (folder / "gcps.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, targets[0])
            writer.writeheader()
            for target in targets:
                writer.writerow(target | {"role": "check" if target["name"] == name else "control"})
    return folder


def _std(survey: Survey, found: Adjustment, residual: ControlResidual, given_m: tuple[float, ...]) -> np.ndarray:
    """Standard deviation (3,) [m] of a residual: of the block, of the marks, and of the coordinates."""
    control, adjusted = survey.observations.control, apply_adjustment(survey, found)
    assert control is not None
    number = {name: k for k, name in enumerate(found.poses.names)}
    marks = [mark for mark in control.marks if mark.point == residual.name and mark.view in number]
    views = np.array([number[mark.view] for mark in marks])
    place = next(point.local for point in control.points if point.name == residual.name) + np.array(residual.residual_m)
    ties = TiePoints(place[None], np.zeros(len(marks), np.int64), views, np.array([mark.pixel for mark in marks]))
    jacobian = place_jacobian(found, adjusted.water, ties)[0]
    of_block = np.diag(jacobian @ found.covariance.matrix @ jacobian.T)
    cameras = [adjusted.views[view].lens.camera(v.centre, v.cam_from_local)
               for view in views for v in [adjusted.views[view].camera]]  # fmt: skip
    steps = STEP_M * np.eye(3)
    design = np.concatenate([
        np.stack([(c.project(place + s, None) - c.project(place - s, None)) / (2.0 * STEP_M) for s in steps], axis=-1)
        for c in cameras
    ])  # fmt: skip
    std_px = found.statistics.std_px.get("marks") or control.marks_std_px
    of_marks = np.diag(np.linalg.inv(design.T @ design)) * std_px**2
    return np.sqrt(of_block + of_marks + np.square(given_m))


def streams(data: Path) -> dict:
    """Points that other programs made with straight rays: how far corrections are from what is known."""
    stream = read_stream(data / "pyBathySfM")
    block, theirs = stream.near
    ours = corrected(block, stream.straight)
    truth, methods = palau(data / "palau_coral_heights")
    rms = {name: float(np.sqrt(np.mean((found - truth) ** 2))) for name, found in methods.items()}
    apart = np.abs(ours.methods()["per camera (Dietrich)"] - theirs)
    return {
        "points": len(stream.straight),
        "per_camera_apart_m": float(apart.max()),
        "bent_over_straight": float(np.median(ours.bent / ours.straight)),
        "heads": len(truth),
        "palau_rms_m": rms,
    }
