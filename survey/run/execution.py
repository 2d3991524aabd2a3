"""Execution of the stages of a run: of the whole survey, or of its tiles, whose results are then put together.

    pose_check, adjust -> tiles -> sweep of each tile -> sweep -> figures -> solver of each tile -> solver
    -> water_colour -> bed of each tile -> bed

The block is adjusted as a whole; the bound, the views with a height map and the figures of the solver are found once
for all tiles. Worker processes compute what is missing, and it is moved into the run folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.pipeline import BED_OF_SWEEP, STAGES, Stage, commit_result, reusable_result, run_stage
from survey.run.remote_run import RemoteRun
from survey.run.stage_tiles import tiles_of
from survey.run.start_workers import WorkerNeeds, workers_for
from survey.run.task_at_url import put_job
from survey.run.worker_task import Task, save_job
from survey.run.workers import Workers
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.run.keys import Key
    from survey.run.tile_job import TileJob, TilePlan


@dataclass(frozen=True)
class _MissingResult:
    """Result of a stage of a tile that the run lacks, with the task that computes it."""

    stage: Stage
    key: Key
    task: Task


class TileWorkers:
    """Workers of a run, for its tiles and its report. They end with the context.

    Those of this machine start beside what comes before the tiles, which takes some seconds, where a run begins; those
    of a run that goes on, or of a scheduler, when there is something to compute.

    Parameters
    ----------
    job : Job
        Of the whole survey.
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

    def run(
        self,
        stage: Stage,
        parts: Sequence[tuple[Stage, TileJob]],
        done: Mapping[str, Path],
        shared: TilePlan,
        *,
        resume: bool,
    ) -> dict[str, Path]:
        """Run the stages of tiles that a stage of the survey consists of; their folders by name.

        Results are stored as tasks end; messages follow in the order of the tiles.
        """
        reused, missing = self._reused_and_missing(parts, done, resume=resume)
        if not missing:
            return reused
        workers = self._started()
        saved = self._saved(shared, stage.name)
        computed, messages = self._compute(workers, saved, missing, stage.name.capitalize(), len(reused))
        self._report(messages)
        return reused | computed

    def _reused_and_missing(
        self, parts: Sequence[tuple[Stage, TileJob]], done: Mapping[str, Path], *, resume: bool
    ) -> tuple[dict[str, Path], list[_MissingResult]]:
        """Folders of results that the run has, by the name of their stage, and the results that it lacks."""
        reused: dict[str, Path] = {}
        missing = []
        for stage, tile in parts:
            key = stage.key(tile, done)
            folder = reusable_result(stage, key, tile, self._run, resume=resume)
            if folder is not None:
                reused[stage.name] = folder
                continue
            needs = {name: done[name].absolute() for name in stage.needs if name in done}
            cost = sum(window.height * window.width for window in tile.windows)
            missing.append(_MissingResult(stage, key, Task(stage.name, tile.number, stage.compute, needs, cost)))
        return reused, missing

    def _compute(
        self, workers: Workers, saved: Path | str, missing: Sequence[_MissingResult], title: str, num_reused: int
    ) -> tuple[dict[str, Path], dict[int, list[tuple[str, str]]]]:
        """Folders of the results by the name of their stage, and messages by the number of the task."""
        folders: dict[str, Path] = {}
        messages: dict[int, list[tuple[str, str]]] = {}
        with (
            self._job.progress.stage(title, num_reused + len(missing)) as step,
            closing(workers.computed(saved, [each.task for each in missing])) as computed,
        ):
            step.advance(num_reused)
            for number, place, seconds, lines in computed:
                stage, key = missing[number].stage, missing[number].key
                folder = self._fetched_result(stage, key, place)
                folders[stage.name] = commit_result(stage, key, self._run, folder, seconds)
                messages[number] = lines
                step.advance()
        return folders, messages

    def _report(self, messages: Mapping[int, Sequence[tuple[str, str]]]) -> None:
        """Repeat the messages of tasks, kind and text, in the order of the tasks."""
        for number in sorted(messages):
            for kind, text in messages[number]:
                getattr(self._job.progress, kind)(text)

    @property
    def _remote(self) -> RemoteRun | None:
        """The run where workers see it by its URL alone."""
        return self._run if isinstance(self._run, RemoteRun) and self._job.chosen.scheduler is not None else None

    def _saved(self, shared: TilePlan, stage: str) -> Path | str:
        if (run := self._remote) is not None:
            return put_job(self._job, shared, run.remote, run.scratch_path, stage)
        return save_job(self._job, shared, self._run.scratch_path, stage)

    def _fetched_result(self, stage: Stage, key: Key, place: Path | str) -> Path:
        """The folder of a result here."""
        if (run := self._remote) is None:
            return Path(place)
        folder = run.open_stage(stage.name)
        run.remote.fetch_folder(str(place), folder)
        run.results_of_workers[run.place(stage.name, key).name] = str(place)
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
        chosen, tiles = self._job.chosen, self._job.tiles
        number = (chosen.workers or 1) if chosen.scheduler is not None else tiles.workers
        needs = WorkerNeeds(
            self._run.stages_path,
            self._job.survey.views[0].path,
            takes_gpu=self._job.plan.device == "cuda",
            url=None if (run := self._remote) is None else run.remote.url,
        )
        return self._stack.enter_context(workers_for(number, chosen.scheduler, needs, self._messages_of_start.append))


@contextmanager
def workers_of(job: Job, run: RunDir) -> Iterator[TileWorkers | None]:
    """Workers of a run; None where its own process computes all."""
    if job.tiling is None or (job.tiles.workers < 2 and job.chosen.scheduler is None):
        yield None
        return
    with TileWorkers(job, run) as workers:
        yield workers


def run_stages(
    job: Job, run: RunDir, workers: TileWorkers | None = None, *, resume: bool, compares_sweep: bool
) -> dict[str, Path]:
    """Run the stages of the job, tiles on ``workers`` where there are any; returns their folders by name.

    ``compares_sweep`` adds the cloud that the sweep alone would give, where the run is in one piece.
    """
    done: dict[str, Path] = {}
    tiles: list[TileJob] = []
    shared: TilePlan | None = None
    for stage in [*STAGES, BED_OF_SWEEP] if compares_sweep else STAGES:
        if not stage.is_on(job):
            continue
        parts = [(of_tile, tile) for tile in tiles if (of_tile := stage.of_tile(tile)) is not None]
        if parts and workers is not None and shared is not None:
            done.update(workers.run(stage, parts, done, shared, resume=resume))
        else:
            for of_tile, tile in parts:
                done[of_tile.name] = run_stage(of_tile, tile, run, done, resume=resume)
                tile.drop()
        done[stage.name] = run_stage(stage.over(tiles), job, run, done, resume=resume)
        if stage.name == "tiles":
            tiles, shared = tiles_of(job, done["tiles"])
    return done
