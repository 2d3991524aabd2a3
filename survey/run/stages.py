"""The stages of a run, each as data (inputs, outputs, dependencies, function), in their order, and how they are run.

    pose_check or adjust -> range -> sweep -> figures -> solver -> water_colour -> field -> points -> bed

A survey is one tile or several: sweep, solver and points are computed for each tile, here or by worker processes, and
those of several are joined to what one leaves. The block is adjusted as a whole; the bound, the views with a height map
and what the solver has to know are found once for all tiles.

A level that has changed by little since the bed was searched (read again, of another gauge, in another datum) needs no
new search, which takes most of a run. Where nothing else has changed, its results under the earlier plane are used
again, and the stage of the bed intersects the points anew along the rays of their photographs, bent at the plane that
is asked for (`survey.run.points.through_raised`); how near that is to a search under it is in docs/decisions.md. Where
poses are adjusted, that is done again with the windows of before, and the rays are those of the poses found now.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from fields.models import IN_LAYER
from survey.adjust.applied import apply_adjustment
from survey.adjust.block.state import NUM_WATER, settings_of
from survey.adjust.result.adjustment import Adjustment, read_adjustment
from survey.display.quantities import length
from survey.files.json_values import read_json_object
from survey.folder.local_frame import water_plane
from survey.folder.survey import Survey
from survey.plan.tiling import SHARED
from survey.run import stage_bed, stage_solver, stage_start, stage_sweep
from survey.run.folder import Key, RunDir
from survey.run.job import PARTS, Job, colour_of
from survey.run.remote_run import RemoteRun
from survey.run.stored import FIELD_FILES
from survey.run.tile_job import TileJob
from survey.run.worker_task import Messages, Task, save_job
from survey.run.workers import WorkerNeeds, Workers, workers_for

# Under a level that is raised by more, photographs are matched elsewhere, and the search finds other points.
MOST_RAISED_M = 0.05
# Of differences between levels.
_ROUNDING_M = 1e-6
# Parts of the key of an adjustment that change with the level.
_BY_LEVEL = ("water", "water_settings", "heights")


@dataclass(frozen=True)
class Stage:
    """Step from photographs to points, whose result is kept in the run folder."""

    name: str
    needs: tuple[str, ...]  # Stages whose results it reads; those that a run leaves out are left out here too
    depends_on: tuple[str, ...]  # Parts of the job that decide its result: `survey.run.job.PARTS`
    files: tuple[str, ...]  # Files in its folder
    # callable: gets the job, the folder to write to, and the folders of the stages that it needs, by name
    compute: Callable[[Job, Path, Mapping[str, Path]], None]
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
        """Dependencies of the result, given the folders of the stages that it reads, whose names end in their keys."""
        parts = {name: job.hash_of_part(name) for name in (*self.depends_on, "code")}
        return parts | {name: place.name for name, place in folders.items()}


def _train_field(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    # Imported where it is needed: it takes torch, whose import takes seconds.
    from survey.run.trained_field import train_field

    train_field(job, folder, needs)


# What decides the rays of the photographs, and the size and the pixels that are worked on.
_VIEWS = ("photographs", "cameras", "water", "device", "size")
_SOLVED = (stage_solver.SOLVED, stage_solver.SIGHTINGS, stage_solver.WAVES)

STAGES = (
    Stage(
        name="pose_check",
        needs=(),
        depends_on=(*_VIEWS, "frame", "area", "heights"),
        files=(stage_start.MISFIT,),
        compute=stage_start.check_poses,
        is_on=lambda job: job.plan.pose_choice == "check",
        apply=stage_start.use_misfit,
    ),
    Stage(
        name="adjust",
        needs=(),
        depends_on=(*_VIEWS, "frame", "water_settings", "area", "heights", "ties", "priors", "control", "freed"),
        files=stage_start.FILES,
        compute=stage_start.adjust_block,
        is_on=lambda job: job.plan.pose_choice == "refine",
        apply=stage_start.use_adjustment,
    ),
    Stage(
        name="range",
        needs=(),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "tiles"),
        files=(SHARED,),
        compute=stage_start.find_range,
        apply=stage_start.use_range,
    ),
    Stage(
        name="sweep",
        needs=("range",),
        depends_on=(*_VIEWS, "heights", "area", "gsd", "refined"),
        files=stage_sweep.FILES,
        compute=stage_sweep.sweep_views,
        is_of_tiles=True,
        joined=Stage(
            "sweep",
            ("sweep",),
            _VIEWS,
            (stage_sweep.MAPS, stage_sweep.SATURATED, stage_sweep.CONSISTENCY),
            stage_sweep.join_sweeps,
        ),
    ),
    Stage(
        name="figures",
        needs=("sweep",),
        depends_on=(*_VIEWS, "gsd"),
        files=(stage_solver.FIGURES,),
        compute=stage_solver.learn_figures,
        is_on=lambda job: job.plan.solves,
    ),
    Stage(
        name="solver",
        needs=("sweep", "figures"),
        depends_on=(*_VIEWS, "gsd"),
        files=_SOLVED,
        compute=stage_solver.solve_heights,
        is_on=lambda job: job.plan.solves,
        is_of_tiles=True,
        joined=Stage("solver", ("sweep", "solver"), _VIEWS, _SOLVED, stage_solver.join_solved),
    ),
    Stage(
        name="water_colour",
        needs=("sweep",),
        depends_on=_VIEWS,
        files=(stage_sweep.COLOUR_FILE,),
        compute=stage_sweep.estimate_colour,
        is_on=lambda job: job.chosen.true_colour and colour_of(job.survey)[0] is None,
        apply=stage_sweep.use_colour,
    ),
    Stage(
        name="field",
        needs=("sweep", "solver"),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "rays", "water_colour"),
        files=FIELD_FILES,
        compute=_train_field,
        is_on=lambda job: job.plan.field in IN_LAYER,
    ),
    Stage(
        name="points",
        needs=("sweep", "solver"),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "true_colour", "boxes"),
        files=(stage_bed.POINTS,),
        compute=stage_bed.find_points,
        is_of_tiles=True,
    ),
    Stage(
        name="bed",
        needs=("adjust", "points", "solver"),
        depends_on=(*_VIEWS, "water_settings", "priors", "frame", "name", "gsd"),
        files=stage_bed.FILES,
        compute=stage_bed.make_bed,
        apply=stage_bed.use_bed,
    ),
)


@dataclass(frozen=True)
class Missing:
    """A stage of the survey or of a tile that is to be computed."""

    job: Job
    name: str
    needs: Mapping[str, Path]
    key: Key


def run_stages(job: Job, run: RunDir, *, resume: bool) -> dict[str, Path]:
    """Run the stages of the job, tiles on workers where it has any; returns their folders by name."""
    done: dict[str, Path] = {}
    has_workers = job.plan.tiling is not None and (job.plan.workers > 1 or job.chosen.scheduler is not None)
    with ExitStack() as stack:
        workers: Workers | None = None
        for stage in STAGES:
            if not stage.is_on(job):
                continue
            if stage.name == "adjust" and resume:
                job.adjusted_before = _adjusted_before(job, run, stage)
            if stage.name == "range" and resume:
                _use_of_earlier_level(job, run, stage, done)
            missing = _missing(stage, job.parts if stage.is_of_tiles else [job], run, done, resume=resume)
            if missing and stage.is_of_tiles and has_workers:
                workers = workers or stack.enter_context(_workers(job, run))
                _compute_on(workers, stage, job, run, missing, done)
            else:
                _compute_here(stage, run, missing, done)
            if stage.joined is not None and stage.name not in done:
                _compute_here(stage.joined, run, _missing(stage.joined, [job], run, done, resume=resume), done)
            if stage.apply is not None:
                stage.apply(job, done[stage.name])
    return done


def _missing(stage: Stage, jobs: Sequence[Job], run: RunDir, done: dict[str, Path], *, resume: bool) -> list[Missing]:
    """What is to be computed of a stage; the folders of what the run has already are added to what is done."""
    missing = []
    for part in jobs:
        name, needs = part.stage_name(stage.name), stage.folders(part, done)
        key = stage.key(part, needs)
        folder = run.finished_stage(name, key, stage.files) if resume else None
        if folder is not None:
            done[name] = folder
            part.progress.detail(f"{name}: used again, nothing that it depends on has changed")
            continue
        why = recompute_reason(run, name, key) if resume else "--no-resume"
        if why is not None:
            part.progress.detail(f"{name}: computed again: {why}")
        missing.append(Missing(part, name, needs, key))
    return missing


def recompute_reason(run: RunDir, name: str, key: Key) -> str | None:
    """Why a stage is computed again, in words: what differs from the earlier key that has most in common."""
    changed = [
        [part for part in {**key, **other} if key.get(part) != other.get(part)] for other in run.earlier_keys(name)
    ]
    if not changed:
        return None
    names = min(changed, key=len)
    if not names:
        return "its earlier result is not whole"
    words = [PARTS[part][0] if part in PARTS else f"the result of the stage {part}" for part in names]
    return f"{' and '.join([', '.join(words[:-1]), words[-1]] if len(words) > 1 else words)} changed"


def _compute_here(stage: Stage, run: RunDir, missing: Sequence[Missing], done: dict[str, Path]) -> None:
    for each in missing:
        temp = run.open_stage(each.name)
        stage.compute(each.job, temp, each.needs)
        done[each.name] = _committed(stage, each, run, temp)
        each.job.release()


def _committed(stage: Stage, each: Missing, run: RunDir, temp: Path, seconds: float | None = None) -> Path:
    """The place in the run of what a stage has left in a folder; ``seconds`` where a worker made it."""
    lacking = [name for name in stage.files if not (temp / name).is_file()]
    if lacking:
        raise RuntimeError(f"the stage {each.name} left no {', '.join(lacking)}")
    return run.finish_stage(each.name, each.key, temp, seconds)


def _remote(job: Job, run: RunDir) -> RemoteRun | None:
    """The run where workers see it by its URL alone."""
    return run if isinstance(run, RemoteRun) and job.chosen.scheduler is not None else None


def _workers(job: Job, run: RunDir):
    number = (job.chosen.workers or 1) if job.chosen.scheduler is not None else job.plan.workers
    url = None if (remote := _remote(job, run)) is None else remote.remote.url
    needs = WorkerNeeds(run.stages_path, job.survey.views[0].path, takes_gpu=job.plan.device == "cuda", url=url)
    return workers_for(number, job.chosen.scheduler, needs, job.progress.note)


def _compute_on(
    workers: Workers, stage: Stage, job: Job, run: RunDir, missing: Sequence[Missing], done: dict[str, Path]
) -> None:
    """Compute tiles of a stage on workers; results are stored as tasks end, messages follow in the order of tiles."""
    messages, remote, tasks = dict[int, Messages](), _remote(job, run), []
    for each in missing:
        tile, needs = cast(TileJob, each.job), {name: place.absolute() for name, place in each.needs.items()}
        cost = sum(window.height * window.width for window in tile.windows)
        tasks.append(Task(each.name, tile.number, stage.compute, needs, cost))
    saved = save_job(job, run.scratch_path, stage.name, None if remote is None else remote.remote)
    with (
        job.progress.stage(stage.name.capitalize(), len(job.parts)) as step,
        closing(workers.computed(saved, tasks)) as computed,
    ):
        step.advance(len(job.parts) - len(missing))
        for number, place, seconds, messages[number] in computed:
            each = missing[number]
            folder = Path(place) if remote is None else remote.fetched_stage(each.name, each.key, place)
            done[each.name] = _committed(stage, each, run, folder, seconds)
            step.advance()
    for number in sorted(messages):
        for kind, text in messages[number]:
            getattr(job.progress, kind)(text)


def _use_of_earlier_level(job: Job, run: RunDir, search: Stage, done: dict[str, Path]) -> None:
    """Let the job use what an earlier run has found with nearly the same level, if that is all that has changed."""
    asked = job.survey
    if (
        asked.water is None
        or asked.observations.departure is not None
        or job.plan.field in IN_LAYER
        or job.chosen.true_colour
        or run.finished_stage(search.name, search.key(job, {}), search.files) is not None
    ):
        return
    of_job = _adjusted_at_levels(job, done["adjust"]) if "adjust" in done else _at_levels(asked, run, search)
    for earlier, raised, adjusted in of_job:
        job.use_survey(earlier)
        if run.finished_stage(search.name, search.key(job, {}), search.files) is not None:
            # A level after this one begins with it, too.
            done |= {} if adjusted is None else {"adjust_before": adjusted}
            job.asked = asked
            job.progress.note(
                f"the level is {length(abs(raised))} {'higher' if raised > 0.0 else 'lower'} than when the bed was "
                "searched: its points are intersected again along their rays; --no-resume searches again"
            )
            return
    job.use_survey(asked)


def _at_levels(asked: Survey, run: RunDir, search: Stage) -> Iterator[tuple[Survey, float, None]]:
    """The survey with earlier given levels that are a little off, and by how much it is higher [m]."""
    _, water = asked.require_water()
    for path in run.stages_path.glob(f"{search.name}-*/{SHARED}"):
        level_m = read_json_object(path).get("level_m")
        if level_m is not None and abs(water.known_level_m - level_m) <= MOST_RAISED_M + _ROUNDING_M:
            plane = water_plane(asked.frame, replace(water, level_m=level_m))
            yield replace(asked, water=plane), water.known_level_m - level_m, None


def _adjusted_at_levels(job: Job, adjusted: Path) -> Iterator[tuple[Survey, float, Path]]:
    """The survey by earlier adjustments of a level and poses a little off, how much higher it is [m], their folders."""
    asked, now = job.survey, read_adjustment(adjusted)
    for folder in job.adjusted_before:
        found = read_adjustment(folder)
        raised = _raised_by(found, np.array([row.given for row in now.parameters[:NUM_WATER]]))
        if not raised or found.poses.names != now.poses.names:
            continue
        if np.abs(found.poses.centres - now.poses.centres).max() <= MOST_RAISED_M:
            yield apply_adjustment(asked, found), raised, folder


def _raised_by(found: Adjustment, settings: np.ndarray) -> float | None:
    """How much higher [m] water by settings (4,) is than was given to an adjustment; None where by too much."""
    if found.water is None:
        return None
    raised, *others = (settings - [row.given for row in found.parameters[:NUM_WATER]]).tolist()
    return raised if abs(raised) <= MOST_RAISED_M + _ROUNDING_M and not any(others) else None


def _adjusted_before(job: Job, run: RunDir, stage: Stage) -> list[Path]:
    """Earlier adjustments that differ from that of a job by nearly the same level alone."""
    key, water = stage.key(job, {}), job.survey.config.water
    if water is None:
        return []
    alike = [
        run.place(stage.name, parts)
        for parts in run.earlier_keys(stage.name)
        if all(parts.get(name) == value for name, value in key.items() if name not in _BY_LEVEL)
    ]
    return [folder for folder in alike if _raised_by(read_adjustment(folder), settings_of(water)) is not None]
