"""How accurate, how complete, and is the std true, on surveys that nothing was tuned on?

    python benchmarks/bench_random.py [--seeds 100-111] -o FOLDER [--quality draft standard]

Each seed is a `RandomSurvey`: drawn, processed by the command line in each quality, compared with its true
bed, and removed. Of a survey with waves the median error is taken off before coverage is counted. Prints rows of
Markdown; FOLDER/random.json has the rows, and what it has is not run again. A survey takes about a minute of one core.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import laspy
import numpy as np
from bench_methods import run_bathynerf
from method_cases import case_of
from method_records import Errors, errors_of
from std_coverage import WALL_DEG, coverage_by_class, slope_below
from stress_factors import blur, compressed, contrast, exposure, images, noise, with_waves

from evaluation import vertical_difference
from geo import read_reference
from geo.las_header import extra_of
from survey.simulate.conditions import Light
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground import Ground, Material, shade_of_map
from survey.simulate.shapes import BedGrid
from survey.simulate.sidecars import StagedScene
from survey.simulate.textures import light_of_bed
from survey.simulate.textures import noise as smooth_noise
from survey.simulate.writing import write_survey

SIZES_PX = ((320, 240), (400, 300), (480, 360))
# Vertices of the bed to a ground sampling distance, so that it goes on below the pixel.
FINE = 3.0
# Relief of a drawn bed is this share of its spacing and ends at 5 cm; what is added begins here [m] and goes on below.
_SHARE, _ADDED_M = 0.05, 0.1
# What is done to photographs: the lowest and the highest value, and whether a factor between them is drawn.
CHANGES: dict[str, tuple[Callable[[Path, float], None], float, float]] = {
    "noise": (images(noise), 3.0, 12.0),
    "blur": (images(blur), 0.6, 2.2),
    "JPEG": (compressed, 20.0, 80.0),
    "contrast": (images(contrast), 0.1, 0.5),
    "exposure": (images(exposure), 0.1, 0.4),
}
# A class of fewer points says nothing.
LEAST = 100
HEAD = (
    "| seed | quality | mean | std | rms | at 0.2 m | at 0.05 m | std covers | fifths | 2 views | 3 to 4 | 5 to 7 "
    "| 8 and more | slopes | wet | dry | least std |"
)


@dataclass(frozen=True)
class RandomSurvey:
    """What a seed stands for.

    Attributes
    ----------
    scene : DrawnScene
    relief : [-]
        What is added below 10 cm, as a multiple of what larger relief leads to expect.
    waves_m : [m]
        Amplitude; 0 for still water.
    change : str or None
        One of `CHANGES`.
    value : float
        Of the change.
    """

    scene: DrawnScene
    relief: float
    waves_m: float
    change: str | None
    value: float

    @classmethod
    def of(cls, seed: int) -> RandomSurvey:
        """The survey of a seed."""
        rng = np.random.default_rng([seed, 778])
        depth = _between(rng, 0.5, 6.0)
        flying = max(float(rng.uniform(8.0, 25.0)), 2.2 * depth)
        size_px = SIZES_PX[rng.integers(len(SIZES_PX))]
        focal = float(size_px[0] * rng.uniform(1.2, 2.0))
        gsd, views = flying / focal, int(rng.integers(7, 23))
        side = float(np.clip(0.33 * size_px[0] * gsd * math.sqrt(views), 3.0, 14.0))
        scene = DrawnScene(
            size_m=(side, 0.9 * side),
            depth_m=depth,
            n_water=float(rng.uniform(1.32, 1.35)),
            level_m=float(rng.uniform(-5.0, 500.0)),
            num_views=views,
            nadir_share=float(rng.choice([0.3, 0.6, 1.0])),
            image_px=size_px,
            focal_px=focal,
            flying_m=flying,
            noise=_between(rng, 0.5, 4.0),
            seed=seed,
            cell_m=min(gsd / FINE, 0.025),
            texel_m=min(0.4 * gsd, 0.01),
            shore=bool(rng.random() < 0.35),
            objects=bool(rng.random() < 0.7),
        )
        waves = _between(rng, 0.001, 0.01) if rng.random() < 0.3 else 0.0
        change = [None, *CHANGES][rng.integers(1 + len(CHANGES))]
        value = 0.0 if change is None else _between(rng, *CHANGES[change][1:])
        return cls(scene, _between(rng, 0.25, 3.0), waves, change, value)

    def __str__(self) -> str:
        scene = self.scene
        words = [
            f"{scene.depth_m:.1f} m",
            f"{scene.num_views} views, {round(100 * scene.nadir_share)} % down",
            f"{1e3 * scene.flying_m / scene.focal_px:.0f} mm a pixel",
            f"relief x {self.relief:.2g}",
            f"noise {scene.noise:.1f}",
            *(["shore"] if scene.shore else []),
            *(["boat, rocks"] if scene.objects else []),
            *([f"waves of {1e3 * self.waves_m:.0f} mm"] if self.waves_m else []),
            *([f"then {self.change} {self.value:.2g}"] if self.change else []),
        ]
        return ", ".join(words)

    def draw(self, folder: Path) -> None:
        """Write the survey, with its truth, into a folder; what was there goes."""
        shutil.rmtree(folder, ignore_errors=True)
        write_survey(folder, asdict(self.scene), self._staged)
        if self.change is not None:
            CHANGES[self.change][0](folder, self.value)

    def _staged(self) -> StagedScene:
        staged = _rougher(stage_drawing(self.scene), self.relief)
        return with_waves(staged, self.waves_m) if self.waves_m else staged


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """As likely in each factor of two."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _rougher(scene: StagedScene, relief: float) -> StagedScene:
    """The same bed with more relief below 10 cm, down to its cells."""
    ground = scene.renderer.ground
    bed, rng = ground.bed, np.random.default_rng([scene.seed, 34])
    assert isinstance(bed, BedGrid)
    heights, spacing = bed.heights.copy(), _ADDED_M
    while spacing >= bed.cell:
        heights += relief * _SHARE * spacing * smooth_noise(rng, heights.shape, spacing / bed.cell)
        spacing *= 0.5
    rough = BedGrid(heights, bed.west, bed.south, bed.cell)
    material = Material(ground.materials[0].texture, shade_of_map(rough, light_of_bed(rough, ground.solids, Light())))
    ground = Ground(rough, ground.solids, (material, *ground.materials[1:]))
    return replace(scene, renderer=replace(scene.renderer, ground=ground))


