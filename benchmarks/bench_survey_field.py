"""What does the field bring to a survey, and how well does it predict photographs that were held out?

    python benchmarks/bench_survey_field.py SURVEY -o WORK [--quality draft] [--rows sweep field held held_field]
        [--reference F --visible F] [--lpips F] [--dists F] [--steps] [--views N]

Rows: `sweep`, the cloud of `bathynerf process --field off`; `field`, the same with the field, whose run goes on from
that sweep; `held`, a survey without every eighth photograph, processed with the field, and what `bathynerf render`
makes of the cameras that were left out from the other photographs, over water pixels; `held_field`, the same from the
field; with --steps also over pixels within 5 px of a step of depth, away from steps, and of places that three
photographs see at most; with --views N, of N of them. One JSON for each row in WORK, and markers for commands that
have finished: the same command again does what is missing. SURVEY is only read. Reference and visible points default to
reference.ply and visible.ply of the survey; weights of LPIPS and DISTS are state dicts of torch.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import torch
from survey_field_measures import cloud_figures, summary, view_figures, with_steps

from survey.folder.survey import Survey, View, load_survey
from survey.run.folder import RunDir
from survey.run.stored import load_bed
from survey.settings.config import read_config

# The images number 4, 12, 20, ... of the table are left out.
EVERY, FIRST = 8, 4
HELD = ("held", "held_field")
# A quality gate that failed leaves all outputs behind.
FINISHED = (0, 3)
BATHYNERF = [sys.executable, "-c", "from survey.commands.app import main; main()"]


def once(marker: Path, arguments: list[str]) -> dict:
    """Run a command of bathynerf unless its marker shows it finished; returns the marker's seconds and load."""
    if not marker.exists():
        load, start = os.getloadavg()[0], time.monotonic()
        code = subprocess.run([*BATHYNERF, *arguments], check=False, stdout=subprocess.DEVNULL).returncode
        if code not in FINISHED:
            raise SystemExit(f"bathynerf {' '.join(arguments)} failed with exit code {code}; see its output above")
        record = {"wall_s": round(time.monotonic() - start, 1), "load_before": round(load, 1)}
        marker.write_text(json.dumps(record))
    return json.loads(marker.read_text())


def cloud_row(name: str, options: argparse.Namespace) -> dict:
    """The cloud with the field off or on, and how far it is from the truth."""
    run, cloud = options.output / "run", options.output / f"{name}.las"
    arguments = ["process", str(options.survey), "-o", str(run), "--quality", options.quality]
    record = once(
        options.output / f"{name}.process.json", [*arguments, "--field", "off" if name == "sweep" else "mdw", "-q"]
    )
    if not cloud.exists():
        shutil.copyfile(run / "cloud.las", cloud)
        shutil.copyfile(run / "report.json", options.output / f"{name}.report.json")
    stages = json.loads((options.output / f"{name}.report.json").read_text())["timings_s"]
    figures = cloud_figures(cloud, options.reference, options.visible, load_survey(options.survey))
    return {"row": name, **record, "stages_s": stages, **figures}


def held_survey(survey: Path, folder: Path) -> Path:
    """A survey folder without every eighth photograph, by links; the table of those that were left out."""
    config = read_config(survey / "survey.toml")
    table = survey / (config.cameras.poses or "")
    if table.suffix != ".csv":
        raise SystemExit(f"{survey} has its poses in {table}, expected a table (.csv), of which lines are left out")
    with table.open(encoding="utf-8", newline="") as stream:
        head, *lines = list(csv.reader(stream))
    held = lines[FIRST::EVERY]
    kept = [line for line in lines if line not in held]
    (folder / config.images.dir).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(survey / "survey.toml", folder / "survey.toml")
    for line in kept:
        link = folder / config.images.dir / line[0]
        if not link.is_symlink():
            link.symlink_to((survey / config.images.dir / line[0]).resolve())
    for path, part in ((folder / config.cameras.poses, kept), (folder / "held.csv", held)):
        with path.open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows([head, *part])
    return folder / "held.csv"


