"""Execution of the stages of a run; with an aim, rounds of sweep, solver and assessment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.pipeline import ASSESSMENT, BED_OF_SWEEP, STAGES
from survey.run.stage import Stage, run_stage
from survey.run.stage_sweep import EARLIER_ASSESSMENT, EARLIER_SOLVER, EARLIER_SWEEP
from survey.run.tiled import run_tiled

# Of a round, and the names under which the next one finds them.
_EARLIER = {"sweep": EARLIER_SWEEP, "solver": EARLIER_SOLVER, ASSESSMENT: EARLIER_ASSESSMENT}


def run_stages(job: Job, run: RunDir, *, resume: bool, compares_sweep: bool) -> dict[str, Path]:
    """Run the stages of the job; returns their folders by name.

    ``compares_sweep`` adds the cloud that the sweep alone would give, where the run is in one piece.
    """
    if job.tiling is not None:
        return run_tiled(job, run, resume=resume)
    done: dict[str, Path] = {}
    stages: Sequence[Stage] = [*STAGES, BED_OF_SWEEP] if compares_sweep else STAGES
    of_round = [stage for stage in stages if stage.name in _EARLIER]
    for stage in stages:
        if stage.name == "sweep":
            _begin(job)
        if stage.is_on(job):
            done[stage.name] = run_stage(stage, job, run, done, resume=resume)
        number = 1
        while stage.name == ASSESSMENT and job.aimed is not None and job.aimed.following is not None:
            _set_aside(done, number)
            for again in of_round:
                if again.is_on(job):
                    done[again.name] = run_stage(again, job, run, done, resume=resume, explains=False)
            number += 1
    return done


def _begin(job: Job) -> None:
    """Set the recipe of the first round."""
    if job.aimed is not None:
        job.aimed.has_begun = True
        job.plan_again()


def _set_aside(done: dict[str, Path], number: int) -> None:
    """Keep the stages of a round for the next one and in the record of the run."""
    for name, earlier in _EARLIER.items():
        if earlier in done:
            done[f"{name} of round {number - 1}"] = done.pop(earlier)
        if name in done:
            done[earlier] = done.pop(name)
