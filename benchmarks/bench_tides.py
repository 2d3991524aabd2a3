"""One reef at six tides: its low tide, dry, is the truth for what each treatment of refraction makes of the others.

    python benchmarks/bench_tides.py -o FOLDER [--levels M ...] [--publish]

The same reef, flown over by the same cameras, is simulated dry and under five levels of the water. Treatments: straight
rays; their depths times the index; their depths corrected per camera (Dietrich 2017); straight rays with positions as
RTK has them and ten control points, all under water; bent rays with the true level; and bent rays with these positions
and control, and a level that is given 15 cm off.
Rows are of each cloud less the terrain model of the dry survey, over wet points in its bounds: median, and std of the
inner 90 %. FOLDER/tides.json has them, and what it has is not computed again; --publish writes table and picture into
docs/prove-it.md. About ten minutes of one core.
"""

import argparse
import csv
import json
import tomllib
from pathlib import Path

import numpy as np
import tomli_w
from method_cases import case_of, variant
from method_records import write_corrected
from scipy.interpolate import RegularGridInterpolator
from tables import publish

from bathynerf import Dem, Progress, Run, load_survey, process, read_cloud, read_reference, simulate
from evaluation import distance_statistics
from geo import write_ply
from survey.display.canvas import canvas, save, write_title
from survey.errors import FILE_NAME
from survey.simulate.simulate import simulate_flight

DOCS = Path(__file__).resolve().parent.parent / "docs"
ORIGIN = (676120.0, 5311480.0, 584.2)
# Levels [m] over the origin; the reef lies from about 3.2 to 0.8 m below it.
LEVELS = (-2.4, -1.8, -1.2, -0.6, 0.0)
SIZE_M, CELL_M, HEADS = (9.0, 8.0), 0.05, 60
TREATMENTS = {
    "straight": "straight rays",
    "times_index": "depth times n",
    "per_camera": "corrected per camera",
    "straight_control": "straight rays, control under water",
    "bent": "bent rays, true level",
    "control": "bent rays, level 15 cm off, control under water",
}
# Errors of positions [m] across and up, of a given level [m], of control points [m] and their marks [px].
POSITION_STD_M, LEVEL_OFF_M, CONTROL_STD_M, MARK_STD_PX, NUM_CONTROL = (0.02, 0.03), 0.15, 0.01, 0.3, 10
# Ground that is less deep is left out [m].
SHALLOWEST_M = 0.05


