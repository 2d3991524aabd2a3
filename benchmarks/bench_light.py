"""What glint, moving caustics and dispersion cost: random drawn surveys with more and more of them.

    python benchmarks/bench_light.py FOLDER [--rows ROW ...] [--seeds 1-3] [--run NAME] [--quality Q]

Each survey is drawn from its seed once, without and with light that moves; each is processed by the command line into
a folder called NAME, which is used again. Prints rows of Markdown for docs/notes/light.md, means over the seeds: mean
and std of the inner 90 % of distances, points found at 0.2 and 0.05 m, and the share of vertical errors within 1.96
std.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from survey.benchmark.benchmark import run_bathynerf
from survey.benchmark.cases import case_of
from survey.benchmark.records import errors_of
from survey.simulate.drawn import DrawnScene, draw_survey

ROWS: dict[str, dict[str, float]] = {
    "nothing": {},
    "glint 2 %": {"glint_share": 0.02},
    "glint 10 %": {"glint_share": 0.1},
    "glint 30 %": {"glint_share": 0.3},
    "caustics 10 %": {"caustic_contrast": 0.1},
    "caustics 30 %": {"caustic_contrast": 0.3},
    "caustics 60 %": {"caustic_contrast": 0.6},
    "glint 10 %, caustics 30 %": {"glint_share": 0.1, "caustic_contrast": 0.3},
}


@dataclass(frozen=True)
class Row:
    """What is measured of one survey: lengths in mm, shares in percent."""

    mean: float
    std: float
    at_02: float
    at_005: float
    covered: float


def scene_of(seed: int, changes: dict[str, float]) -> DrawnScene:
    """A random survey of some 16 photographs."""
    rng = np.random.default_rng([seed, 77])
    depth, flying = rng.uniform(1.0, 4.0), rng.uniform(14.0, 20.0)
    scene = DrawnScene(
        seed=seed,
        depth_m=round(depth, 2),
        flying_m=round(flying, 1),
        num_views=int(rng.integers(12, 21)),
        nadir_share=round(rng.uniform(0.4, 0.8), 2),
        noise=round(rng.uniform(1.0, 4.0), 1),
        size_m=(0.4 * flying, 0.36 * flying),
        image_px=(400, 300),
        focal_px=700.0,
    )
    return replace(scene, **changes)


def measure(folder: Path, seed: int, row: str, name: str, quality: str) -> Row:
    """Draw, process and compare one survey."""
    place = folder / f"{seed:02d}_{row.replace(' ', '').replace('%', '').replace(',', '_')}"
    draw_survey(place, scene_of(seed, ROWS[row]))
    return figures(place, place / name, folder, quality)


def figures(place: Path, run: Path, folder: Path, quality: str) -> Row:
    """Those of a survey in its run, which is made if it is not there; compiled kernels are kept in ``folder``."""
    home = folder / "home"
    home.mkdir(exist_ok=True)
    if not (run / "cloud.las").is_file():
        code, _, words = run_bathynerf(["process", str(place), "-o", str(run), "--quality", quality], home)
        if not (run / "cloud.las").is_file():
            raise SystemExit(f"{place}: exit code {code}, {words}")
    found = errors_of(run / "cloud.las", case_of(place))
    covered = np.nan if found.coverage is None else 100.0 * found.coverage
    shares = (100.0 * found.completeness[tolerance] for tolerance in ("0.2", "0.05"))
    return Row(1e3 * found.mean_m, 1e3 * found.std_m, *shares, covered)


def text(name: str, rows: list[Row]) -> str:
    """A row of the table: means over the surveys, their mean errors as the root mean square."""
    values = np.array([[r.mean, r.std, r.at_02, r.at_005, r.covered] for r in rows])
    mean, (_, std, at_02, at_005, covered) = np.sqrt(np.mean(values[:, 0] ** 2)), values.mean(axis=0)
    return f"| {name} | {mean:.1f} mm | {std:.1f} mm | {at_02:.2f} % | {at_005:.2f} % | {covered:.1f} % |"


def seeds_of(words: str) -> list[int]:
    """Seeds from first to last, as `1-3`."""
    first, _, last = words.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    """Print the rows, and those of single surveys as they are finished."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS), metavar="ROW")
    parser.add_argument("--seeds", type=seeds_of, default=seeds_of("1-3"))
    parser.add_argument("--run", default="run")
    parser.add_argument("--quality", default="standard")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for row in given.rows:
        found = []
        for seed in given.seeds:
            found.append(measure(given.folder, seed, row, given.run, given.quality))
            print(text(f"{row}, seed {seed}", found[-1:]), flush=True)  # noqa: T201
        print(text(row, found), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
