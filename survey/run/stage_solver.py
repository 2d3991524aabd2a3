"""The stage of the solver: heights of the points by least squares over all photographs, with their std."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fields.solver.solver import SolvedMap, SolverFigures, solve_maps
from fields.sweep.bed import unique_pixels
from fields.sweep.maps import ByView, HeightMap, upsample_map
from fields.sweep.wide_windows import wet_pairs
from survey.files.json_values import write_json
from survey.progress import shares
from survey.run.stage_sweep import EARLIER_SOLVER, EARLIER_SWEEP, MAPS, SCRATCH, restore_overlap_height, views_swept
from survey.run.stored_maps import Stored, map_store, save_maps

if TYPE_CHECKING:
    from fields.image_store import Masks
    from fields.solver.visibility import VisibilityCounts
    from survey.run.job import Job

SOLVED, SIGHTINGS = "solved.npz", "sightings.json"
# Least share of the expected time of the solver: with less left it would finish too few tiles to be worth it.
_LEAST_TIME = 0.3


def solve_heights(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solve the pixels of the height maps that become points."""
    solve_with(job, folder, needs, None)


def solve_with(job: Job, folder: Path, needs: Mapping[str, Path], figures: SolverFigures | None) -> None:
    """The same with figures of the solver that are known, or learned here."""
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    if not _has_time(job):
        job.progress.note("solver: left out, there is no time for it")
        _save(job, folder, [SolvedMap.empty() for _ in maps], None)
        return
    restore_overlap_height(job, needs["sweep"])
    kept = job.unique_masks(needs["sweep"], lambda: unique_pixels(job.block, maps, job.plan.gsd_m)).copy()
    pairs = wet_pairs(job.block, maps.views)
    for number, view in enumerate(maps.views):
        if view in pairs:
            # Single pixels of two photographs show ripples, which moved.
            kept[number] = kept[number] & (maps[number].height >= 0.0)
    carried = _reused_solutions(maps, kept, needs)
    for number, each in enumerate(carried):
        if each is not None:
            kept[number] = np.zeros_like(kept[number])
    with job.progress.stage("Solver", 1.0) as stage, map_store(folder / SCRATCH, SolvedMap) as make_store:
        solved, figures = solve_maps(
            job.block,
            maps,
            kept,
            job.plan.gsd_m,
            shares(stage),
            has_time=lambda: _has_time_for_more(job),
            make_store=make_store,
            figures=figures,
        )
        both = (new if old is None else old for new, old in zip(solved, carried, strict=True))
        _save(job, folder, both, figures.visibility)
    job.progress.detail(f"solver: {figures}")


def _save(job: Job, folder: Path, solved: Iterable[SolvedMap], found: VisibilityCounts | None) -> None:
    save_maps(folder / SOLVED, SolvedMap, solved)
    names = [view.name for view in job.survey.views]
    seen, outlying = ([0] * len(names),) * 2 if found is None else (found.seen.tolist(), found.outlying.tolist())
    write_json(folder / SIGHTINGS, {name: pair for name, *pair in zip(names, seen, outlying, strict=True)})


def _has_time(job: Job) -> bool:
    """Whether the time of a run that has one allows for a good part of the solver."""
    aimed = job.aimed
    if aimed is None or aimed.clock is None:
        return True
    foreseen = aimed.rates.solver_s(aimed.amounts, aimed.scale)
    return aimed.clock.left_s - aimed.tail_s > _LEAST_TIME * foreseen


def _has_time_for_more(job: Job) -> bool:
    aimed = job.aimed
    return aimed is None or aimed.clock is None or aimed.clock.left_s > aimed.tail_s


def _reused_solutions(maps: Sequence[HeightMap], kept: Masks, needs: Mapping[str, Path]) -> list[SolvedMap | None]:
    """Solutions of the round before, at the size of this one, for the maps that this round left unchanged."""
    if EARLIER_SOLVER not in needs or EARLIER_SWEEP not in needs:
        return [None for _ in maps]
    swept = views_swept(needs["sweep"])
    of_sweep = Stored(needs[EARLIER_SWEEP] / MAPS, HeightMap)
    before = ByView(of_sweep, of_sweep.views)
    solved = ByView(Stored(needs[EARLIER_SOLVER] / SOLVED, SolvedMap), of_sweep.views)
    return [
        None if m.view in swept else _enlarged(before[m.view], solved[m.view], m, keep)
        for m, keep in zip(maps, kept, strict=True)
    ]


def _enlarged(before: HeightMap, solved: SolvedMap, now: HeightMap, keep: np.ndarray) -> SolvedMap:
    """Solution of a smaller map as pixels of a larger one; heights that were not solved stay those of the sweep."""
    with_heights, std = solved.over(before)
    # Each pixel has the std of the one that it is a part of.
    rows, columns = (
        (np.arange(size) * small) // size for size, small in zip(now.height.shape, before.height.shape, strict=True)
    )
    std = std[rows[:, None], columns]
    height = upsample_map(with_heights, now.height.shape[::-1]).height
    pixels = np.flatnonzero(keep & np.isfinite(std))
    return SolvedMap(pixels, height.flat[pixels], std.flat[pixels])
