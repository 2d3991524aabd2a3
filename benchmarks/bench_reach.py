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

import argparse
import json
import math
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench_methods import machine, run_bathynerf
from pyproj import CRS

from evaluation import distance_to_mesh
from geo import read_cloud, read_reference
from geo.raster import RasterBand, RasterForm, write_cog
from refract import FlatWater
from survey.folder.survey import Survey, load_survey
from survey.plan.choices import Choices
from survey.plan.tiling import ground_of, plan_run, ray_skew_px
from survey.simulate.simulate import simulate
from survey.water.surface import Departure

ORIGIN, CRS_NAME = (676120.0, 5311480.0, 584.0), "EPSG:25832+7837"
_SCENE = """
name = "{name}"
crs = "{crs}"
origin = {origin}
seed = {seed}
[area]
size_m = {size_m}
[bed]
depth_m = {depth_m}
[texture]
texel_m = 0.025
[water]
slope_east = {slope}
{waves}
[camera]
size_px = {size_px}
focal_px = {focal_px}
[flight]
height_m = {height_m}
patterns = ["nadir"]
forward_overlap = 0.75
side_overlap = 0.6
[sensor]
exposure = 1.7
[render]
mode = "direct"
"""
# Both surfaces are sums of sinusoids, which repeat far from the photographs: length [m], smoothing [m].
PERIOD, RIFFLE_WIDTH, SLOPE_WIDTH = 100.0, 3.0, 2.0
# The file of [water] by the name of a case.
CASES = {"plane": 'gnss_points = "water.csv"', "points": 'surface = "water.csv"', "raster": 'surface = "water.tif"'}


@dataclass(frozen=True)
class Reach:
    """A reach whose water falls by ``slope`` along east, and stands in waves of amplitude [m], length [m], phase."""

    name: str
    size_m: tuple[float, float]
    depth_m: float
    size_px: tuple[int, int]
    focal_px: float
    height_m: float
    slope: float
    waves: Sequence[tuple[float, float, float]]
    seed: int = 3

    def level(self, east: np.ndarray) -> np.ndarray:
        """Height of the water [m] over the origin at places so far east of it."""
        waves = sum(a * np.sin(2.0 * math.pi / length * east + phase) for a, length, phase in self.waves)
        return self.slope * east + waves

    def draw(self, folder: Path) -> Path:
        """Its survey in a folder, drawn where it is not there yet."""
        survey, scene = folder / self.name, folder / f"{self.name}.toml"
        if not survey.exists():
            waves = [
                f"[[water.waves]]\namplitude_m = {a}\nlength_m = {length}\ntoward_deg = 90.0\n"
                f"phase_deg = {math.degrees(phase)}\n"
                for a, length, phase in self.waves
            ]
            given = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}
            scene.write_text(_SCENE.format(**given | {"waves": "".join(waves)}, crs=CRS_NAME, origin=list(ORIGIN)))
            simulate(scene, survey, preview=True)
        return survey

    def write_points(self, path: Path, places: np.ndarray, std_m: float, noise_m: np.ndarray | float = 0.0) -> None:
        """Points of the water at places (N, 2) [m] from the origin, as a table."""
        rows = np.column_stack([places, self.level(places[:, 0]) + noise_m]) + ORIGIN
        text = "".join(f"{e:.3f},{n:.3f},{h:.4f},{std_m}\n" for e, n, h in rows.tolist())
        path.write_text("easting,northing,height,std\n" + text)


def with_measured_water(survey: Path, line: str) -> None:
    """Put a line into [water] in place of the level."""
    settings = re.sub(r"(level_m|level_at|slope_east|slope_north) = .*\n", "", (survey / "survey.toml").read_text())
    (survey / "survey.toml").write_text(settings.replace("[water]\n", f"[water]\n{line}\n"))


@dataclass(frozen=True)
class Errors:
    """Of the N points of a cloud within the bounds: signed distance, place [m], local, std and std_common [m]."""

    off: np.ndarray
    xyz: np.ndarray
    std: np.ndarray
    std_common: np.ndarray


def errors_of(survey: Path, cloud: Path) -> Errors:
    """Errors of a cloud against the truth of its survey."""
    loaded, found = load_survey(survey), read_cloud(cloud)
    assert loaded.bounds is not None
    low, high = loaded.bounds[:2], loaded.bounds[2:]
    inside = ((found.points[:, :2] >= low) & (found.points[:, :2] <= high)).all(axis=1)
    xyz = loaded.frame.local_from_crs(found.points[inside])
    mesh = read_reference(survey / "truth" / "reference.ply")
    off = distance_to_mesh(xyz, loaded.frame.local_from_crs(mesh.vertices), mesh.faces).signed
    return Errors(off, xyz, found.extra["std"][inside], found.extra["std_common"][inside])


