"""What do windows, hypotheses, views and the rules of trust of the sweep bring? One choice changed at a time.

    python benchmarks/bench_sweep.py [SURVEY ...] [--quality Q] [--tables passes steps views trust once] [-o FOLDER]

A SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/); without any, that of
`make demo` is drawn. Accuracy is that of `bathynerf compare` inside the bounds, nothing aligned: mean and standard
deviation of the inner 90 % of the signed distances, completeness over the points that three cameras see. One JSON for
each survey and table in FOLDER, not computed again; prints the tables in Markdown.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from fields.sweep import maps as maps_module
from fields.sweep import views
from fields.sweep.bed import BedPoints, unique_pixels
from fields.sweep.fusion import remove_free_space_violations
from fields.sweep.maps import HeightMap, trusted
from fields.sweep.matching import PASSES, Pass
from fields.sweep.sweep import find_range, sweep
from fields.sweep.view_pass import SweepSettings
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.folder.survey import load_survey
from survey.plan.area import limits, local_area
from survey.plan.choices import RECIPES, Choices
from survey.plan.plan import make_plan
from survey.progress import current
from survey.run import stage_bed
from survey.run.job import Job
from survey.run.products import write_bed_las
from survey.run.stored import StoredBed
from survey.simulate.drawn import DrawnScene, draw_survey

# Without the search beside steps, which would hide what the passes themselves find.
START = (PASSES[0], replace(PASSES[1], discontinuities=None), replace(PASSES[2], hypotheses=9, discontinuities=None))
# A pass at full size that averages the heights of the views that agree.
WIDE, NARROW = Pass(1.0, 2, 5, 0.25, 8, True), Pass(1.0, 1, 3, 0.25, 12, True)
AFTER_START = {
    "nothing": (),
    "`r2 5 8*`": (WIDE,),
    "`r2 5 12*`": (replace(WIDE, neighbours=12),),
    "`r2 5 8*`, `r2 3 12*`": (WIDE, replace(NARROW, radius=2)),
    "`r2 5 8*`, `r1 3 12*` (kept)": (WIDE, NARROW),
    "`r2 5 8*`, `r1 3 20*`": (WIDE, replace(NARROW, neighbours=20)),
    "`r2 9 8*`, `r1 5 12*`": (replace(WIDE, hypotheses=9), replace(NARROW, hypotheses=5)),
    "`r1 5 12*`, `r1 3 12*`": (replace(NARROW, hypotheses=5), NARROW),
    "`r2 5 8`, `r1 3 12*` (averaged at the end only)": (replace(WIDE, fuse=False), NARROW),
}
# How often every place is to be seen: by steep views, and by oblique ones of each quarter.
TIMES_SEEN = ((2, 1), (4, 1), (6, 2))
ANY_VIEWS = 3
# (agreeing views that are enough, correlation from which one is enough; above 1 none is)
TRUST = {
    "two agree": (2, 2.0),
    "two agree, or one and NCC above 0.8 (kept)": (2, 0.8),
    "one agrees": (1, 0.8),
}
CONTRADICTED = "kept, and heights that other views look through"
# Scales at which heights are searched between those around a pixel.
SEARCHED: dict[str, tuple[float, ...]] = {"nowhere": (), "half size": (0.5,), "half and full size (kept)": (0.5, 1.0)}


class Case:
    """A survey loaded once, with its truth."""

    def __init__(self, folder: Path, quality: str):
        truth = folder / "truth" if (folder / "truth").is_dir() else folder
        self.reference, self.visible = truth / "reference.ply", truth / "visible.ply"
        survey, chosen = load_survey(folder), Choices(quality=quality)
        self.job = Job(survey, chosen, make_plan(survey, chosen), current())
        self.survey, self.plan, self.block = self.job.survey, self.job.plan, self.job.block
        self.bound = find_range(self.block, limits(self.survey))
        self.block.set_overlap_height(0.5 * (self.bound[0] + self.bound[1]))
        self.chosen = self.block.cover(*RECIPES[quality].times_seen, local_area(self.survey))

    def maps(
        self, passes: tuple[Pass, ...] = PASSES, chosen: list[int] | None = None, *, checked: bool = True
    ) -> tuple[list[HeightMap], float]:
        """Height maps, without heights that other views contradict if ``checked``, and the seconds that they took."""
        start = time.monotonic()
        chosen = self.chosen if chosen is None else chosen
        maps = sweep(self.block, chosen, SweepSettings(self.bound, passes), lambda done: None)
        if checked:
            maps = remove_free_space_violations(self.block, maps)
        return maps, time.monotonic() - start

    def points(self, maps: list[HeightMap], kept: Sequence[np.ndarray] | None = None) -> BedPoints:
        """Points of the pixels that are kept, (height, width) bool of each map; by default one for each place."""
        if kept is None:
            kept = unique_pixels(self.block, maps, self.job.plan.gsd_m)
        return stage_bed.bed_points(self.job, maps, kept, None, lambda done: None)[0]

    def figures(self, bed: BedPoints) -> dict:
        """Distances of the points from the truth, and their completeness."""
        survey = self.survey
        stored = StoredBed(bed, survey.frame.crs_from_local(bed.xyz), survey.frame.crs, survey.name, self.plan.gsd_m)
        options = CompareOptions(tolerances_m=(0.2, 0.05), visible=self.visible, bounds=survey.bounds)
        with tempfile.TemporaryDirectory() as folder:
            write_bed_las(Path(folder) / "cloud.las", stored)
            found = compare_surfaces(Path(folder) / "cloud.las", self.reference, options)
        figures = {"points": len(found.distances), "farthest_m": float(np.abs(found.distances).max())}
        distances = found.figures.distances
        figures |= {"mean_inner90_m": distances.mean_inner90_m, "std_inner90_m": distances.std_inner90_m}
        far = float((np.abs(found.distances) > 0.2).mean())
        complete = {f"complete_{s.tolerance_m:g}": s.completeness_visible for s in found.figures.tolerances}
        return figures | complete | {"beyond_0.2": far}


def passes_table(case: Case) -> dict[str, dict]:
    """What comes after the common start."""
    rows = {}
    for name, after in AFTER_START.items():
        maps, seconds = case.maps(START + after)
        rows[name] = case.figures(case.points(maps)) | {"seconds": seconds}
    return rows


def views_table(case: Case) -> dict[str, dict]:
    """Which views get a height map."""
    area = local_area(case.survey)
    choices = {f"{steep} times steeply, {q} from each quarter": (steep, q) for steep, q in TIMES_SEEN}
    picked = {name: case.block.cover(*times, area) for name, times in choices.items()}
    picked[f"{ANY_VIEWS} times by any view"] = sorted(views._greedy(case.block.seen, [], ANY_VIEWS))
    rows = {}
    for name, chosen in picked.items():
        maps, seconds = case.maps(chosen=chosen)
        rows[f"{name}: {len(maps)}"] = case.figures(case.points(maps)) | {"seconds": seconds}
    return rows


def trust_table(case: Case) -> dict[str, dict]:
    """Which heights become points."""
    maps, _ = case.maps()
    rows = {}
    for name, (enough, ncc) in TRUST.items():
        with patch.multiple(maps_module, CONFIRMED_TWICE=enough, TRUSTED_NCC=ncc):
            rows[name] = case.figures(case.points(maps))
    rows[CONTRADICTED] = case.figures(case.points(case.maps(checked=False)[0]))
    return rows


def steps_table(case: Case) -> dict[str, dict]:
    """Where heights are searched between those around a pixel."""
    rows = {}
    for name, searched in SEARCHED.items():
        passes = tuple(p if p.scale in searched else replace(p, discontinuities=None) for p in PASSES)
        maps, seconds = case.maps(passes)
        rows[name] = case.figures(case.points(maps)) | {"seconds": seconds}
    return rows


def once_table(case: Case) -> dict[str, dict]:
    """How duplicates and strays are left out."""
    maps, _ = case.maps()
    rows = {"a kept pixel claims those of later views (kept)": case.figures(case.points(maps))}
    with patch.object(stage_bed, "has_neighbours", lambda xyz, gsd: np.ones(len(xyz), dtype=bool)):
        rows["the same, with isolated points"] = case.figures(case.points(maps))
        everything = case.points(maps, [trusted(m) for m in maps])
    rows["nothing left out"] = case.figures(everything)
    rows["mean of the points in cubes of one GSD"] = case.figures(in_cubes(everything, case.plan.gsd_m))
    return rows


def in_cubes(bed: BedPoints, size: float) -> BedPoints:
    """One point for each cube of this size [m]: the first in it, at the mean of all."""
    _, first, cube, count = np.unique(
        np.floor(bed.xyz / size).astype(np.int64), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    sums = [np.bincount(cube.ravel(), weights=bed.xyz[:, axis]) for axis in range(3)]
    return replace(bed[first], xyz=np.stack(sums, axis=-1) / count[:, None])


TABLES = {"passes": passes_table, "steps": steps_table, "views": views_table, "trust": trust_table, "once": once_table}


def markdown(title: str, rows: dict[str, dict]) -> str:
    """The rows of one table."""
    has_time = any("seconds" in r for r in rows.values())
    head = ["mean", "std", "at 0.2 m", "at 0.05 m", "beyond 0.2 m", "farthest", "points"] + ["time"] * has_time
    lines = [f"| {title} | " + " | ".join(head) + " |", "|---|" + "---|" * len(head)]
    for name, r in rows.items():
        cells = [f"{1e3 * r['mean_inner90_m']:.1f} mm", f"{1e3 * r['std_inner90_m']:.2f} mm"]
        cells += [f"{100 * r[k]:.2f} %" for k in ("complete_0.2", "complete_0.05", "beyond_0.2")]
        cells += [f"{r['farthest_m']:.2f} m", f"{r['points']:,}"]
        cells += [f"{r['seconds']:.0f} s"] if has_time else []
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def parser_of(description: str) -> argparse.ArgumentParser:
    """A command line with surveys, their quality and a folder for results."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("surveys", nargs="*", type=Path)
    parser.add_argument("--quality", default="standard", choices=list(RECIPES))
    parser.add_argument("-o", "--output", type=Path)
    return parser


def surveys_and_results(options: argparse.Namespace) -> tuple[list[Path], Path]:
    """The surveys that are named, or else a drawn one, and the folder for results, which is made."""
    work = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_bench_"))
    work.mkdir(parents=True, exist_ok=True)
    if options.surveys:
        return options.surveys, work
    draw_survey(work / "demo", DrawnScene())
    return [work / "demo"], work


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=list(TABLES))
    options = parser.parse_args()
    surveys, work = surveys_and_results(options)
    for folder in surveys:
        case = None
        for name in options.tables:
            path = work / f"{folder.name}_{options.quality}_{name}.json"
            if not path.exists():
                case = case or Case(folder, options.quality)
                path.write_text(json.dumps(TABLES[name](case), indent=2))
            sys.stdout.write(markdown(f"{folder.name}, {name}", json.loads(path.read_text())) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