def reef(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) [m], local, and triangles (F, 3) of a slope with coral heads."""
    wide, deep = (np.arange(-0.5 * side - 3.0, 0.5 * side + 3.0, CELL_M) for side in SIZE_M)
    x, y = np.meshgrid(wide, deep)
    z = -2.9 + 0.06 * y + 0.05 * np.sin(1.3 * x) * np.cos(1.1 * y)
    for _ in range(HEADS):
        east, north = rng.uniform((wide[0], deep[0]), (wide[-1], deep[-1]))
        radius, height = rng.uniform(0.25, 0.9), rng.uniform(0.1, 0.8)
        z += height * np.exp(-((((x - east) ** 2 + (y - north) ** 2) / radius**2) ** 1.5))
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]), np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])


def scene(level_m: float | None, flight: dict) -> dict:
    """A scene file of the reef under a level, or dry."""
    water = {} if level_m is None else {"water": {"level_m": ORIGIN[2] + level_m, "refractive_index": 1.34}}
    return {
        "name": "reef", "crs": "EPSG:25832+7837", "origin": list(ORIGIN), "seed": 5, "area": {"size_m": list(SIZE_M)},
        "bed": {"kind": "mesh", "file": "reef.ply", "frame": "local"}, "texture": {"kind": "sand"}, **water,
        "camera": {"size_px": [480, 360], "focal_px": 800.0}, "flight": flight,
        "sensor": {"noise": 1.5, "exposure": 1.5}, "render": {"mode": "direct"},
    }  # fmt: skip


def drawn(folder: Path, level_m: float | None) -> Path:
    """The survey of a level, simulated where it is not there."""
    name = "dry" if level_m is None else f"{level_m:+.1f}"
    flight, place = folder / "flight", folder / name
    if not (folder / "reef.ply").is_file():
        vertices, faces = reef(np.random.default_rng(5))
        write_ply(folder / "reef.ply", vertices, faces=faces)
        patterns = {"height_m": 20.0, "patterns": ["nadir", "oblique"], "forward_overlap": 0.75, "side_overlap": 0.6}
        (folder / "flight.toml").write_text(tomli_w.dumps(scene(0.0, patterns | {"ring_views": 6})), encoding="utf-8")
        simulate_flight(folder / "flight.toml", flight)
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(scene(level_m, {"poses": "flight/cameras.csv"})), encoding="utf-8")
    simulate(path, place)
    return place


def with_control(place: Path, level_m: float, *, bends: bool) -> Path:
    """A copy of a survey as RTK, a level that is off (or no water) and control under water give it."""
    survey, copy = load_survey(place), place.with_name(f"{place.name}_{'bent' if bends else 'straight'}_control")
    rng = np.random.default_rng(round(100.0 * abs(level_m)))
    copy.mkdir(exist_ok=True)
    table = tomllib.loads((place / FILE_NAME).read_text(encoding="utf-8"))
    table["images"] = {"dir": str((place / "images").absolute())}
    across, up = POSITION_STD_M
    table["cameras"] |= {"poses": "cameras.csv", "position_std_m": [across, across, up]}
    if bends:
        table["water"] |= {"level_m": ORIGIN[2] + level_m + LEVEL_OFF_M, "level_std_m": LEVEL_OFF_M}
    else:
        del table["water"]
    table["control"] = {"gcps": "gcp_list.txt", "std_m": CONTROL_STD_M, "marks_std_px": MARK_STD_PX}
    (copy / FILE_NAME).write_text(tomli_w.dumps(table), encoding="utf-8")
    with (place / "cameras.csv").open(encoding="utf-8", newline="") as stream:
        head, *rows = list(csv.reader(stream))
    for row in rows:
        shift = rng.normal(0.0, (across, across, up))
        row[1:4] = [f"{float(value) + off:.4f}" for value, off in zip(row[1:4], shift, strict=True)]
    with (copy / "cameras.csv").open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([head, *rows])
    (copy / "gcp_list.txt").write_text(marks(place, survey, level_m, rng), encoding="utf-8")
    return copy


def marks(place: Path, survey, level_m: float, rng: np.random.Generator) -> str:
    """gcp_list.txt of points of the bed, all under water, far from each other; the first pixel's centre is at 0, 0."""
    seen = survey.frame.local_from_crs(read_reference(place / "truth" / "visible.ply").points)
    seen = seen[survey.water.depth(seen) > 0.15]
    chosen = [int(rng.integers(len(seen)))]
    while len(chosen) < NUM_CONTROL:
        chosen.append(int(np.argmax(np.min([np.hypot(*(seen - seen[k])[:, :2].T) for k in chosen], axis=0))))
    points = seen[chosen]
    known = survey.frame.crs_from_local(points + CONTROL_STD_M * rng.standard_normal(points.shape))
    lines = ["EPSG:25832"]
    for view in survey.views:
        at = view.camera.project(points, survey.water)
        at = at + MARK_STD_PX * rng.standard_normal(at.shape)
        for k in np.flatnonzero(view.camera.sees(at)):
            lines.append("{:.4f} {:.4f} {:.4f} {:.2f} {:.2f}".format(*known[k], *(at[k] - 0.5)) + f" {view.name} g{k}")
    return "\n".join([*lines, ""])


def differences(cloud: Path, dry: Dem, level: float, bounds: tuple[float, float, float, float]) -> dict:
    """Figures [m] of a cloud over the terrain model of the dry survey, where that lies under a level in crs."""
    height = RegularGridInterpolator((dry.north[::-1], dry.east), dry.height[::-1], bounds_error=False)
    points, (e0, n0, e1, n1) = read_cloud(cloud).points, bounds
    points = points[((points[:, :2] > (e0, n0)) & (points[:, :2] < (e1, n1))).all(axis=1)]
    true = height(points[:, 1::-1])
    wet = np.isfinite(true) & (true < level - SHALLOWEST_M)
    numbers = distance_statistics(points[wet, 2] - true[wet])
    return {"points": numbers.n_points, "median_m": numbers.median_m, "std_m": numbers.std_inner90_m}


