"""Do views that a run renders, given back to the sweep beside the photographs, find more of the bed?

    python benchmarks/bench_fed_back.py WORK [--seeds 1-3] [--quality draft]

Of a drawn survey every second photograph is left out. The others are processed, the views left out are rendered from
that run (`bathynerf render`), and both are processed together; what a rendering does not show is left out by its
transparency. Beside it the survey with all its photographs. Prints rows of Markdown: mean and std of the inner 90 % of
distances, points found at 0.2 and 0.05 m, and the share of vertical errors within 1.96 std.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import sys
from pathlib import Path

from bench_light import Row, figures, scene_of, seeds_of, text

from survey.benchmark.benchmark import run_bathynerf
from survey.settings.config import read_config
from survey.simulate.drawn import draw_survey

ROWS = ("every second photograph", "and views rendered from them", "all photographs")


def table_of(folder: Path) -> tuple[Path, list[str], list[list[str]]]:
    """The table of poses of a survey, its head and its lines."""
    path = folder / str(read_config(folder / "survey.toml").cameras.poses)
    with path.open(encoding="utf-8", newline="") as stream:
        head, *lines = csv.reader(stream)
    return path, head, lines


def survey_of(folder: Path, drawn: Path, lines: list[list[str]], pictures: Path | None = None) -> Path:
    """A survey of some photographs of another, by links; of ``pictures``, if there are any, those that it lacks."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    shutil.copyfile(drawn / "survey.toml", folder / "survey.toml")
    (folder / "truth").symlink_to((drawn / "truth").resolve())
    path, head, every = table_of(drawn)
    if pictures is not None:
        lines = lines + [[Path(line[0]).with_suffix(".png").name, *line[1:]] for line in every if line not in lines]
    for name, *_ in lines:
        photograph = drawn / "images" / name
        source = photograph if pictures is None or photograph.exists() else pictures / name
        (folder / "images" / name).symlink_to(source.resolve())
    write(folder / path.name, head, lines)
    return folder


def write(path: Path, head: list[str], lines: list[list[str]]) -> None:
    """A table of poses."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([head, *lines])


def measure(work: Path, seed: int, quality: str) -> list[Row]:
    """The figures of one survey, of each of `ROWS`."""
    drawn = work / f"{seed:02d}_all"
    draw_survey(drawn, scene_of(seed, {}))
    _, head, lines = table_of(drawn)
    half = survey_of(work / f"{seed:02d}_half", drawn, lines[::2])
    found = [figures(half, half / "run", work, quality)]
    write(half / "left_out.csv", head, lines[1::2])
    pictures = work / f"{seed:02d}_rendered"
    arguments = ["render", str(half / "run"), "--cameras", str(half / "left_out.csv"), "-o", str(pictures)]
    code, _, words = run_bathynerf(arguments, work / "home")
    if code:
        raise SystemExit(f"{half}: exit code {code}, {words}")
    fed = survey_of(work / f"{seed:02d}_fed", drawn, lines[::2], pictures)
    return [*found, figures(fed, fed / "run", work, quality), figures(drawn, drawn / "run", work, quality)]


def main() -> None:
    """Print the rows, of each survey and of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=seeds_of, default=seeds_of("1-3"))
    parser.add_argument("--quality", default="draft")
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    found = []
    for seed in given.seeds:
        found.append(measure(given.work, seed, given.quality))
        for name, row in zip(ROWS, found[-1], strict=True):
            sys.stdout.write(text(f"{name}, seed {seed}", [row]) + "\n")
        sys.stdout.flush()
    for name, rows in zip(ROWS, zip(*found, strict=True), strict=True):
        sys.stdout.write(text(name, list(rows)) + "\n")


if __name__ == "__main__":
    main()
