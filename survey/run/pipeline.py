"""The stages of a run, each as data (inputs, outputs, dependencies, function), in their order.

    pose_check or adjust -> range -> sweep -> figures -> solver -> water_colour -> field -> points -> bed

A survey is one tile or several: sweep, solver and points are computed for each tile, and those of several are joined
to what one leaves. The block is adjusted as a whole; the bound, the views with a height map and what the solver has to
know are found once for all tiles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fields.models import IN_LAYER
from survey.plan.tile_choice import SHARED
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.keys import Key, colour_of
from survey.run.merged import join_solved, join_sweeps
from survey.run.stage_adjust import FILES as ADJUSTMENT_FILES
from survey.run.stage_adjust import MISFIT, adjust_block, check_poses, use_adjustment, use_misfit
from survey.run.stage_bed import FILES, POINTS, find_points, make_bed, use_bed
from survey.run.stage_field import COLOUR_FILE, estimate_colour, train_field, use_colour
from survey.run.stage_range import find_range, use_range
from survey.run.stage_solver import FIGURES, SIGHTINGS, SOLVED, WAVES, learn_figures, solve_heights
from survey.run.stage_sweep import CONSISTENCY, MAPS, SATURATED, sweep_views
from survey.run.stage_sweep import FILES as SWEEP_FILES
from survey.run.stored import FIELD_FILES

Compute = Callable[["Job", Path, Mapping[str, Path]], None]


@dataclass(frozen=True)
class Stage:
    """Step from photographs to points, whose result is kept in the run folder."""

    name: str
    needs: tuple[str, ...]  # Stages whose results it reads; those that a run leaves out are left out here too
    depends_on: tuple[str, ...]  # Parts of the job that decide its result: `survey.run.keys.PARTS`
    files: tuple[str, ...]  # Files in its folder
    # callable: gets the job, the folder to write to, and the folders of the stages that it needs, by name
    compute: Compute
    is_on: Callable[[Job], bool] = lambda _job: True  # callable: whether a job has this stage
    # callable, optional: changes the job by the result in a folder, whether computed now or earlier
    apply: Callable[[Job, Path], None] | None = None
    is_of_tiles: bool = False  # Whether each tile has one
    joined: Stage | None = None  # Which makes of those of several tiles what one leaves

    def folders(self, job: Job, done: Mapping[str, Path]) -> dict[str, Path]:
        """Folders of the stages that it reads, by name: those of a tile its own and, of the survey, those of all."""
        found = {name: done[name] for name in self.needs if name in done}
        if self.is_of_tiles:
            return found | {name: done[own] for name in self.needs if (own := job.stage_name(name)) in done}
        names = (part.stage_name(name) for name in self.needs for part in job.parts)
        return found | {name: done[name] for name in names if name in done}

    def key(self, job: Job, folders: Mapping[str, Path]) -> Key:
        """Dependencies of the result, given the folders of the stages that it reads."""
        parts = {name: job.hash_of_part(name) for name in (*self.depends_on, "code")}
        # The name of a stage's folder ends in the hash of all that it depends on.
        return Key(parts | {name: place.name for name, place in folders.items()})


def run_stage(stage: Stage, job: Job, run: RunDir, done: Mapping[str, Path], *, resume: bool) -> Path:
    """The folder of a stage: the one in the run where it is still right, else computed now."""
    name, folders = job.stage_name(stage.name), stage.folders(job, done)
    key = stage.key(job, folders)
    folder = reusable_result(stage, key, job, run, resume=resume)
    if folder is None:
        temp = run.open_stage(name)
        stage.compute(job, temp, folders)
        folder = commit_result(stage, name, key, run, temp)
        job.release()
    if stage.apply is not None:
        stage.apply(job, folder)
    return folder


def reusable_result(stage: Stage, key: Key, job: Job, run: RunDir, *, resume: bool) -> Path | None:
    """The folder of a stage in the run where its key still holds; None, and a note why, where it has to be computed."""
    name = job.stage_name(stage.name)
    folder = run.finished_stage(name, key, stage.files) if resume else None
    if folder is not None:
        job.progress.detail(f"{name}: used again, nothing that it depends on has changed")
        return folder
    why = run.recompute_reason(name, key) if resume else "--no-resume"
    if why is not None:
        job.progress.detail(f"{name}: computed again: {why}")
    return None


def commit_result(stage: Stage, name: str, key: Key, run: RunDir, temp: Path, seconds: float | None = None) -> Path:
    """Give what a stage has left in a folder its place in the run; ``seconds`` where a worker made it."""
    missing = [name for name in stage.files if not (temp / name).is_file()]
    if missing:
        raise RuntimeError(f"the stage {name} left no {', '.join(missing)}")
    return run.finish_stage(name, key, temp, seconds)


# What decides the rays of the photographs, and the size and the pixels that are worked on.
_RAYS = ("photographs", "cameras", "water", "device")
_VIEWS = (*_RAYS, "size")
_SOLVED = (SOLVED, SIGHTINGS, WAVES)

STAGES = (
    Stage(
        name="pose_check",
        needs=(),
        depends_on=(*_VIEWS, "frame", "area", "heights"),
        files=(MISFIT,),
        compute=check_poses,
        is_on=lambda job: job.plan.pose_choice == "check",
        apply=use_misfit,
    ),
    Stage(
        name="adjust",
        needs=(),
        depends_on=(*_VIEWS, "frame", "water_settings", "area", "heights", "ties", "priors", "control", "freed"),
        files=ADJUSTMENT_FILES,
        compute=adjust_block,
        is_on=lambda job: job.plan.pose_choice == "refine",
        apply=use_adjustment,
    ),
    Stage(
        name="range",
        needs=(),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "tiles"),
        files=(SHARED,),
        compute=find_range,
        apply=use_range,
    ),
    Stage(
        name="sweep",
        needs=("range",),
        depends_on=(*_VIEWS, "heights", "area", "gsd", "refined"),
        files=SWEEP_FILES,
        compute=sweep_views,
        is_of_tiles=True,
        joined=Stage("sweep", ("sweep",), _VIEWS, (MAPS, SATURATED, CONSISTENCY), join_sweeps),
    ),
    Stage(
        name="figures",
        needs=("sweep",),
        depends_on=(*_VIEWS, "gsd"),
        files=(FIGURES,),
        compute=learn_figures,
        is_on=lambda job: job.plan.solves,
    ),
    Stage(
        name="solver",
        needs=("sweep", "figures"),
        depends_on=(*_VIEWS, "gsd"),
        files=_SOLVED,
        compute=solve_heights,
        is_on=lambda job: job.plan.solves,
        is_of_tiles=True,
        joined=Stage("solver", ("sweep", "solver"), _VIEWS, _SOLVED, join_solved),
    ),
    Stage(
        name="water_colour",
        needs=("sweep",),
        depends_on=_VIEWS,
        files=(COLOUR_FILE,),
        compute=estimate_colour,
        is_on=lambda job: job.chosen.true_colour and colour_of(job.survey)[0] is None,
        apply=use_colour,
    ),
    Stage(
        name="field",
        needs=("sweep", "solver"),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "rays", "water_colour"),
        files=FIELD_FILES,
        compute=train_field,
        is_on=lambda job: job.plan.field in IN_LAYER,
    ),
    Stage(
        name="points",
        needs=("sweep", "solver"),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "true_colour", "boxes"),
        files=(POINTS,),
        compute=find_points,
        is_of_tiles=True,
    ),
    Stage(
        name="bed",
        needs=("adjust", "points", "solver"),
        depends_on=(*_VIEWS, "water_settings", "priors", "frame", "name", "gsd"),
        files=FILES,
        compute=make_bed,
        apply=use_bed,
    ),
)

# What the cloud would be of the sweep alone: a baseline for the report.
OF_SWEEP_ALONE = (
    replace(STAGES[-2], name="points_of_sweep", needs=("sweep",), is_on=lambda job: job.plan.solves),
    replace(STAGES[-1], name="bed_of_sweep", needs=("adjust", "points_of_sweep"), is_on=lambda job: job.plan.solves),
)