def some_of(held: Path, number: int | None) -> Path:
    """A table of as many of the views that were left out, evenly chosen."""
    head, *lines = held.read_text(encoding="utf-8").splitlines()
    if number is None or number >= len(lines):
        return held
    chosen = [lines[len(lines) * i // number] for i in range(number)]
    table = held.with_name(f"held_{number}.csv")
    table.write_text("\n".join([head, *chosen]) + "\n", encoding="utf-8")
    return table


def kept_views(survey: Survey, table: Path) -> list[View]:
    """The views of a survey that a table does not name: in its frame, which that of the others alone is not."""
    with table.open(encoding="utf-8", newline="") as stream:
        held = {line[0] for line in csv.reader(stream)}
    return [view for view in survey.views if view.name not in held]


def held_row(name: str, options: argparse.Namespace) -> dict:
    """Photographs that were left out, predicted from the others or from the field."""
    folder, views = options.output / "held", options.output / f"views of {name}"
    held, run = held_survey(options.survey, folder), folder / "bathynerf"
    table = some_of(held, options.views)
    arguments = ["process", str(folder), "--quality", options.quality, "--field", "mdw", "-q"]
    record = {"process": once(options.output / "held.process.json", arguments)}
    arguments = ["render", str(run), "--cameras", str(table), "-o", str(views), "-q"]
    arguments += ["--field"] if name == "held_field" else []
    record["render"] = once(options.output / f"{name}.render.json", arguments)
    survey, deepest = load_survey(options.survey), float(load_bed(RunDir(run).load_stage("bed")).bed.depth.max())
    weights = {f"{k}_weights": load(getattr(options, k)) for k in ("lpips", "dists") if getattr(options, k)}
    rendered = [(view, (views / view.name).with_suffix(".png")) for view in survey.views]
    each = [view_figures(survey, view, path, deepest, weights) for view, path in rendered if path.exists()]
    if options.steps:
        with_steps(each, survey, kept_views(survey, held), options.reference, views, deepest)
    return {"row": name, **record, **summary(each), "views": each}


def load(path: Path) -> dict:
    return torch.load(path, map_location="cpu", weights_only=True)


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = []
    clouds = [r for r in rows if r["row"] not in HELD]
    if clouds:
        share = 100.0 * clouds[0]["mast_share"]
        lines += [
            f"Masts, with yards, rails and other narrow objects, are {share:.2f} % of what three cameras see.",
            "",
            "| row | seconds | of | complete at 0.05 m | at 0.2 m | mean, mm | std, mm |",
            "|---|---|---|---|---|---|---|",
        ]
    for r in clouds:
        for part in ("all", "bed", "masts"):
            shares = [r[f"complete_{part}_{t}"] for t in (0.05, 0.2)]
            said = ["" if v is None else f"{100.0 * v:.2f} %" for v in shares]
            lengths = [f"{1000.0 * r[f'{k}_{part}']:.1f}" for k in ("mean", "std")]
            lines.append(f"| {r['row']} | {r['wall_s']:.0f} | {part} | {' | '.join(said + lengths)} |")
    for r in (r for r in rows if r["row"] in HELD):
        found = {k: v for k, v in r.items() if isinstance(v, float)}
        lines += ["", f"{r['row']}: {r['images']} images.", "", "| measure | mean |", "|---|---|"]
        lines += [f"| {name} | {value:.4f} |" for name, value in sorted(found.items())]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--rows", nargs="+", default=["sweep", "field", *HELD], choices=["sweep", "field", *HELD])
    parser.add_argument("--steps", action="store_true")
    parser.add_argument("--views", type=int)
    for name in ("reference", "visible", "lpips", "dists"):
        parser.add_argument(f"--{name}", type=Path)
    options = parser.parse_args()
    options.reference = options.reference or options.survey / "reference.ply"
    options.visible = options.visible or options.survey / "visible.ply"
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in options.rows:
        path = options.output / f"{name}.json"
        if not path.exists():
            row = held_row(name, options) if name in HELD else cloud_row(name, options)
            path.write_text(json.dumps(row, indent=2))
        rows.append(json.loads(path.read_text()))
    print(table(rows))  # noqa: T201


if __name__ == "__main__":
    main()
