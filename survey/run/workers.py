"""Worker processes that compute stages of tiles: on this machine, or on a cluster that stands, by Dask distributed.

A task is one stage of one tile. A worker reads what it needs from the run folder, which all workers reach by the same
path, and leaves its result whole in a folder of its own there; the process of the run gives it its place. So a task
may be computed twice, and a worker may end at any time.
"""

from __future__ import annotations

import os
import pickle
import platform
import shutil
import time
import uuid
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from geo.files import disk_refusals, write_whole
from survey.errors import SurveyError
from survey.plan.tile_choice import NO_DASK
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.run.job import Job
    from survey.run.tile_job import TileJob, TilePlan

# Number of a task, folder of its result, seconds, and kinds and texts of its messages.
Computed = tuple[int, Path, float, list[tuple[str, str]]]

# A task whose workers end so often is given up: most likely it takes more memory than there is.
_ALLOWED_FAILURES = 3
# Resource of Dask that a worker with a GPU of its own has, and a task on one takes.
GPU = "GPU"
_ANOTHER_VERSION = "another version of bathynerf than the run; install the same on all, and start the workers again"
# How long workers of a cluster may take to come [s].
_WORKER_TIMEOUT_S = 60.0
# Interval at which the number of workers is checked [s].
_LOOK_EVERY_S = 5.0


@dataclass(frozen=True)
class Task:
    """Task of a worker: a stage of a tile."""

    name: str  # Of the stage
    tile: int
    # callable: as `survey.run.stage.Stage.compute`; cloudpickle carries it
    compute: Callable[[Job, Path, Mapping[str, Path]], None]
    needs: Mapping[str, Path]  # mapping: folders of the stages that it needs, by the names that ``compute`` knows


class Workers:
    """Workers of a Dask scheduler.

    Parameters
    ----------
    client : distributed.Client
    folder : Path
        Of the stages of the run.
    are_started : bool
        Whether the run has started them, on this machine.
    takes_gpu : bool
        Whether only workers with the resource GPU compute.
    """

    def __init__(self, client: Any, folder: Path, *, are_started: bool, takes_gpu: bool = False):
        self._client, self._folder, self._are_started = client, folder.absolute(), are_started
        self._resources = {GPU: 1} if takes_gpu else None

    def computed(self, job: Path, tasks: Sequence[Task]) -> Generator[Computed, None, None]:
        """Compute tasks; as each ends its number, the folder of its result, its seconds, and what it had to say.

        Raises
        ------
        SurveyError
            If the workers of a task end again and again, or the scheduler is lost.
        """
        from distributed import KilledWorker

        futures = {
            self._client.submit(
                _compute,
                job,
                self._folder,
                task,
                loaded_code(),
                pure=False,
                key=f"{task.name}-{uuid.uuid4().hex}",
                resources=self._resources,
            ): number
            for number, task in enumerate(tasks)
        }
        ended = 0
        try:
            for future in self._as_they_end(futures):
                try:
                    folder, seconds, said = future.result()
                except KilledWorker as error:
                    advice = "fewer --workers, or more --tiles" if self._are_started else "more --tiles"
                    raise SurveyError(
                        f"{tasks[futures[future]].name}: {error.allowed_failures + 1} workers that computed it were "
                        "ended by the system, most likely for want of memory; what other tiles have is kept: give the "
                        f"same command with {advice}"
                    ) from error
                ended += 1
                yield futures[future], folder, seconds, said
        except CancelledError as error:
            raise SurveyError(
                f"the scheduler of the workers was lost; {len(tasks) - ended} of {len(tasks)} tiles are missing: start "
                "it and its workers again, and give the same command: it goes on with what is finished"
            ) from error
        finally:
            # After an early end those that wait are not begun.
            self._client.cancel(list(futures))

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
            elif time.monotonic() - last_seen > _WORKER_TIMEOUT_S:
                raise SurveyError(
                    f"no worker is left, and none came back within {_WORKER_TIMEOUT_S:.0f} s; {len(left)} of "
                    f"{len(futures)} tiles are missing: give the same command again, it goes on with what is finished"
                )