def coverage_cells(run: Path, reference: Path, level_is_open: bool) -> list[str]:
    """Shares [%] of vertical errors within 1.96 std where the reference is flatter than 60 degrees, and the least std.

    In all, in fifths from the smallest to the largest std, by the number of views, on slopes, wet and dry. With
    ``level_is_open`` the median error is taken off first.
    """
    las, mesh = laspy.read(run / "cloud.las"), read_reference(reference)
    extra, middle = extra_of(las), mesh.vertices.mean(axis=0)
    points = np.stack([las.x, las.y, las.z], axis=-1)
    e0, n0, e1, n1 = tomllib.loads((run / "settings.toml").read_text(encoding="utf-8"))["area"]["bounds"]
    inside = (points[:, 0] >= e0) & (points[:, 0] <= e1) & (points[:, 1] >= n0) & (points[:, 1] <= n1)
    points, vertices = points[inside] - middle, mesh.vertices - middle
    error = vertical_difference(points, vertices, mesh.faces)
    slope = slope_below(points, vertices, mesh.faces)
    std, views = (np.asarray(extra[name])[inside] for name in ("std", "num_views"))
    wet = np.asarray(las.classification)[inside] == 40
    known = np.isfinite(error) & (slope < WALL_DEG) & np.isfinite(std)
    error = error[known]
    if level_is_open:
        error = error - np.median(error)
    coverage = coverage_by_class(error, std[known], views[known], slope[known], wet[known])
    shares = [
        f"{100 * part.share:.{int(name == 'all')}f}" if part.num >= LEAST else "" for name, part in coverage.items()
    ]
    return [shares[0], " ".join(shares[1:6]), *shares[6:], f"{1e3 * np.nanmin(std):.2g} mm"]


def rows_of(seed: int, qualities: list[str], folder: Path) -> dict[str, list[str]]:
    """Cells of a table by quality; the survey and its runs are removed."""
    random, survey, home = RandomSurvey.of(seed), folder / f"survey_{seed}", folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    random.draw(survey)
    case, rows = case_of(survey), {}
    for quality in qualities:
        run = survey / quality
        code, _, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", quality], home)
        if not (run / "cloud.las").is_file():
            rows[quality] = [f"exit code {code}: {words}"]
            continue
        covers = coverage_cells(run, case.reference, random.waves_m > 0.0)
        rows[quality] = [*_accuracy(errors_of(run / "cloud.las", case)), *covers]
    shutil.rmtree(survey)
    return rows


def _accuracy(errors: Errors) -> list[str]:
    lengths = [f"{1e3 * value:.1f} mm" for value in (errors.mean_m, errors.std_m, errors.rms_m)]
    return [*lengths, *(f"{100.0 * errors.completeness[tolerance]:.2f} %" for tolerance in ("0.2", "0.05"))]


def lines_of(found: dict[str, dict[str, list[str]]]) -> list[str]:
    """The table, and below it what each survey is."""
    rows = [
        f"| {' | '.join([seed, quality, *cells])} |" for seed, each in found.items() for quality, cells in each.items()
    ]
    surveys = [f"- {seed}: {RandomSurvey.of(int(seed))}" for seed in found]
    return [HEAD, "|" + (HEAD.count("|") - 1) * "---|", *rows, "", *surveys]


def main() -> None:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="100-111", help="first and last")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--quality", nargs="+", default=["draft", "standard"])
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "random.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    first, last = (int(part) for part in options.seeds.split("-"))
    for seed in range(first, last + 1):
        left = [quality for quality in options.quality if quality not in found.get(str(seed), {})]
        if left:
            found[str(seed)] = found.get(str(seed), {}) | rows_of(seed, left, options.output)
            path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        for quality, cells in found[str(seed)].items():
            print(f"| {' | '.join([str(seed), quality, *cells])} |", flush=True)  # noqa: T201
    print("\n".join(lines_of(found)))  # noqa: T201


if __name__ == "__main__":
    main()
