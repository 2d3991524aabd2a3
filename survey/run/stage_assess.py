"""The stage that assesses a round of a run with an aim, and decides on the next one.

Its decision depends on the clock where a time is asked for; it is kept in the run, so that the same command comes to
the same result.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.bed import unique_pixels
from fields.sweep.maps import HeightMap
from survey.files.json_values import write_json
from survey.run.aimed_run import CellStd, std_cells
from survey.run.folder import seconds_of
from survey.run.points import RefinedMaps, adjustment_of, bed_points, is_placed, with_std_of_block
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import CELLS, MAPS, restore_overlap_height
from survey.run.stored import save_arrays
from survey.run.stored_maps import Stored

if TYPE_CHECKING:
    from survey.run.aimed_run import AimedRun
    from survey.run.job import Job

REACHED = "reached.json"


def assess_round(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Write the std that was reached and the decision on the next round."""
    aimed = job.aimed
    if aimed is None:
        raise ValueError("a run without an aim has nothing to look at")
    solved = Stored(needs["solver"] / SOLVED, SolvedMap) if "solver" in needs else []
    num_solved = sum(len(each.pixels) for each in solved)
    summary: dict = {"solver_s": seconds_of(needs["solver"]) if num_solved else None, "solved": num_solved}
    _update_rates(aimed, summary)
    cells = _cells(job, needs, solved) if num_solved and aimed.aim.std_m is not None else None
    if cells is None:
        save_arrays(folder / CELLS, xyz=np.empty((0, 3)), above=np.empty(0, dtype=bool))
    else:
        save_arrays(folder / CELLS, xyz=cells.xyz, above=cells.std > aimed.aim.std_m)
    following, why = aimed.next_recipe(cells)
    write_json(folder / REACHED, summary | {"recipe": aimed.number, "following": following, "why": why})


def use_assessment(job: Job, folder: Path) -> None:
    """Give the job the recipe of the next round, or let this have been the last."""
    aimed = job.aimed
    if aimed is None:
        return
    found = json.loads((folder / REACHED).read_text(encoding="utf-8"))
    _update_rates(aimed, found)
    decision = aimed.end_round(found["following"], found["why"])
    job.progress.note(f"plan: {decision.name}: {decision.choice} ({decision.reason})")
    job.plan_again()


def _update_rates(aimed: AimedRun, found: dict) -> None:
    if found["solver_s"] is not None:
        aimed.rates = aimed.rates.after_solver(found["solver_s"], found["solved"])


def _cells(job: Job, needs: Mapping[str, Path], solved: Sequence[SolvedMap]) -> CellStd:
    """Std by cells of the points that the run would have if it ended now, those with heights of the sweep included."""
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    restore_overlap_height(job, needs["sweep"])
    kept = job.unique_masks(needs["sweep"], lambda: unique_pixels(job.block, maps, job.plan.gsd_m))
    bed, _, _ = bed_points(job, RefinedMaps(maps, kept, solved), lambda _done: None, coloured=False)
    if not is_placed(job.survey):
        # As in the gate: no round reduces the std of the datum by GPS or control.
        bed, _ = with_std_of_block(bed, job.survey, adjustment_of(needs), job.plan.gsd_m)
    return std_cells(bed, job.plan.gsd_m)