@contextmanager
def workers_for(
    number: int,
    scheduler: str | None,
    stages: Path,
    photograph: Path,
    note: Callable[[str], None],
    *,
    takes_gpu: bool = False,
) -> Iterator[Workers]:
    """So many workers of this machine, or all of a scheduler that has so many, for the stages in a folder of a run.

    ``takes_gpu``: of a scheduler only workers with the resource GPU compute; those of this machine share its GPUs.

    Raises
    ------
    SurveyError
        If Dask is not installed, no worker comes, or one has no or another version of the program, several threads, or
        does not see the folder or a photograph; or if none has the resource GPU.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise SurveyError(NO_DASK) from error
    import dask

    of_dask = {
        "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
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
            cluster = _local_cluster(distributed, number)
        with cluster as place, _client_of(distributed, place, scheduler, number) as client:
            if scheduler is None:
                client.register_plugin(_cores_plugin(distributed, number, gpus() if takes_gpu else []))
            of = "this machine" if scheduler is None else scheduler
            note(f"workers: {len(client.nthreads())} of {of}, {_watched(client, scheduler)}")
            takes_gpu = takes_gpu and scheduler is not None
            _check(client, stages, photograph, takes_gpu=takes_gpu)
            yield Workers(client, stages, are_started=scheduler is None, takes_gpu=takes_gpu)


def _local_cluster(distributed: Any, number: int) -> Any:
    try:
        return distributed.LocalCluster(
            n_workers=number,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,
            # Any free port: 8787, the default, may be that of another cluster.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            silence_logs="ERROR",
        )
    except RuntimeError as error:
        # Each process runs the body of the script again, and ends where that starts processes in turn.
        raise SurveyError(
            f"{number} processes of this machine did not start ({error}); a Python script that asks for several needs "
            '`if __name__ == "__main__":` around what it does; else take workers=1'
        ) from error


def _client_of(distributed: Any, place: Any, scheduler: str | None, number: int) -> Any:
    client = None
    try:
        client = distributed.Client(place, timeout=_WORKER_TIMEOUT_S)
        client.wait_for_workers(number, timeout=_WORKER_TIMEOUT_S)
    except (OSError, TimeoutError, ValueError) as error:
        if client is not None:
            client.close()
        which = "this machine" if scheduler is None else f"--scheduler {scheduler}"
        raise SurveyError(
            f"{which} gave no {number} workers within {_WORKER_TIMEOUT_S:.0f} s ({error}); start them, or leave "
            "the option out"
        ) from error
    return client


def _watched(client: Any, scheduler: str | None) -> str:
    """Where Dask shows its tasks in a browser, in words."""
    if scheduler is not None:
        return f"to be watched at {client.dashboard_link}, where its scheduler has bokeh"
    if find_spec("bokeh") is None:
        return "to be watched in a browser with bokeh (pip install bokeh)"
    # Of this machine alone, whatever address others know it by.
    return f"to be watched at http://127.0.0.1:{client.scheduler_info()['services']['dashboard']}/status"


def _check(client: Any, stages: Path, photograph: Path, *, takes_gpu: bool = False) -> None:
    """Raise where a worker has several threads, another program, or does not see the run or a photograph.

    ``takes_gpu``: also where none has the resource GPU.
    """
    for place, threads in client.nthreads().items():
        if threads != 1:
            raise SurveyError(
                f"the worker {place} has {threads} threads, expected one, which computes one tile at a time; start it "
                "with --nthreads 1"
            )
    photograph = photograph.absolute()
    with _token(stages) as token:
        found = client.run(_seen, token, photograph, on_error="return")
    left, has_gpu = client.nthreads(), False
    for place, each in found.items():
        if isinstance(each, Exception):
            if place not in left:
                # It has ended meanwhile; another may have taken its place.
                continue
            # Dask passes on an error of loading as text.
            raise SurveyError(
                f"the worker {place} cannot load bathynerf ({each}); install the same version on all"
            ) from each
        code, sees_run, sees_photograph, resources = each
        has_gpu |= resources.get(GPU, 0) >= 1
        if code != loaded_code():
            raise SurveyError(f"the worker {place} has {_ANOTHER_VERSION}")
        if not sees_run:
            raise SurveyError(
                f"the worker {place} does not see {stages}; name a run folder with -o that all workers reach by the "
                "same path"
            )
        if not sees_photograph:
            raise SurveyError(
                f"the worker {place} does not see {photograph}; put the survey where all workers reach it by the same "
                "path"
            )
    if takes_gpu and not has_gpu:
        raise SurveyError(
            "the run computes on CUDA, and no worker has the resource GPU; start one for each GPU, with its number in "
            f'CUDA_VISIBLE_DEVICES and --resources "{GPU}=1", or give --device cpu'
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


def _seen(token: Path, photograph: Path, dask_worker: Any = None) -> tuple[str, bool, bool, dict[str, float]]:
    resources = {} if dask_worker is None else dict(dask_worker.state.total_resources)
    return loaded_code(), token.is_dir(), photograph.is_file(), resources


@cache
def loaded_code() -> str:
    """Hash of the code of this process: taken once, before stages are loaded, as files may change later."""
    return code_hash("survey.run.execution")


def gpus() -> list[str]:
    """The GPUs that this process sees, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [each.strip() for each in named.split(",") if each.strip()]
    import torch

    return [str(each) for each in range(torch.cuda.device_count())]


