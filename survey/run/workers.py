"""Worker processes that compute stages of tiles: on this machine, or on a cluster that stands, by Dask distributed.

A task is one stage of one tile. A worker reads what it needs from the run folder, which all workers reach by the same
path, and leaves its result whole in a folder of its own there; the process of the run gives it its place. So a task
may be computed twice, and a worker may end at any time.
"""

from __future__ import annotations

import os
import pickle
import shutil
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from geo.files import disk_refusals, write_whole
from survey.code_hash import code_hash
from survey.errors import SurveyError

if TYPE_CHECKING:
    from survey.run.job import Job
    from survey.run.tile_job import TileJob, TilePlan

# A task whose workers end so often is given up: most likely it takes more memory than there is.
_MOST_ENDED = 3
# How long workers of a cluster may take to come [s].
_PATIENCE_S = 60.0
# How often is looked whether any is left [s].
_LOOK_EVERY_S = 5.0


@dataclass(frozen=True)
class Task:
    """One stage of one tile.

    Attributes
    ----------
    name : str
        Of the stage.
    tile : int
    compute : callable
        `survey.run.stage.Stage.compute`, of a module.
    needs : mapping
        Folders of the stages that it needs, by the names that ``compute`` knows.
    """

    name: str
    tile: int
    compute: Callable[[Job, Path, Mapping[str, Path]], None]
    needs: Mapping[str, Path]


class Workers:
    """Workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
    folder : Path
        Of the stages of the run.
    """

    def __init__(self, client: Any, folder: Path):
        self._client, self._folder = client, folder.absolute()

    def computed(self, job: Path, tasks: Sequence[Task]) -> Iterator[tuple[int, Path, float, list[tuple[str, str]]]]:
        """Compute tasks; as each ends its number, the folder of its result, its seconds, and what it had to say.

        Raises
        ------
        SurveyError
            If the workers of a task end again and again.
        """
        from distributed import KilledWorker

        futures = {
            self._client.submit(_compute, job, self._folder, task, pure=False, key=f"{task.name}-{uuid.uuid4().hex}"): n
            for n, task in enumerate(tasks)
        }
        for future in self._as_they_end(futures):
            try:
                folder, seconds, said = future.result()
            except KilledWorker as error:
                raise SurveyError(
                    f"{tasks[futures[future]].name}: {_MOST_ENDED + 1} workers that computed it were ended by the "
                    "system, most likely for want of memory; what other tiles have is kept: give the same command "
                    "with fewer --workers, or more --tiles"
                ) from error
            yield futures[future], folder, seconds, said

    def _as_they_end(self, futures: Collection[Any]) -> Iterator[Any]:
        """The futures, as they end; raise where no worker is left to end one."""
        from distributed import wait

        left, last_seen = set(futures), time.monotonic()
        while left:
            with suppress(TimeoutError):
                ended = wait(left, timeout=_LOOK_EVERY_S, return_when="FIRST_COMPLETED").done
                left -= ended
                yield from ended
            if self._client.scheduler_info()["workers"]:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > _PATIENCE_S:
                raise SurveyError(
                    f"no worker is left, and none came back within {_PATIENCE_S:.0f} s; {len(left)} of {len(futures)} "
                    "tiles are missing: give the same command again, it goes on with what is finished"
                )


