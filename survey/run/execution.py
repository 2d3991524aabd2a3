"""Execution of the stages of a run, here or, where it has several tiles, by worker processes.

These compute what is missing, and it is moved into the run folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, cast

from survey.run.earlier_level import search_under_earlier_level
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.keys import Key
from survey.run.pipeline import OF_SWEEP_ALONE, STAGES, Stage, commit_result, reusable_result, run_stage
from survey.run.remote_run import RemoteRun
from survey.run.start_workers import WorkerNeeds, workers_for
from survey.run.task_at_url import put_job
from survey.run.worker_task import Task, save_job
from survey.run.workers import Workers
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.run.tile_job import TileJob


class TileWorkers:
    """Workers of the run of a whole survey, for its tiles. They end with the context.

    Those of this machine start beside what comes before the tiles, which takes some seconds, where a run begins; those
    of a run that goes on, or of a scheduler, when there is something to compute.
    """

    def __init__(self, job: Job, run: RunDir):
        self._job, self._run = job, run
        self._stack, self._messages_of_start = ExitStack(), list[str]()
        self._starter = ThreadPoolExecutor(1)
        self._starting: Future[Workers] | None = None
        code_hash()

    def __enter__(self) -> TileWorkers:
        # One waits a minute for a scheduler that does not answer.
        is_here = self._job.chosen.scheduler is None
        if is_here and not any(self._run.stages_path.glob("sweep_tile*")):
            self._starting = self._starter.submit(self._start)
        return self

    def __exit__(self, *_error: object) -> None:
        # On the thread that has started them: Dask's client is that of a context, which each thread has its own of.
        self._starter.submit(self._stack.close).result()
        self._starter.shutdown()

    def run(self, stage: Stage, done: Mapping[str, Path], *, resume: bool) -> dict[str, Path]:
        """Run a stage of all tiles; the folders of the results by their names.

        Results are stored as tasks end; messages follow in the order of the tiles.
        """
        folders, missing = dict[str, Path](), list[tuple[Task, Key]]()
        for tile in cast("Sequence[TileJob]", self._job.parts):
            name, needs = tile.stage_name(stage.name), stage.folders(tile, done)
            key = stage.key(tile, needs)
            folder = reusable_result(stage, key, tile, self._run, resume=resume)
            if folder is not None:
                folders[name] = folder
                continue
            absolute = {of: place.absolute() for of, place in needs.items()}
            cost = sum(window.height * window.width for window in tile.windows)
            missing.append((Task(name, tile.number, stage.compute, absolute, cost), key))
        if not missing:
            return folders
        workers, saved, messages = self._started(), self._saved(stage.name), dict[int, list[tuple[str, str]]]()
        with (
            self._job.progress.stage(stage.name.capitalize(), len(self._job.parts)) as step,
            closing(workers.computed(saved, [task for task, _ in missing])) as computed,
        ):
            step.advance(len(folders))
            for number, place, seconds, messages[number] in computed:
                task, key = missing[number]
                folder = self._fetched_result(task.name, key, place)
                folders[task.name] = commit_result(stage, task.name, key, self._run, folder, seconds)
                step.advance()
        for number in sorted(messages):
            for kind, text in messages[number]:
                getattr(self._job.progress, kind)(text)
        return folders

    @property
    def _remote(self) -> RemoteRun | None:
        """The run where workers see it by its URL alone."""
        return self._run if isinstance(self._run, RemoteRun) and self._job.chosen.scheduler is not None else None

    def _saved(self, stage: str) -> Path | str:
        if (run := self._remote) is not None:
            return put_job(self._job, run.remote, run.scratch_path, stage)
        return save_job(self._job, self._run.scratch_path, stage)

    def _fetched_result(self, name: str, key: Key, place: Path | str) -> Path:
        """The folder of a result here."""
        if (run := self._remote) is None:
            return Path(place)
        folder = run.open_stage(name)
        run.remote.fetch_folder(str(place), folder)
        run.results_of_workers[run.place(name, key).name] = str(place)
        return folder

    def _started(self) -> Workers:
        if self._starting is None:
            self._starting = self._starter.submit(self._start)
        if not self._starting.done():
            with self._job.progress.stage("Workers"):
                self._starting.result()
        workers = self._starting.result()
        while self._messages_of_start:
            self._job.progress.note(self._messages_of_start.pop(0))
        return workers

    def _start(self) -> Workers:
        chosen = self._job.chosen
        number = (chosen.workers or 1) if chosen.scheduler is not None else self._job.plan.workers
        needs = WorkerNeeds(
            self._run.stages_path,
            self._job.survey.views[0].path,
            takes_gpu=self._job.plan.device == "cuda",
            url=None if (run := self._remote) is None else run.remote.url,
        )
        return self._stack.enter_context(workers_for(number, chosen.scheduler, needs, self._messages_of_start.append))


def run_stages(job: Job, run: RunDir, *, resume: bool, compares_sweep: bool) -> dict[str, Path]:
    """Run the stages of the job, tiles on workers where it has any; returns their folders by name.

    ``compares_sweep`` adds the cloud that the sweep alone would give.
    """
    done: dict[str, Path] = {}
    has_workers = job.plan.tiling is not None and (job.plan.workers > 1 or job.chosen.scheduler is not None)
    with TileWorkers(job, run) if has_workers else nullcontext() as workers:
        for stage in [*STAGES, *OF_SWEEP_ALONE] if compares_sweep else STAGES:
            if not stage.is_on(job):
                continue
            if stage.name == "range" and resume and not compares_sweep:
                search_under_earlier_level(job, run, stage)
            if stage.is_of_tiles and workers is not None:
                done |= workers.run(stage, done, resume=resume)
            for part in job.parts if stage.is_of_tiles else [job]:
                if (name := part.stage_name(stage.name)) not in done:
                    done[name] = run_stage(stage, part, run, done, resume=resume)
            if stage.joined is not None and stage.name not in done:
                done[stage.name] = run_stage(stage.joined, job, run, done, resume=resume)
    return done
