"""How long does a survey's field have to learn?

    python benchmarks/bench_slab.py [SURVEY ...] [--quality Q] [--rays R ...] [-o FOLDER]

The sweep runs once; fields with different numbers of training rays for each cell of one GSD (`rays_per_cell` in
survey.plan.recipe) are trained from its height maps. Accuracy and surveys as in bench_sweep; PSNR is of the training
rays of the last steps, time the processor time of training. One JSON for each row in FOLDER, not computed again; prints
tables in Markdown, docs/notes/field.md has them.
"""

from __future__ import annotations

import json
import re
import sys
import time
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from unittest.mock import patch

from bench_sweep import Case, parser_of, surveys_and_results

from fields.sweep.bed import unique_pixels
from fields.sweep.maps import HeightMap
from survey.plan.recipe import RECIPES
from survey.progress import current, shares
from survey.run import points, stage_field

KEPT = RECIPES["standard"].rays_per_cell


def trained(case: Case, maps: list[HeightMap], rays_per_cell: float) -> dict:
    """Figures of a field, of its training and of the cloud that it refines."""
    start, used = time.monotonic(), time.process_time()
    recipe = replace(case.plan.recipe, rays_per_cell=rays_per_cell)
    with patch.dict(RECIPES, {case.plan.quality: recipe}), current().stage("field", 1.0) as stage:
        field, figures = stage_field.trained(case.job, maps, shares(stage))
    spent = {"seconds": time.monotonic() - start, "processor_s": time.process_time() - used}
    kept = unique_pixels(case.block, maps, case.plan.gsd_m)
    bed, _, moved = points.bed_points(case.job, points.RefinedMaps(maps, kept, field=field), lambda done: None)
    return asdict(figures) | spent | case.figures(bed) | {"share_of_field": moved / len(bed)}


def rows_of(folder: Path, quality: str, rays: list[float], work: Path) -> dict[str, dict]:
    """The sweep alone, and the field by number of rays; each is kept in a file and not computed again."""

    @cache
    def swept() -> tuple[Case, list[HeightMap]]:
        case = Case(folder, quality)
        return case, case.maps()[0]

    rows = {"sweep alone": lambda: swept()[0].figures(swept()[0].points(swept()[1]))}
    for number in rays:
        rows[f"{number:g} rays a cell" + (" (kept)" if number == KEPT else "")] = partial(
            lambda n: trained(*swept(), n), number
        )
    found = {}
    for title, compute in rows.items():
        path = work / f"{folder.name}_{quality}_slab_{re.sub('[^a-z0-9]+', '_', title)}.json"
        if not path.exists():
            path.write_text(json.dumps(compute(), indent=2))
        found[title] = json.loads(path.read_text())
    return found


def markdown(name: str, rows: dict[str, dict]) -> str:
    """The rows of one survey."""
    lines = [
        f"| {name} | mean | std | at 0.2 m | at 0.05 m | steps | PSNR | processor time |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for title, r in rows.items():
        cells = [f"{1e3 * r['mean_inner90_m']:.1f} mm", f"{1e3 * r['std_inner90_m']:.2f} mm"]
        cells += [f"{100 * r[k]:.2f} %" for k in ("complete_0.2", "complete_0.05")]
        cells += [f"{r['steps']}", f"{r['psnr_db']:.2f} dB", f"{r['processor_s']:.0f} s"] if "steps" in r else [""] * 3
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--rays", nargs="+", type=float, default=[KEPT / 3.0, KEPT, 3.0 * KEPT])
    options = parser.parse_args()
    surveys, work = surveys_and_results(options)
    for folder in surveys:
        rows = rows_of(folder, options.quality, options.rays, work)
        sys.stdout.write(markdown(f"{folder.name}, {options.quality}", rows) + "\n")


if __name__ == "__main__":
    main()
