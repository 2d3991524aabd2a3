"""Execution of the stages of a run: in one piece, in rounds where it has an aim, or in tiles.

In tiles:

    pose_check, adjust -> tiles -> sweep of each tile -> sweep -> figures -> solver of each tile -> solver
    -> water_colour -> bed of each tile -> bed

The block is adjusted as a whole; the bound, the views with a height map and the figures of the solver are found once
for all tiles. What tiles find is put together in the form that a run in one piece leaves: all that follows is the same.
Worker processes compute what is missing, and it is moved into the run folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING

from survey.plan.rates import part_name
from survey.plan.tile_choice import SHARED
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.merged import merge_points, merge_solved, merge_sweeps
from survey.run.pipeline import ASSESSMENT, BED_OF_SWEEP, STAGES, Stage, commit_result, reusable_result, run_stage
from survey.run.remote_run import RemoteRun
from survey.run.stage_of_tile import FIGURES, POINTS, SQUARES, find_points, learn_figures, solve_tile, sweep_tile
from survey.run.stage_sweep import EARLIER_ASSESSMENT, EARLIER_SOLVER, EARLIER_SWEEP, MAPS
from survey.run.stage_tiles import find_shared, read_shared
from survey.run.start_workers import WorkerNeeds, workers_for
from survey.run.task_at_url import put_job
from survey.run.tile_job import MASKS, TileJob
from survey.run.worker_task import Task, save_job
from survey.run.workers import Workers
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.run.keys import Key
    from survey.run.tile_job import TilePlan

# Gets the job, the folder to write to, the tiles, the folders of their stages by name, and those of other stages.
Merge = Callable[[Job, Path, Sequence[TileJob], Mapping[str, list[Path]], Mapping[str, Path]], None]

_STAGE_BY_NAME = {stage.name: stage for stage in STAGES}
_TILES = Stage("tiles", (), (*_STAGE_BY_NAME["sweep"].depends_on, "tiles"), (SHARED,), find_shared)
# Of one tile, by the name of what they are a part of.
_SWEEP = replace(_STAGE_BY_NAME["sweep"], needs=(), files=(MAPS, MASKS, SQUARES), compute=sweep_tile, apply=None)
_SOLVER = replace(_STAGE_BY_NAME["solver"], needs=("sweep", "figures"), compute=solve_tile)
_BED = replace(_STAGE_BY_NAME["bed"], needs=("sweep", "solver"), files=(POINTS,), compute=find_points)
# Of a round, and the names under which the next one finds them.
_EARLIER = {"sweep": EARLIER_SWEEP, "solver": EARLIER_SOLVER, ASSESSMENT: EARLIER_ASSESSMENT}


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
        if is_here and not any(self._run.stages_path.glob(f"{_SWEEP.name}_tile*")):
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
        title = stage.name.capitalize()
        names = [part_name(title, tile.number, len(parts)) for _, tile in parts]
        title = f"{title} of {len(missing)} tiles"
        if (forecast := self._job.progress.forecast) is not None:
            forecast.join(names, title, len(missing) / len(parts))
        computed, messages = self._compute(workers, saved, missing, title)
        self._report(messages)
        return reused | computed

    def _reused_and_missing(
        self, parts: Sequence[tuple[Stage, TileJob]], done: Mapping[str, Path], *, resume: bool
    ) -> tuple[dict[str, Path], list[_MissingResult]]:
        """Folders of results that the run has, by the name of their stage, and the results that it lacks."""
        reused: dict[str, Path] = {}
        missing = []
        for stage, tile in parts:
            if not stage.is_on(tile):
                continue
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
        self, workers: Workers, saved: Path | str, missing: Sequence[_MissingResult], title: str
    ) -> tuple[dict[str, Path], dict[int, list[tuple[str, str]]]]:
        """Folders of the results by the name of their stage, and messages by the number of the task."""
        folders: dict[str, Path] = {}
        messages: dict[int, list[tuple[str, str]]] = {}
        with (
            self._job.progress.stage(title, len(missing)) as step,
            closing(workers.computed(saved, [each.task for each in missing])) as computed,
        ):
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
    def started(self) -> Workers | None:
        """The workers that reach the run folder, where they were started and are still there."""
        if self._starting is None or self._remote is not None or not self._starting.done():
            return None
        return None if self._starting.exception() is not None else self._starting.result()

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
        number = 1 if tiles is None else tiles.workers
        number = (chosen.workers or 1) if chosen.scheduler is not None else number
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
    if job.tiling is None or job.tiles is None or (job.tiles.workers < 2 and job.chosen.scheduler is None):
        yield None
        return
    with TileWorkers(job, run) as workers:
        yield workers


def run_tiled(job: Job, run: RunDir, workers: TileWorkers | None, *, resume: bool) -> dict[str, Path]:
    """Run the stages of a job with a tiling; the folders of the stages by name."""
    if job.tiling is None or job.tiles is None:
        raise ValueError("expected a job with tiles")
    done: dict[str, Path] = {}
    tiles: list[TileJob] = []

    def step(stage: Stage, of: Job = job) -> None:
        if stage.is_on(of):
            done[stage.name] = run_stage(stage, of, run, done, resume=resume)

    def step_of_tiles(stage: Stage) -> None:
        if workers is not None:
            parts = [(_of_tile(stage, tile), tile) for tile in tiles]
            done.update(workers.run(stage, parts, done, shared, resume=resume))
            return
        for tile in tiles:
            step(_of_tile(stage, tile), tile)
            tile.drop()

    for stage in STAGES:
        if stage.name == "sweep":
            step(_TILES)
            shared = read_shared(done["tiles"])
            tiles += [TileJob(job, number, shared) for number in range(len(job.tiling))]
            # To find them takes workers as long as this process.
            shared = replace(shared, windows=tuple(tile.windows for tile in tiles))
            step_of_tiles(_SWEEP)
            step(_over(stage, merge_sweeps, tiles, ("sweep",)))
        elif stage.name == "solver" and stage.is_on(job):
            step(_over(replace(stage, name="figures", files=(FIGURES,)), learn_figures, tiles, ("sweep",)))
            step_of_tiles(_SOLVER)
            step(_over(stage, merge_solved, tiles, ("sweep", "solver")))
        elif stage.name == "bed":
            step_of_tiles(_BED)
            step(_over(stage, merge_points, tiles, ("bed",)))
        elif stage.name != "solver":
            step(stage)
    return done


def _name(stage: str, tile: TileJob) -> str:
    return f"{stage}_tile{tile.number + 1}"


def _of_tile(stage: Stage, tile: TileJob) -> Stage:
    """The stage of one tile, which needs those of the same tile and what all share."""
    own = {_name(name, tile): name for name in stage.needs if name in ("sweep", "solver")}
    shared = tuple(name for name in stage.needs if name not in own.values())

    @wraps(stage.compute)
    def compute(of: Job, folder: Path, needs: Mapping[str, Path]) -> None:
        stage.compute(of, folder, {own.get(name, name): place for name, place in needs.items()})

    return replace(stage, name=_name(stage.name, tile), needs=(*own, *shared), compute=compute)


def _over(stage: Stage, merge: Merge, tiles: Sequence[TileJob], of_tiles: tuple[str, ...]) -> Stage:
    """A stage of the whole survey that puts stages of tiles together."""
    names = {name: [_name(name, tile) for tile in tiles] for name in of_tiles}
    own = tuple(each for of_name in names.values() for each in of_name)

    @wraps(merge)
    def compute(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
        found = {name: [needs[each] for each in of_name] for name, of_name in names.items()}
        merge(job, folder, tiles, found, {name: place for name, place in needs.items() if name not in own})

    shared = ("adjust",) if "adjust" in stage.needs else ()
    return replace(stage, needs=(*own, *shared), compute=compute)


def run_stages(
    job: Job, run: RunDir, workers: TileWorkers | None = None, *, resume: bool, compares_sweep: bool
) -> dict[str, Path]:
    """Run the stages of the job, tiles on ``workers`` where there are any; returns their folders by name.

    ``compares_sweep`` adds the cloud that the sweep alone would give, where the run is in one piece.
    """
    if job.tiling is not None:
        return run_tiled(job, run, workers, resume=resume)
    done: dict[str, Path] = {}
    stages: Sequence[Stage] = [*STAGES, BED_OF_SWEEP] if compares_sweep else STAGES
    of_round = [stage for stage in stages if stage.name in _EARLIER]
    for stage in stages:
        if stage.name == "sweep":
            _begin_first_round(job)
        if stage.is_on(job):
            done[stage.name] = run_stage(stage, job, run, done, resume=resume)
        number = 1
        while stage.name == ASSESSMENT and job.aimed is not None and job.aimed.following is not None:
            done = _after_round(done, number)
            for repeated in of_round:
                if repeated.is_on(job):
                    done[repeated.name] = run_stage(repeated, job, run, done, resume=resume, explains=False)
            number += 1
    return done


def _begin_first_round(job: Job) -> None:
    """Set the recipe of the first round."""
    if job.aimed is not None:
        job.aimed.has_begun = True
        job.plan_again()


def _after_round(done: Mapping[str, Path], number: int) -> dict[str, Path]:
    """The folders of stages with those of a round renamed: as the next round and the record of the run name them."""
    renamed = dict(done)
    for name, earlier in _EARLIER.items():
        if earlier in renamed:
            renamed[f"{name} of round {number - 1}"] = renamed.pop(earlier)
        if name in renamed:
            renamed[earlier] = renamed.pop(name)
    return renamed
