"""The stage of the solver: heights of the points by least squares over all photographs, with their std."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fields.solver.solver import SolvedMap, SolverFigures, solve_maps
from fields.sweep.bed import unique_pixels
from fields.sweep.maps import HeightMap
from fields.sweep.wide_windows import wet_pairs
from survey.files.json_values import write_json
from survey.progress import shares
from survey.run.stage_sweep import MAPS, SCRATCH, restore_overlap_height
from survey.run.stored_maps import Stored, map_store, save_maps

if TYPE_CHECKING:
    from fields.solver.visibility import VisibilityCounts
    from survey.run.job import Job

SOLVED, SIGHTINGS = "solved.npz", "sightings.json"


def solve_heights(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solve the pixels of the height maps that become points."""
    solve_with(job, folder, needs, None)


def solve_with(job: Job, folder: Path, needs: Mapping[str, Path], figures: SolverFigures | None) -> None:
    """The same with figures of the solver that are known, or learned here."""
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    restore_overlap_height(job, needs["sweep"])
    kept = job.unique_masks(needs["sweep"], lambda: unique_pixels(job.block, maps, job.plan.gsd_m)).copy()
    pairs = wet_pairs(job.block, maps.views)
    for number, view in enumerate(maps.views):
        if view in pairs:
            # Single pixels of two photographs show ripples, which moved.
            kept[number] = kept[number] & (maps[number].height >= 0.0)
    with job.progress.stage("Solver", 1.0) as stage, map_store(folder / SCRATCH, SolvedMap) as make_store:
        solved, figures = solve_maps(
            job.block,
            maps,
            kept,
            job.plan.gsd_m,
            shares(stage),
            make_store=make_store,
            figures=figures,
        )
        _save(job, folder, solved, figures.visibility)
    job.progress.detail(f"solver: {figures}")


def _save(job: Job, folder: Path, solved: Iterable[SolvedMap], found: VisibilityCounts | None) -> None:
    save_maps(folder / SOLVED, SolvedMap, solved)
    names = [view.name for view in job.survey.views]
    seen, outlying = ([0] * len(names),) * 2 if found is None else (found.seen.tolist(), found.outlying.tolist())
    write_json(folder / SIGHTINGS, {name: pair for name, *pair in zip(names, seen, outlying, strict=True)})
