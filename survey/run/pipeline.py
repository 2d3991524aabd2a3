"""The stages of a run, each as data (inputs, outputs, dependencies, function), in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.keys import Key
from survey.run.stage_adjust import FILES as ADJUSTMENT_FILES
from survey.run.stage_adjust import MISFIT, adjust_block, check_poses, use_adjustment, use_misfit
from survey.run.stage_assess import REACHED, assess_round, use_assessment
from survey.run.stage_bed import FILES, make_bed
from survey.run.stage_field import train_field
from survey.run.stage_solver import SIGHTINGS, SOLVED, solve_heights
from survey.run.stage_sweep import (
    BOUND,
    CELLS,
    EARLIER_ASSESSMENT,
    EARLIER_SOLVER,
    EARLIER_SWEEP,
    MAPS,
    SATURATED,
    SWEPT,
    sweep_views,
    use_sweep,
)
from survey.run.stage_water_colour import estimate_colour, use_colour
from survey.run.stored import FIELD_FILES
from survey.run.water_colour import COLOUR_FILE, colour_is_known
from survey.stage_key import code_hash

Compute = Callable[["Job", Path, Mapping[str, Path]], None]


@dataclass(frozen=True)
class Stage:
    """Step from photographs to points, whose result is kept in the run folder."""

    name: str
    needs: tuple[str, ...]  # Stages whose results it reads; those that a run leaves out are left out here too
    depends_on: tuple[str, ...]  # Parts of the job that decide its result; see `Job.hash_of_part`
    files: tuple[str, ...]  # Files in its folder
    # callable: gets the job, the folder to write to, and the folders of the stages that it needs, by name
    compute: Compute
    is_on: Callable[[Job], bool] = lambda _job: True  # callable: whether a job has this stage
    # callable, optional: changes the job by the result in a folder, whether computed now or earlier
    apply: Callable[[Job, Path], None] | None = None

    def key(self, job: Job, done: Mapping[str, Path]) -> Key:
        """Dependencies of the result, given the folders of the stages before."""
        parts = {name: job.hash_of_part(name) for name in self.depends_on}
        # The name of a stage's folder ends in the hash of all that it depends on.
        parts |= {name: done[name].name for name in self.needs if name in done}
        return Key(parts | {"code": code_hash()})


def run_stage(
    stage: Stage, job: Job, run: RunDir, done: Mapping[str, Path], *, resume: bool, explains: bool = True
) -> Path:
    """The folder of a stage: the one in the run where it is still right, else computed now.

    ``explains`` says why it is computed again where the run has results of it.
    """
    key = stage.key(job, done)
    folder = reusable_result(stage, key, job, run, resume=resume, explains=explains)
    if folder is None:
        temp = run.open_stage(stage.name)
        stage.compute(job, temp, {name: done[name] for name in stage.needs if name in done})
        folder = commit_result(stage, key, run, temp)
        job.release()
    if stage.apply is not None:
        stage.apply(job, folder)
    return folder


def reusable_result(
    stage: Stage, key: Key, job: Job, run: RunDir, *, resume: bool, explains: bool = True
) -> Path | None:
    """The folder of a stage in the run where its key still holds; None, and a note why, where it has to be computed."""
    folder = run.finished_stage(stage.name, key, stage.files) if resume else None
    if folder is not None:
        job.progress.note(f"{stage.name}: used again, nothing that it depends on has changed")
        return folder
    why = run.recompute_reason(stage.name, key) if resume else "--no-resume"
    if explains and why is not None:
        job.progress.note(f"{stage.name}: computed again: {why}")
    return None


def commit_result(stage: Stage, key: Key, run: RunDir, temp: Path, seconds: float | None = None) -> Path:
    """Give what a stage has left in a folder its place in the run; ``seconds`` where a worker made it."""
    missing = [name for name in stage.files if not (temp / name).is_file()]
    if missing:
        raise RuntimeError(f"the stage {stage.name} left no {', '.join(missing)}")
    return run.finish_stage(stage.name, key, temp, seconds)


def _adjusts(job: Job) -> bool:
    return job.plan.pose_choice == "refine"


def _checks_poses(job: Job) -> bool:
    return job.plan.pose_choice == "check"


def _needs_colour(job: Job) -> bool:
    return job.chosen.true_colour and not colour_is_known(job.survey)


def _is_solved(job: Job) -> bool:
    return job.plan.field == "solver"


def _is_aimed(job: Job) -> bool:
    return job.aimed is not None


def _has_slab(job: Job) -> bool:
    return job.plan.field == "slab"


def _is_refined(job: Job) -> bool:
    return _is_solved(job) or _has_slab(job)


# What decides the rays of the photographs, and the size and the pixels that are worked on.
_RAYS = ("photographs", "cameras", "water", "device")
_VIEWS = (*_RAYS, "size", "skips")
# The stage that ends a round of a run with an aim.
ASSESSMENT = "reached"

STAGES = (
    Stage(
        name="pose_check",
        needs=(),
        depends_on=(*_VIEWS, "frame", "area", "heights"),
        files=(MISFIT,),
        compute=check_poses,
        is_on=_checks_poses,
        apply=use_misfit,
    ),
    Stage(
        name="adjust",
        needs=(),
        depends_on=(*_VIEWS, "frame", "water_settings", "area", "heights", "ties", "priors", "control", "freed"),
        files=ADJUSTMENT_FILES,
        compute=adjust_block,
        is_on=_adjusts,
        apply=use_adjustment,
    ),
    Stage(
        name="sweep",
        needs=(EARLIER_SWEEP, EARLIER_ASSESSMENT),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "refined", "aim"),
        files=(MAPS, BOUND, SATURATED, SWEPT),
        compute=sweep_views,
        apply=use_sweep,
    ),
    Stage(
        name="solver",
        needs=("sweep", EARLIER_SWEEP, EARLIER_SOLVER),
        depends_on=(*_VIEWS, "gsd", "aim"),
        files=(SOLVED, SIGHTINGS),
        compute=solve_heights,
        is_on=_is_solved,
    ),
    Stage(
        name=ASSESSMENT,
        needs=("adjust", "sweep", "solver"),
        depends_on=(*_VIEWS, "area", "gsd", "aim"),
        files=(REACHED, CELLS),
        compute=assess_round,
        is_on=_is_aimed,
        apply=use_assessment,
    ),
    Stage(
        name="water_colour",
        needs=("sweep",),
        depends_on=_VIEWS,
        files=(COLOUR_FILE,),
        compute=estimate_colour,
        is_on=_needs_colour,
        apply=use_colour,
    ),
    Stage(
        name="field",
        needs=("sweep",),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "rays", "water_colour"),
        files=FIELD_FILES,
        compute=train_field,
        is_on=_has_slab,
    ),
    Stage(
        name="bed",
        needs=("adjust", "sweep", "solver", "field"),
        depends_on=(*_VIEWS, "water_settings", "priors", "area", "frame", "name", "gsd", "true_colour", "boxes"),
        files=FILES,
        compute=make_bed,
    ),
)

# What the cloud would be of the sweep alone: a baseline for the report.
BED_OF_SWEEP = replace(STAGES[-1], name="bed_of_sweep", needs=("adjust", "sweep"), is_on=_is_refined)
