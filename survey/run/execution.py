"""Execution of the stages of a run, here or, where it has several tiles, by worker processes.

These compute what is missing, and it is moved into the run folder.

A level that has changed by little since the bed was searched (read again, of another gauge, in another datum) needs no
new search, which takes most of a run. Where nothing else has changed, its results under the earlier plane are used
again, and the stage of the bed intersects the points anew along the rays of their photographs, bent at the plane that
is asked for (`survey.run.stage_bed.through_raised`); how near that is to a search under that plane is in
docs/decisions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from fields.models import IN_LAYER
from refract import FlatWater
from survey.display.quantities import length
from survey.files.json_values import read_json_object
from survey.plan.tile_choice import SHARED
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.keys import Key
from survey.run.pipeline import OF_SWEEP_ALONE, STAGES, Stage, commit_result, reusable_result, run_stage
from survey.run.remote_run import RemoteRun
from survey.run.start_workers import WorkerNeeds, workers_for
from survey.run.worker_task import Task, put_job, save_job
from survey.run.workers import Workers

if TYPE_CHECKING:
    from survey.run.tile_job import TileJob

# Under a level that is raised by more, photographs are matched elsewhere, and the search finds other points.
MOST_RAISED_M = 0.05
# Planes whose slopes differ by less are one, raised: local frames of two levels differ in the last digits.
_SAME_SLOPE = 1e-7


def run_stages(job: Job, run: RunDir, *, resume: bool, compares_sweep: bool) -> dict[str, Path]:
    """Run the stages of the job, tiles on workers where it has any; returns their folders by name.

    ``compares_sweep`` adds the cloud that the sweep alone would give.
    """
    done: dict[str, Path] = {}
    has_workers = job.plan.tiling is not None and (job.plan.workers > 1 or job.chosen.scheduler is not None)
    with ExitStack() as stack:
        workers: Workers | None = None
        for stage in [*STAGES, *OF_SWEEP_ALONE] if compares_sweep else STAGES:
            if not stage.is_on(job):
                continue
            if stage.name == "range" and resume and not compares_sweep:
                _search_under_earlier_level(job, run, stage)
            if stage.is_of_tiles and has_workers and (missing := _missing(stage, job, run, done, resume=resume)):
                workers = workers or stack.enter_context(_workers(job, run))
                done |= _computed(stage, job, run, missing, workers)
            for part in job.parts if stage.is_of_tiles else [job]:
                if (name := part.stage_name(stage.name)) not in done:
                    done[name] = run_stage(stage, part, run, done, resume=resume)
            if stage.joined is not None and stage.name not in done:
                done[stage.name] = run_stage(stage.joined, job, run, done, resume=resume)
    return done


def _missing(stage: Stage, job: Job, run: RunDir, done: dict[str, Path], *, resume: bool) -> list[tuple[Task, Key]]:
    """The tiles of a stage that are to be computed; folders of the others are added to what is done."""
    missing = []
    for tile in cast("Sequence[TileJob]", job.parts):
        name, needs = tile.stage_name(stage.name), stage.folders(tile, done)
        key = stage.key(tile, needs)
        folder = reusable_result(stage, key, tile, run, resume=resume)
        if folder is not None:
            done[name] = folder
            continue
        absolute = {of: place.absolute() for of, place in needs.items()}
        cost = sum(window.height * window.width for window in tile.windows)
        missing.append((Task(name, tile.number, stage.compute, absolute, cost), key))
    return missing


def _remote(job: Job, run: RunDir) -> RemoteRun | None:
    """The run where workers see it by its URL alone."""
    return run if isinstance(run, RemoteRun) and job.chosen.scheduler is not None else None


def _workers(job: Job, run: RunDir) -> AbstractContextManager[Workers]:
    number = (job.chosen.workers or 1) if job.chosen.scheduler is not None else job.plan.workers
    url = None if (remote := _remote(job, run)) is None else remote.remote.url
    needs = WorkerNeeds(run.stages_path, job.survey.views[0].path, takes_gpu=job.plan.device == "cuda", url=url)
    return workers_for(number, job.chosen.scheduler, needs, job.progress.note)


def _computed(
    stage: Stage, job: Job, run: RunDir, missing: Sequence[tuple[Task, Key]], workers: Workers
) -> dict[str, Path]:
    """Compute tiles of a stage on workers; the folders of the results by their names.

    Results are stored as tasks end; messages follow in the order of the tiles.
    """
    folders, messages, remote = dict[str, Path](), dict[int, list[tuple[str, str]]](), _remote(job, run)
    saved: Path | str
    if remote is None:
        saved = save_job(job, run.scratch_path, stage.name)
    else:
        saved = put_job(job, remote.remote, run.scratch_path, stage.name)
    with (
        job.progress.stage(stage.name.capitalize(), len(job.parts)) as step,
        closing(workers.computed(saved, [task for task, _ in missing])) as computed,
    ):
        step.advance(len(job.parts) - len(missing))
        for number, place, seconds, messages[number] in computed:
            task, key = missing[number]
            folder = Path(place) if remote is None else remote.fetched_stage(task.name, key, str(place))
            folders[task.name] = commit_result(stage, task.name, key, run, folder, seconds)
            step.advance()
    for number in sorted(messages):
        for kind, text in messages[number]:
            getattr(job.progress, kind)(text)
    return folders


def _search_under_earlier_level(job: Job, run: RunDir, search: Stage) -> None:
    """Let the job use what an earlier run has found under a plane of nearly the same level, if that is all there is.

    ``search`` is the first stage that depends on the level. A field and true colours are those of the level itself.
    """
    asked = job.survey
    water = asked.water
    if water is None or asked.observations.departure is not None:
        return
    if job.plan.field in IN_LAYER or job.chosen.true_colour:
        return
    if run.finished_stage(search.name, search.key(job, {}), search.files) is not None:
        return
    for path in run.stages_path.glob(f"{search.name}-*/{SHARED}"):
        record = read_json_object(path).get("water")
        plane = water if record is None else FlatWater(**record)
        slopes = abs(water.slope_x - plane.slope_x), abs(water.slope_y - plane.slope_y)
        raised = float(water.point[2] - plane.height(*water.point[:2]))
        is_raised = max(slopes) <= _SAME_SLOPE and water.n_water == plane.n_water and abs(raised) <= MOST_RAISED_M
        if record is None or not is_raised:
            continue
        job.use_survey(replace(asked, water=plane))
        if run.finished_stage(search.name, search.key(job, {}), search.files) is not None:
            job.asked = asked
            job.progress.note(
                f"the level is {length(abs(raised))} {'higher' if raised > 0.0 else 'lower'} than when the bed was "
                "searched: its points are intersected again along their rays; --no-resume searches again"
            )
            return
    job.use_survey(asked)
