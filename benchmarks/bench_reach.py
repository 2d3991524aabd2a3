"""What does a river's uneven water cost, taken for one plane or by its measured surface?

    python benchmarks/bench_reach.py FOLDER [--reaches riffle,slope] [--quality draft] [--tiles 1,4] [-o FILE.json]
    python benchmarks/bench_reach.py FOLDER --kilometre

Draws, in FOLDER/<reach>, 42 photographs of 30 x 8 m of bed under water that is no plane, and keeps them: ``riffle``,
over which the water falls by 20 cm within 10 m, and ``slope``, which changes from 0.1 to 1 % in the middle. Processes
each with three files of the water: 80 GNSS points of 2 cm as one plane (gnss_points), the same as surface, and a raster
of 1 m as surface, this in tiles, too. Prints and writes mean and std of the inner 90 % of the vertical errors against
the truth within the bounds, the span of their medians over pieces of 3 m along the river, the shares of the points
within 1.96 of std and of std with std_common, and the processor time. With ``--kilometre`` it prints instead by how
much rays of a point are skew over a kilometre of river (0.1 to 1 %, a riffle every 125 m), and the tiles of the plan.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
from pyproj import CRS

from evaluation import distance_to_mesh
from geo import read_reference
from geo.raster_writing import Band, RasterForm, write_cog
from refract import FlatWater
from survey.benchmark.running import machine, run_bathynerf
from survey.folder.survey import Survey, load_survey
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.tile_choice import choose_tiles
from survey.plan.tiling import ground_of
from survey.plan.water_tiles import aside_px
from survey.plan.workload import workload_of
from survey.simulate.staging.simulate import simulate
from survey.water.surface import Departure

ORIGIN, CRS_NAME = (676120.0, 5311480.0, 584.0), "EPSG:25832+7837"
# Both surfaces are sums of sinusoids, which repeat far from the photographs: length [m], smoothing [m].
PERIOD, RIFFLE_WIDTH, SLOPE_WIDTH = 100.0, 3.0, 2.0
SCENE = """
name = "{name}"
crs = "{crs}"
origin = {origin}
seed = 3
[area]
size_m = [30.0, 8.0]
[bed]
depth_m = 1.5
[texture]
texel_m = 0.025
[water]
slope_east = {slope}
{waves}
[camera]
size_px = [512, 384]
focal_px = 900.0
[flight]
height_m = 22.0
patterns = ["nadir"]
forward_overlap = 0.75
side_overlap = 0.6
[sensor]
exposure = 1.7
[render]
mode = "direct"
"""
# The file of [water] by the name of a case.
CASES = {"plane": 'gnss_points = "water.csv"', "points": 'surface = "water.csv"', "raster": 'surface = "water.tif"'}


def sinusoids(reach: str) -> tuple[float, list[tuple[float, float, float]]]:
    """Mean slope, and amplitude [m], length [m] and phase [rad] of each sinusoid along east."""

    def damped(order: int, width: float) -> float:
        return math.exp(-0.5 * (2.0 * math.pi * order / PERIOD * width) ** 2)

    if reach == "riffle":  # a square wave of 0.1 m
        return 0.0, [(0.4 / math.pi / k * damped(k, RIFFLE_WIDTH), PERIOD / k, math.pi) for k in (1, 3, 5, 7)]
    # A triangle wave whose slopes are 0.45 % up and down.
    return -0.0055, [
        (8.0 * 0.0045 * PERIOD / 4.0 / (math.pi * k) ** 2 * damped(k, SLOPE_WIDTH), PERIOD / k, 0.5 * math.pi)
        for k in (1, 3, 5)
    ]


def level(reach: str, east: np.ndarray) -> np.ndarray:
    """Height of the water [m] over the origin at places so far east of it."""
    slope, waves = sinusoids(reach)
    return slope * east + sum(a * np.sin(2.0 * math.pi / length * east + phase) for a, length, phase in waves)


def draw(folder: Path, reach: str) -> Path:
    """The survey of a reach, drawn where it is not there yet."""
    survey, scene = folder / reach, folder / f"{reach}.toml"
    if not survey.exists():
        slope, waves = sinusoids(reach)
        lines = [
            f"[[water.waves]]\namplitude_m = {a}\nlength_m = {length}\ntoward_deg = 90.0\n"
            f"phase_deg = {math.degrees(phase)}\n"
            for a, length, phase in waves
        ]
        scene.write_text(SCENE.format(name=reach, crs=CRS_NAME, origin=list(ORIGIN), slope=slope, waves="".join(lines)))
        simulate(scene, survey, preview=True)
    return survey


def with_water(survey: Path, copy: Path, reach: str, case: str) -> None:
    """A copy of a survey with measurements of its water in place of its level."""
    shutil.copytree(survey, copy, copy_function=shutil.copyfile)
    settings = re.sub(r"(level_m|level_at|slope_east|slope_north) = .*\n", "", (copy / "survey.toml").read_text())
    (copy / "survey.toml").write_text(settings.replace("[water]\n", f"[water]\n{CASES[case]}\n"))
    rng = np.random.default_rng(7)
    places = rng.uniform((-20.0, -7.0), (20.0, 7.0), (80, 2))
    heights = level(reach, places[:, 0]) + 0.02 * rng.standard_normal(80)
    rows = (np.column_stack([places, heights]) + ORIGIN).tolist()
    (copy / "water.csv").write_text(
        "easting,northing,height,std\n" + "".join(f"{e:.3f},{n:.3f},{h:.4f},0.02\n" for e, n, h in rows)
    )
    cells = np.broadcast_to(ORIGIN[2] + level(reach, np.arange(-22.5, 23.0)), (20, 46))
    transform = (1.0, 0.0, ORIGIN[0] - 23.0, 0.0, -1.0, ORIGIN[1] + 10.0)
    form = RasterForm(CRS(CRS_NAME), transform, (20, 46), (Band("water", "metre"),), dtype="float64")
    write_cog(copy / "water.tif", form, [(0, 0, cells[None])])


def errors(survey: Path, cloud: Path) -> dict:
    """Figures of a cloud."""
    frame, bounds = load_survey(survey).frame, load_survey(survey).bounds
    assert bounds is not None
    las = laspy.read(cloud)
    points = np.column_stack([las.x, las.y, las.z])
    inside = ((points[:, :2] >= bounds[:2]) & (points[:, :2] <= bounds[2:])).all(axis=1)
    xyz, std = frame.local_from_crs(points[inside]), np.asarray(las["std"])[inside]
    mesh = read_reference(survey / "truth/reference.ply")
    off = distance_to_mesh(xyz, frame.local_from_crs(mesh.vertices), mesh.faces).signed
    inner = off[np.abs(off) <= np.quantile(np.abs(off), 0.9)]
    medians = [float(np.median(off[np.abs(xyz[:, 0] - at) < 1.5])) for at in np.arange(-13.5, 15.0, 3.0)]
    return {
        "points": int(inside.sum()),
        "mean_mm": 1e3 * float(inner.mean()),
        "std_mm": 1e3 * float(inner.std()),
        "span_of_medians_mm": 1e3 * (max(medians) - min(medians)),
        "within_std": float((np.abs(off) < 1.96 * std).mean()),
        "within_all": float((np.abs(off) < 1.96 * np.hypot(std, np.asarray(las["std_common"])[inside])).mean()),
    }


def kilometre(survey: Survey) -> dict:
    """What the plan says of a kilometre of river under the camera of a survey."""
    x, y = np.meshgrid(np.arange(-520.0, 521.0), np.arange(-15.0, 16.0))

    def height(east):
        steps = sum(np.tanh((east - at) / RIFFLE_WIDTH) for at in range(-500, 501, 125))
        return -0.0055 * east - 0.0045 * 50.0 * np.log(np.cosh(east / 50.0)) - 0.1 * steps

    slope, mean = np.polyfit(x[0], height(x[0]), 1).tolist()
    plane = FlatWater((0.0, 0.0, mean), n_water=1.333, slope_x=slope)
    over = height(x) - plane.height(x, y)
    departure = Departure(np.column_stack([x.ravel(), y.ravel(), over.ravel()]), np.full(x.size, 0.002))
    first = survey.views[0]
    views = tuple(
        replace(
            first,
            name=f"{east:.1f}_{north}.jpg",
            camera=replace(first.camera, centre=np.array([east, north, 22.0 + float(height(east))])),
        )
        for east in np.arange(-500.0, 501.0, 3.4)
        for north in (-5.0, 0.0, 5.0)
    )
    config = replace(survey.config, area=replace(survey.config.area, bounds=None))
    observations = replace(survey.observations, departure=departure)
    river = replace(survey, views=views, water=plane, config=config, observations=observations)
    chosen = Choices(quality="draft", memory="64GB")
    plan = make_plan(river, chosen)
    tiles = choose_tiles(river, plan, chosen, workload_of(river, plan), is_aimed=False)
    return {
        "photographs": len(views), "off_one_plane_m": float(np.abs(over).max()),
        "miss_px": next(aside_px(river, plan, ground_of(river, plan), [None]))[1],
        "tiles": tiles.decision.choice, "reason": tiles.decision.reason,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--reaches", default="riffle,slope")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--tiles", default="1,4")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--kilometre", action="store_true")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    if asked.kilometre:
        with tempfile.TemporaryDirectory() as work:
            with_water(draw(asked.folder, "riffle"), Path(work) / "raster", "riffle", "raster")
            print(json.dumps(kilometre(load_survey(Path(work) / "raster")), indent=2))  # noqa: T201
        return
    rows = []
    for reach in asked.reaches.split(","):
        survey = draw(asked.folder, reach)
        cases = [("plane", "1"), ("points", "1"), *(("raster", tiles) for tiles in asked.tiles.split(","))]
        for case, tiles in cases:
            with tempfile.TemporaryDirectory() as work:
                copy = Path(work) / case
                with_water(survey, copy, reach, case)
                given = ["process", str(copy), "--quality", asked.quality, "--tiles", tiles, "-q"]
                code, cost, words = run_bathynerf(given, Path(tempfile.mkdtemp(dir=work)))
                if code != 0:
                    raise SystemExit(f"process ended with {code}: {words}")
                found = errors(copy, copy / "bathynerf" / "cloud.las")
            case_of = {"reach": reach, "water": case, "tiles": int(tiles), "processor_s": cost.processor_s}
            rows.append(case_of | found)
            print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    if asked.output is not None:
        found = {"quality": asked.quality, "machine": machine(), "runs": rows}
        asked.output.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
