"""The stages of a run, each as data (inputs, outputs, dependencies, function), in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fields.models import IN_LAYER
from survey.plan.tile_choice import SHARED
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.keys import Key
from survey.run.merged import merge_points, merge_solved, merge_sweeps
from survey.run.stage_adjust import FILES as ADJUSTMENT_FILES
from survey.run.stage_adjust import MISFIT, adjust_block, check_poses, use_adjustment, use_misfit
from survey.run.stage_bed import FILES, make_bed
from survey.run.stage_field import train_field
from survey.run.stage_of_tile import FIGURES, POINTS, SQUARES, find_points, learn_figures, solve_tile, sweep_tile
from survey.run.stage_solver import SIGHTINGS, SOLVED, solve_heights
from survey.run.stage_sweep import BOUND, CONSISTENCY, MAPS, SATURATED, sweep_views
from survey.run.stage_tiles import find_shared
from survey.run.stage_water_colour import estimate_colour, use_colour
from survey.run.stored import FIELD_FILES
from survey.run.tile_job import MASKS, TileJob
from survey.run.water_colour import COLOUR_FILE, colour_is_known
from survey.stage_key import code_hash

Compute = Callable[["Job", Path, Mapping[str, Path]], None]
# Gets the job, the folder to write to, the tiles, the folders of their stages by name, and those of other stages.
Merge = Callable[["Job", Path, Sequence[TileJob], Mapping[str, list[Path]], Mapping[str, Path]], None]


@dataclass(frozen=True)
class InTiles:
    """How a stage is computed where a survey has several tiles: each alone, and what they found put together.

    What is put together has the form that a survey in one piece leaves: all that follows is the same.
    """

    merge: Merge
    of_tiles: tuple[str, ...]  # Stages of the tiles that it reads
    compute: Compute | None = None  # Of one tile; None where there is only something to put together
    needs: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


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
    in_tiles: InTiles | None = None  # None where it is computed for the whole survey in any case

    def key(self, job: Job, done: Mapping[str, Path]) -> Key:
        """Dependencies of the result, given the folders of the stages before."""
        parts = {name: job.hash_of_part(name) for name in self.depends_on}
        # The name of a stage's folder ends in the hash of all that it depends on.
        parts |= {name: done[name].name for name in self.needs if name in done}
        return Key(parts | {"code": code_hash()})

    def of_tile(self, tile: TileJob) -> Stage | None:
        """The stage of one tile, which needs those of the same tile and what all share."""
        own, compute = self.in_tiles, None if self.in_tiles is None else self.in_tiles.compute
        if own is None or compute is None:
            return None
        names = {_name(name, tile): name for name in own.needs if name in _OF_TILES}
        shared = tuple(name for name in own.needs if name not in _OF_TILES)

        def computed(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
            compute(job, folder, {names.get(name, name): place for name, place in needs.items()})

        return replace(
            self,
            name=_name(self.name, tile),
            needs=(*names, *shared),
            files=own.files,
            compute=computed,
            apply=None,
            in_tiles=None,
        )

    def over(self, tiles: Sequence[TileJob]) -> Stage:
        """The stage of the whole survey that puts stages of its tiles together."""
        if not tiles or (own := self.in_tiles) is None:
            return self
        merge, names = own.merge, {name: [_name(name, tile) for tile in tiles] for name in own.of_tiles}
        of_tiles = tuple(each for of_name in names.values() for each in of_name)

        def merged(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
            places = {name: [needs[each] for each in of_name] for name, of_name in names.items()}
            merge(job, folder, tiles, places, {name: place for name, place in needs.items() if name not in of_tiles})

        shared = ("adjust",) if "adjust" in self.needs else ()
        return replace(self, needs=(*of_tiles, *shared), compute=merged)


# Stages that each tile has.
_OF_TILES = ("sweep", "solver", "bed")


def _name(stage: str, tile: TileJob) -> str:
    return f"{stage}_tile{tile.number + 1}"


def run_stage(stage: Stage, job: Job, run: RunDir, done: Mapping[str, Path], *, resume: bool) -> Path:
    """The folder of a stage: the one in the run where it is still right, else computed now."""
    key = stage.key(job, done)
    folder = reusable_result(stage, key, job, run, resume=resume)
    if folder is None:
        temp = run.open_stage(stage.name)
        stage.compute(job, temp, {name: done[name] for name in stage.needs if name in done})
        folder = commit_result(stage, key, run, temp)
        job.release()
    if stage.apply is not None:
        stage.apply(job, folder)
    return folder


def reusable_result(stage: Stage, key: Key, job: Job, run: RunDir, *, resume: bool) -> Path | None:
    """The folder of a stage in the run where its key still holds; None, and a note why, where it has to be computed."""
    folder = run.finished_stage(stage.name, key, stage.files) if resume else None
    if folder is not None:
        job.progress.note(f"{stage.name}: used again, nothing that it depends on has changed")
        return folder
    why = run.recompute_reason(stage.name, key) if resume else "--no-resume"
    if why is not None:
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


def _has_tiles(job: Job) -> bool:
    return job.tiling is not None


def _is_solved_in_tiles(job: Job) -> bool:
    return _has_tiles(job) and _is_solved(job)


def _has_field(job: Job) -> bool:
    return job.plan.field in IN_LAYER


def _is_refined_in_one(job: Job) -> bool:
    return not _has_tiles(job) and (_is_solved(job) or _has_field(job))


# What decides the rays of the photographs, and the size and the pixels that are worked on.
_RAYS = ("photographs", "cameras", "water", "device")
_VIEWS = (*_RAYS, "size")

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
        name="tiles",
        needs=(),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "refined", "tiles"),
        files=(SHARED,),
        compute=find_shared,
        is_on=_has_tiles,
    ),
    Stage(
        name="sweep",
        needs=(),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "refined"),
        files=(MAPS, BOUND, SATURATED, CONSISTENCY),
        compute=sweep_views,
        in_tiles=InTiles(merge_sweeps, ("sweep",), sweep_tile, files=(MAPS, MASKS, SQUARES)),
    ),
    Stage(
        name="figures",
        needs=("sweep",),
        depends_on=(*_VIEWS, "gsd"),
        files=(FIGURES,),
        compute=solve_heights,
        is_on=_is_solved_in_tiles,
        in_tiles=InTiles(learn_figures, ("sweep",)),
    ),
    Stage(
        name="solver",
        needs=("sweep",),
        depends_on=(*_VIEWS, "gsd"),
        files=(SOLVED, SIGHTINGS),
        compute=solve_heights,
        is_on=_is_solved,
        in_tiles=InTiles(merge_solved, ("sweep", "solver"), solve_tile, ("sweep", "figures"), (SOLVED, SIGHTINGS)),
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
        is_on=_has_field,
    ),
    Stage(
        name="bed",
        needs=("adjust", "sweep", "solver", "field"),
        depends_on=(*_VIEWS, "water_settings", "priors", "area", "frame", "name", "gsd", "true_colour", "boxes"),
        files=FILES,
        compute=make_bed,
        in_tiles=InTiles(merge_points, ("bed",), find_points, ("sweep", "solver"), (POINTS,)),
    ),
)

# What the cloud would be of the sweep alone: a baseline for the report.
BED_OF_SWEEP = replace(
    STAGES[-1], name="bed_of_sweep", needs=("adjust", "sweep"), in_tiles=None, is_on=_is_refined_in_one
)