def _cores_plugin(distributed: Any, number: int, gpus_here: Sequence[str]) -> Any:
    """Gives each worker of this machine its share of cores and GPUs, before it loads anything that starts threads."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

    class Cores(distributed.WorkerPlugin):
        name = "cores"

        def setup(self, worker: Any) -> None:
            place = int(worker.name) % number
            own = [core for index, core in enumerate(cores) if index % number == place % max(len(cores), 1)]
            if own:
                os.sched_setaffinity(0, own)
            if gpus_here:
                os.environ["CUDA_VISIBLE_DEVICES"] = gpus_here[place % len(gpus_here)]

    return Cores()


def save_job(job: Job, found: TilePlan, folder: Path, stage: str) -> Path:
    """Write what workers have to know of a job for a stage; its grey images lie in files already.

    Each file has a name of its own: workers of a cluster outlive a run, and keep the job by this name.
    """
    block = job.block
    path = folder / f"{stage}-{uuid.uuid4().hex}.pickle"
    parts = _with_absolute_paths(job.survey), job.chosen, job.tiles, found, block.images, block.saturated
    with write_whole(path) as stream:
        stream.write(pickle.dumps(parts))
    return path.absolute()


def _with_absolute_paths(survey: Survey) -> Survey:
    views = [
        replace(
            view,
            path=view.path.absolute(),
            mask_path=None if view.mask_path is None else view.mask_path.absolute(),
        )
        for view in survey.views
    ]
    return replace(survey, folder=survey.folder.absolute(), views=tuple(views))


@lru_cache(maxsize=1)
def _tiles_of(path: Path) -> dict[int, TileJob]:
    """The tiles of a job that `save_job` wrote."""
    from fields.sweep.block import Block
    from survey.plan.sweep_block import backend, cameras_of_block
    from survey.run.job import Job
    from survey.run.tile_job import TileJob

    survey, chosen, tiles, found, images, saturated = pickle.loads(path.read_bytes())
    job = Job(survey, chosen, cast(Any, _RecordedProgress()))
    job.take_tiles(tiles)
    cameras, plan = cameras_of_block(survey, job.plan), job.plan
    job.__dict__["block"] = Block(
        backend(plan), cameras, images, survey.water, 0.5 * sum(found.bound), saturated, plan.skips
    )
    return {number: TileJob(job, number, found) for number in range(len(tiles.tiling))}


def _compute(job: Path, stages: Path, task: Task, code: str) -> tuple[Path, float, list[tuple[str, str]]]:
    """Compute a task on a worker: the folder of its result, its seconds, and what it had to say.

    Raises
    ------
    SurveyError
        If the hash of the worker's code is another than ``code``, that of the run: it may have come after the check.
    """
    if loaded_code() != code:
        raise SurveyError(f"a worker on {platform.node()} has {_ANOTHER_VERSION}")
    start = time.monotonic()
    tile = _tiles_of(job)[task.tile]
    folder = stages / f".{task.name}-{uuid.uuid4().hex[:8]}.part"
    with disk_refusals(folder):
        folder.mkdir()
    said = cast(_RecordedProgress, tile.whole.progress)
    said.lines.clear()
    try:
        task.compute(tile, folder, task.needs)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        tile.release()
        tile.drop()
    return folder, time.monotonic() - start, list(said.lines)


class _RecordedProgress:
    """Progress of a worker: it keeps what is said, for the process of the run."""

    forecast = None

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    @contextmanager
    def stage(self, _name: str, total: float | None = None) -> Iterator[_Step]:
        """Silent `Progress.stage`."""
        yield _Step(total)

    def detail(self, text: str) -> None:
        """Record a `Progress.detail`."""
        self.lines.append(("detail", text))

    def note(self, text: str) -> None:
        """Record a `Progress.note`."""
        self.lines.append(("note", text))

    def warn(self, text: str) -> None:
        """Record a `Progress.warn`."""
        self.lines.append(("warn", text))


class _Step:
    """Stand-in for `survey.progress.Step` that shows nothing."""

    def __init__(self, total: float | None):
        self.total, self.done = total, 0.0

    def advance(self, amount: float = 1.0, *, detail: str = "") -> None:
        """Count."""
        self.done += amount
