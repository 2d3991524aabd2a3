"""What do real photographs give? A lidar profile through a lake, and RTK targets left out one after another.

    python benchmarks/bench_real.py [MEASURE ...] [-o FOLDER] [--publish]

Measures, each into real.json of the work folder, which keeps those that are not asked for:

greenland    `process` on real/greenland_lake as it is, and with straight rays (index 1); depth against the lidar
targets      real/swindale adjusted by its matches, with each of its targets left out in turn
shutter      real/swindale asked for a rolling shutter
streams      real/pyBathySfM and real/palau_coral_heights by bench_real_points.py

--publish writes benchmarks/results/real.json, the tables of docs/real.md and, with greenland, its
picture. BATHYNERF_DATA names the folder of the data. The first takes some minutes of processor time, the second the
time of structure from motion and some seconds for each target.
"""

import argparse
import csv
import json
import os
import shutil
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tomli_w
from bench_methods import run_bathynerf
from bench_real_points import corrected, palau, read_stream
from pyproj import Transformer
from tables import TABLES, publish

from evaluation.summary import std_by_median
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
ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data")) / "real"
PUBLISHED, PAGE = ROOT / "benchmarks" / "results" / "real.json", ROOT / "docs" / "real.md"
INDEX, STRAIGHT = "refractive_index = 1.3352", "refractive_index = 1.0"
# Of the picture of the lake.
LAKE_PICTURE = ROOT / "docs" / "img" / "real-profile.png"
EAST_M, CELL_M, PIECE_M, FEWEST = (560700.0, 560840.0), 2.0, 3.0, 50
COLOURS = {"bent": "#1f6fb4", "straight": "#d1662a"}


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
        "nmad_m": float(std_by_median(off - inner)),
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


def greenland(folder: Path) -> dict:
    """The lake with bent and with straight rays."""
    found = {}
    for name in ("bent", "straight"):
        survey = folder / name
        if not survey.is_dir():
            shutil.copytree(DATA / "greenland_lake", survey)
            settings = survey / "survey.toml"
            text = settings.read_text(encoding="utf-8")
            settings.write_text(text.replace(INDEX, STRAIGHT) if name == "straight" else text, encoding="utf-8")
        run = survey / "bathynerf"
        if not (run / "cloud.las").is_file():
            with tempfile.TemporaryDirectory() as home:
                _, _, words = run_bathynerf(["process", str(survey)], Path(home))
            if not (run / "cloud.las").is_file():
                raise SystemExit(f"{survey}: {words}")
        found[name] = profile(run / "cloud.las", DATA / "greenland_lake" / "lidar_profile_lon_lat_height.csv")
    return found


MEASURES: dict[str, Callable[[Path], dict]] = {
    "greenland": greenland,
    "targets": lambda folder: left_out(DATA / "swindale", folder),
    "shutter": lambda folder: shutter(DATA / "swindale", folder, folder.parent / "targets" / "sfm"),
    "streams": lambda folder: streams(DATA),
}


def draw(folder: Path) -> None:
    """The lake along its lidar profile and its bed; the blue strip is 1.96 times the stated random std."""
    from matplotlib import pyplot as plt

    runs = {name: read_cloud(folder / "greenland" / name / "bathynerf" / "cloud.las") for name in COLOURS}
    east, north, height = lidar_places(DATA / "greenland_lake" / "lidar_profile_lon_lat_height.csv")
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 4.2), width_ratios=[1.7, 1.0], dpi=90)
    for name, cloud in runs.items():
        along, over, reach = _profile(cloud, east, north)
        left.plot(along, over, color=COLOURS[name], label=f"{name} rays")
        if name == "bent":
            left.fill_between(
                along, over - reach, over + reach, color=COLOURS[name], alpha=0.15, lw=0, label="1.96 std"
            )
    wet, dry = height < LEVEL_M - SURFACE_M, height > LEVEL_M + SURFACE_M
    true = np.where(wet, (height - LEVEL_M) / LIDAR_INDEX, height - LEVEL_M)
    shown = (wet | dry) & (north > NORTH_M[0]) & (north < NORTH_M[1])
    left.plot(north[shown] - NORTH_M[0], true[shown], "k.", ms=5, label="lidar over its index")
    left.axhline(0.0, color="#7fb2d6", lw=1)
    left.set(xlabel="north along the profile [m]", ylabel="height over the water [m]", ylim=(-7.0, 2.0))
    left.legend(frameon=False, fontsize=8)
    extent = [0.0, EAST_M[1] - EAST_M[0], 0.0, NORTH_M[1] - NORTH_M[0]]
    image = right.imshow(_raster(runs["bent"].points), origin="lower", extent=extent, vmin=-6.0, vmax=3.0)
    figure.colorbar(image, ax=right, label="height over the water [m]")
    right.plot(east[shown] - EAST_M[0], north[shown] - NORTH_M[0], "w-", lw=1)
    right.set(xlabel="east [m]", ylabel="north [m]")
    figure.tight_layout()
    figure.savefig(LAKE_PICTURE)


def _profile(cloud, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along the profile: northing, median height over the water and 1.96 times the median std of each step [m]."""
    x, y, z = cloud.points.T
    order, std = np.argsort(north), np.asarray(cloud.extra["std"])
    beside = np.abs(x - np.interp(y, north[order], east[order])) < STRIP_M
    rows = []
    for first in np.arange(*NORTH_M, PIECE_M):
        here = beside & (y >= first) & (y < first + PIECE_M)
        if here.sum() > FEWEST:
            middle = first + 0.5 * PIECE_M - NORTH_M[0]
            rows.append((middle, np.median(z[here]) - LEVEL_M, 1.96 * np.median(std[here])))
    return tuple(np.array(rows).T)


def _raster(points: np.ndarray) -> np.ndarray:
    """Mean height over the water in cells, the lowest northing first; NaN without a point."""
    edges = [np.arange(low, high + CELL_M, CELL_M) for low, high in (NORTH_M, EAST_M)]
    at = (points[:, 1], points[:, 0])
    total, *_ = np.histogram2d(*at, bins=edges, weights=points[:, 2] - LEVEL_M)
    count, *_ = np.histogram2d(*at, bins=edges)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=f"default: {' '.join(MEASURES)}")
    parser.add_argument("-o", "--output", type=Path, help="work folder; default: a new temporary one")
    parser.add_argument("--publish", action="store_true", help="into docs and benchmarks/results")
    options = parser.parse_args()
    unknown = set(options.measures) - set(MEASURES)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))} is none of {', '.join(MEASURES)}")
    if not DATA.is_dir():
        raise SystemExit(f"no data at {DATA}; set BATHYNERF_DATA")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_real_"))
    folder.mkdir(parents=True, exist_ok=True)
    results = folder / "real.json"
    found = json.loads(results.read_text(encoding="utf-8")) if results.is_file() else {}
    for name in options.measures or MEASURES:
        (folder / name).mkdir(exist_ok=True)
        found[name] = MEASURES[name](folder / name)
        results.write_text(json.dumps(found, indent=1), encoding="utf-8")
        print("\n".join(TABLES[name](found[name])), flush=True)  # noqa: T201
    if options.publish:
        shutil.copyfile(results, PUBLISHED)
        for name in found:
            publish(PAGE, name, TABLES[name](found[name]))
        if "greenland" in (options.measures or MEASURES):
            draw(folder)


if __name__ == "__main__":
    main()