@contextmanager
def workers_for(number: int, scheduler: str | None, stages: Path, note: Callable[[str], None]) -> Iterator[Workers]:
    """So many workers of this machine, or all of a scheduler that has so many, for the stages in a folder of a run.

    Raises
    ------
    SurveyError
        If Dask is not installed, no worker comes, one has another version of the program or does not see the folder.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise SurveyError(
            "--workers and --scheduler take Dask, which is not installed: pip install 'bathynerf[cluster]'"
        ) from error
    import dask

    of_dask = {
        "distributed.scheduler.allowed-failures": _MOST_ENDED,
        # Workers have cores of their own, and as many threads as these.
        "distributed.nanny.pre-spawn-environ": {},
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        "distributed.admin.tick.limit": "1h",
        "logging.distributed": "error",
    }
    with dask.config.set(of_dask):
        cluster: Any = nullcontext(scheduler)
        if scheduler is None:
            cluster = distributed.LocalCluster(
                n_workers=number,
                threads_per_worker=1,
                processes=True,
                memory_limit=0,
                dashboard_address=None,
                silence_logs="ERROR",
            )
        with cluster as place, _client_of(distributed, place, scheduler, number) as client:
            if scheduler is None:
                client.register_plugin(_cores_plugin(distributed, number))
            else:
                note(
                    f"workers: {client.scheduler_info()['n_workers']} of {scheduler}, to be watched at "
                    f"{client.dashboard_link}"
                )
            _check(client, stages)
            yield Workers(client, stages)


def _client_of(distributed: Any, place: Any, scheduler: str | None, number: int) -> Any:
    try:
        client = distributed.Client(place, timeout=_PATIENCE_S)
        client.wait_for_workers(number, timeout=_PATIENCE_S)
    except (OSError, TimeoutError, ValueError) as error:
        which = "this machine" if scheduler is None else f"--scheduler {scheduler}"
        raise SurveyError(
            f"{which} gave no {number} workers within {_PATIENCE_S:.0f} s ({error}); start them, or leave the option "
            "out"
        ) from error
    return client


def _check(client: Any, stages: Path) -> None:
    """Raise where a worker has another program or does not see the run."""
    with _token(stages) as token:
        found = client.run(_seen, token)
    for place, (code, sees) in found.items():
        if code != _code():
            raise SurveyError(f"the worker {place} has another version of bathynerf; install the same on all")
        if not sees:
            raise SurveyError(
                f"the worker {place} does not see {stages}; name a run folder with -o that all workers reach by the "
                "same path"
            )


@contextmanager
def _token(stages: Path) -> Iterator[Path]:
    path = stages.absolute() / f".{uuid.uuid4().hex}.part"
    with disk_refusals(path):
        path.mkdir()
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _seen(token: Path) -> tuple[str, bool]:
    return _code(), token.is_dir()


def _code() -> str:
    return code_hash("survey.run.tiled")


def _cores_plugin(distributed: Any, number: int) -> Any:
    """Gives each worker of this machine its share of the cores, before it loads anything that starts threads."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

    class Cores(distributed.WorkerPlugin):
        name = "cores"

        def setup(self, worker: Any) -> None:
            place = int(worker.name) % number
            own = [core for index, core in enumerate(cores) if index % number == place % max(len(cores), 1)]
            if own:
                os.sched_setaffinity(0, own)

    return Cores()


def save_job(job: Job, found: TilePlan, folder: Path, stage: str) -> Path:
    """Write what workers have to know of a job for a stage; its grey images lie in files already."""
    block = job.block
    path = folder / f"{stage}.pickle"
    parts = job.survey, job.chosen, job.tiles, found, block.images, block.saturated
    with write_whole(path) as stream:
        stream.write(pickle.dumps(parts))
    return path.absolute()


@lru_cache(maxsize=1)
def _tiles_of(path: Path) -> dict[int, TileJob]:
    """The tiles of a job that `save_job` wrote."""
    from fields.sweep.block import Block
    from survey.plan.block import backend, cameras_of_block
    from survey.run.job import Job
    from survey.run.tile_job import TileJob

    survey, chosen, tiles, found, images, saturated = pickle.loads(path.read_bytes())
    job = Job(survey, chosen, cast(Any, _Said()))
    job.take_tiles(tiles)
    cameras, plan = cameras_of_block(survey, job.plan), job.plan
    job.__dict__["block"] = Block(
        backend(plan), cameras, images, survey.water, 0.5 * sum(found.bound), saturated, plan.skips
    )
    return {number: TileJob(job, number, found) for number in range(len(tiles.tiling))}


def _compute(job: Path, stages: Path, task: Task) -> tuple[Path, float, list[tuple[str, str]]]:
    """Compute a task on a worker: the folder of its result, its seconds, and what it had to say."""
    start = time.monotonic()
    tile = _tiles_of(job)[task.tile]
    folder = stages / f".{task.name}-{uuid.uuid4().hex[:8]}.part"
    with disk_refusals(folder):
        folder.mkdir()
    said = cast(_Said, tile.whole.progress)
    said.lines.clear()
    try:
        task.compute(tile, folder, task.needs)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        tile.give_back()
        tile.drop()
    return folder, time.monotonic() - start, list(said.lines)


class _Said:
    """Progress of a worker: it keeps what is said, for the process of the run."""

    forecast = None

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    @contextmanager
    def stage(self, _name: str, total: float | None = None) -> Iterator[_Step]:
        """As `Progress.stage`, without a word."""
        yield _Step(total)

    def detail(self, text: str) -> None:
        """As `Progress.detail`."""
        self.lines.append(("detail", text))

    def note(self, text: str) -> None:
        """As `Progress.note`."""
        self.lines.append(("note", text))

    def warn(self, text: str) -> None:
        """As `Progress.warn`."""
        self.lines.append(("warn", text))


class _Step:
    """As `survey.progress.Step`."""

    def __init__(self, total: float | None):
        self.total, self.done = total, 0.0

    def advance(self, amount: float = 1.0, *, detail: str = "") -> None:
        """Count."""
        self.done += amount
