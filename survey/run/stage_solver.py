"""The stage of the solver: heights of the points by least squares over all photographs, and how sure they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fields.solver.solver import solve_maps
from fields.sweep.bed import unique_pixels
from survey.files.json_values import write_json
from survey.progress import shares
from survey.run.stage_sweep import MAPS, look_at_bed
from survey.run.stored import load_depth_maps, save_solved_maps

if TYPE_CHECKING:
    from survey.run.job import Job

SOLVED, SIGHTINGS = "solved.npz", "sightings.json"


def solve_heights(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solve the pixels of the height maps that become points."""
    maps = load_depth_maps(needs["sweep"] / MAPS)
    look_at_bed(job, needs["sweep"])
    with job.progress.stage("Solver", 1.0) as stage:
        solved, figures = solve_maps(job.block, maps, unique_pixels(job.block, maps), job.plan.gsd_m, shares(stage))
    job.progress.note(f"solver: {figures}")
    save_solved_maps(folder / SOLVED, solved)
    found, names = figures.sightings, [view.name for view in job.survey.views]
    seen, outlying = ([0] * len(names),) * 2 if found is None else (found.seen.tolist(), found.outlying.tolist())
    write_json(folder / SIGHTINGS, {name: pair for name, *pair in zip(names, seen, outlying, strict=True)})