def reach_of(name: str) -> Reach:
    """The reach of that name."""

    def damped(order: int, width: float) -> float:
        return math.exp(-0.5 * (2.0 * math.pi * order / PERIOD * width) ** 2)

    if name == "riffle":  # a square wave of 0.1 m
        slope = 0.0
        waves = [(0.4 / math.pi / k * damped(k, RIFFLE_WIDTH), PERIOD / k, math.pi) for k in (1, 3, 5, 7)]
    else:  # a triangle wave whose slopes are 0.45 % up and down
        slope = -0.0055
        waves = [
            (8.0 * 0.0045 * PERIOD / 4.0 / (math.pi * k) ** 2 * damped(k, SLOPE_WIDTH), PERIOD / k, 0.5 * math.pi)
            for k in (1, 3, 5)
        ]
    return Reach(name, (30.0, 8.0), 1.5, (512, 384), 900.0, 22.0, slope, waves)


def with_water(survey: Path, copy: Path, reach: Reach, case: str) -> None:
    """A copy of a survey with measurements of its water in place of its level."""
    shutil.copytree(survey, copy, copy_function=shutil.copyfile)
    with_measured_water(copy, CASES[case])
    rng = np.random.default_rng(7)
    places = rng.uniform((-20.0, -7.0), (20.0, 7.0), (80, 2))
    reach.write_points(copy / "water.csv", places, 0.02, 0.02 * rng.standard_normal(80))
    cells = np.broadcast_to(ORIGIN[2] + reach.level(np.arange(-22.5, 23.0)), (20, 46))
    transform = (1.0, 0.0, ORIGIN[0] - 23.0, 0.0, -1.0, ORIGIN[1] + 10.0)
    form = RasterForm(CRS(CRS_NAME), transform, (20, 46), (RasterBand("water", "metre"),), dtype="float64")
    write_cog(copy / "water.tif", form, [(0, 0, cells[None])])


def figures(found: Errors) -> dict:
    """Figures of a cloud."""
    off, along = found.off, found.xyz[:, 0]
    inner = off[np.abs(off) <= np.quantile(np.abs(off), 0.9)]
    medians = [float(np.median(off[np.abs(along - at) < 1.5])) for at in np.arange(-13.5, 15.0, 3.0)]
    return {
        "points": len(off),
        "mean_mm": 1e3 * float(inner.mean()),
        "std_mm": 1e3 * float(inner.std()),
        "span_of_medians_mm": 1e3 * (max(medians) - min(medians)),
        "within_std": float((np.abs(off) < 1.96 * found.std).mean()),
        "within_all": float((np.abs(off) < 1.96 * np.hypot(found.std, found.std_common)).mean()),
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
    plan, _, _ = plan_run(river, chosen)
    (tiles,) = (each for each in plan.decisions if each.name == "tiles")
    return {
        "photographs": len(views), "off_one_plane_m": float(np.abs(over).max()),
        "miss_px": next(ray_skew_px(river, plan, ground_of(river, plan), [None]))[1],
        "tiles": tiles.choice, "reason": tiles.reason,
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
            riffle = reach_of("riffle")
            with_water(riffle.draw(asked.folder), Path(work) / "raster", riffle, "raster")
            print(json.dumps(kilometre(load_survey(Path(work) / "raster")), indent=2))  # noqa: T201
        return
    rows = []
    for name in asked.reaches.split(","):
        reach = reach_of(name)
        survey = reach.draw(asked.folder)
        cases = [("plane", "1"), ("points", "1"), *(("raster", tiles) for tiles in asked.tiles.split(","))]
        for case, tiles in cases:
            with tempfile.TemporaryDirectory() as work:
                copy = Path(work) / case
                with_water(survey, copy, reach, case)
                given = ["process", str(copy), "--quality", asked.quality, "--tiles", tiles, "-q"]
                code, cost, words = run_bathynerf(given, Path(tempfile.mkdtemp(dir=work)))
                if code != 0:
                    raise SystemExit(f"process ended with {code}: {words}")
                found = figures(errors_of(copy, copy / "bathynerf" / "cloud.las"))
            case_of = {"reach": name, "water": case, "tiles": int(tiles), "processor_s": cost.processor_s}
            rows.append(case_of | found)
            print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    if asked.output is not None:
        found = {"quality": asked.quality, "machine": machine(), "runs": rows}
        asked.output.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