def measured(folder: Path, level_m: float, dry: Dem) -> dict:
    """A record of a tide: its depth, and the figures of each treatment."""
    place, level = drawn(folder, level_m), ORIGIN[2] + level_m
    survey, runs = load_survey(place), folder / "runs" / f"{level_m:+.1f}"
    straight = variant(case_of(place), folder / f"{place.name}_straight", poses="given", is_refracted=False)
    surveys = {
        "bent": (place, "fixed"),
        "straight": (straight, "fixed"),
        "control": (with_control(place, level_m, bends=True), "refine"),
        "straight_control": (with_control(place, level_m, bends=False), "refine"),
    }
    for name, (survey_folder, poses) in surveys.items():
        process(survey_folder, runs / name, poses=poses)
    clouds = {name: runs / name / "cloud.las" for name in surveys}
    for name in ("times_index", "per_camera"):
        clouds[name] = runs / f"{name}.las"
        write_corrected(clouds[name], runs / "straight", place, name)
    true = dry.height[np.isfinite(dry.height) & (dry.height < level - SHALLOWEST_M)]
    record = {"level_m": level_m, "depth_m": level - float(np.median(true))}
    return record | {name: differences(clouds[name], dry, level, survey.bounds) for name in TREATMENTS}


def table(records: list[dict]) -> list[str]:
    """Markdown: a row for each tide."""
    lines = [f"| depth | {' | '.join(TREATMENTS.values())} |", "|---" * (len(TREATMENTS) + 1) + "|"]
    for each in records:
        cells = [f"{1e3 * each[name]['median_m']:+.0f}, {1e3 * each[name]['std_m']:.0f}" for name in TREATMENTS]
        lines.append(f"| {each['depth_m']:.2f} m | {' | '.join(cells)} |")
    return lines


def draw(path: Path, records: list[dict]) -> None:
    """Median of each treatment over depth, with the std of its inner 90 % to both sides."""
    figure, axes = canvas(7.0, 4.2)
    depth = np.array([each["depth_m"] for each in records])
    for name, words in TREATMENTS.items():
        median, std = (1e3 * np.array([each[name][key] for each in records]) for key in ("median_m", "std_m"))
        (line,) = axes.plot(depth, median, marker="o", markersize=3, label=words)
        axes.fill_between(depth, median - std, median + std, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set_yscale("symlog", linthresh=10.0)
    axes.set_ylim(-3000.0, 2000.0)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set_xlabel("median depth of the wet reef [m]")
    axes.set_ylabel("height over the dry survey [mm]")
    write_title(axes, "One reef at five tides, against its low tide")
    axes.legend(fontsize=8, loc="lower left", ncol=2)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--levels", type=float, nargs="+", default=LEVELS)
    parser.add_argument("--publish", action="store_true")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path, records = options.output / "tides.json", []
    if path.is_file():
        records = json.loads(path.read_text(encoding="utf-8"))
    with Progress(verbosity=-1):
        dry_run = options.output / "runs" / "dry"
        process(drawn(options.output, None), dry_run, poses="fixed")
        dry = Run.open(dry_run).dem(CELL_M)
        for level_m in options.levels:
            if not any(each["level_m"] == level_m for each in records):
                records.append(measured(options.output, level_m, dry))
                path.write_text(json.dumps(records, indent=1), encoding="utf-8")
    records.sort(key=lambda each: each["level_m"])
    print("\n".join(table(records)))  # noqa: T201
    draw(options.output / "tides.png", records)
    if options.publish:
        publish(DOCS / "prove-it.md", "tides", table(records))
        draw(DOCS / "img" / "tides.png", records)


if __name__ == "__main__":
    main()
