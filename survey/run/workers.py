"""Worker processes that compute stages of tiles: on this machine, or on a cluster that stands, by Dask distributed.

A worker reads what it needs from the run folder, which all workers reach by the same path, and leaves its result whole
in a folder of its own there; the process of the run gives it its place. Workers of a scheduler do the same at the URL
of a run that has one, and need no common disk.
"""

from __future__ import annotations

import os
import platform
import shutil
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from geo.errors import GeoError
from geo.files import disk_refusals
from survey.errors import SurveyError
from survey.plan.tile_choice import NO_DASK
from survey.run.task_at_url import compute_at_url, sees_url
from survey.run.worker_task import ANOTHER_VERSION, Task, compute_task, loaded_code

# Folder of the result of a task (or its name at the URL), seconds, and kinds and texts of its messages.
Computed = tuple[Path | str, float, list[tuple[str, str]]]

# A task whose workers end so often is given up: most likely it takes more memory than there is.
_ALLOWED_FAILURES = 3
# Resource of Dask that a worker with a GPU of its own has, and a task on one takes.
GPU = "GPU"
# How long workers of a cluster may take to come [s].
_WORKER_TIMEOUT_S = 60.0
# Interval at which the number of workers is checked [s].
_LOOK_EVERY_S = 5.0


@dataclass(frozen=True)
class Failure:
    """Error of a task on a worker, by its address and the name of its machine."""

    place: str
    machine: str
    error: Exception


def _attempted(compute: Callable[..., Computed], *given: Any) -> Computed | Failure:
    """Result of a task, on a worker; or what kept this one from it, which another may not lack: disk, photographs."""
    try:
        return compute(*given)
    except (SurveyError, GeoError, OSError) as error:
        from distributed import get_worker

        return Failure(get_worker().address, platform.node(), error)


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
    url : str, optional
        Of the run, where all goes by this.
    """

    def __init__(
        self, client: Any, folder: Path, *, are_started: bool, takes_gpu: bool = False, url: str | None = None
    ):
        self._client, self._are_started = client, are_started
        self._place: tuple[Callable[..., Any], Path | str] = (compute_task, folder.absolute())
        if url is not None:
            self._place = compute_at_url, url
        self._resources = {GPU: 1} if takes_gpu else None

    def computed(self, job: Path | str, tasks: Sequence[Task]) -> Generator[tuple[int, *Computed], None, None]:
        """Compute tasks; as each ends its number, the folder of its result, its seconds, and what it had to say.

        With a URL job and folders are names there. A task with an error is given to another worker once.

        Raises
        ------
        SurveyError
            If the workers of a task end again and again, or the scheduler is lost.
        SurveyError, GeoError, OSError
            Of a task, where no other worker has computed it.
        """
        from distributed import KilledWorker

        futures = {self._submit(job, task): number for number, task in enumerate(tasks)}
        waiting, failures = set(futures), dict[int, Failure]()
        ended = 0
        try:
            for future in self._as_they_end(waiting):
                number = futures[future]
                try:
                    found = future.result()
                except KilledWorker as error:
                    advice = "fewer --workers, or more --tiles" if self._are_started else "more --tiles"
                    raise SurveyError(
                        f"{tasks[futures[future]].name}: {error.allowed_failures + 1} workers that computed it were "
                        "ended by the system, most likely for want of memory; what other tiles have is kept: give the "
                        f"same command with {advice}"
                    ) from error
                if isinstance(found, Failure):
                    others = [each for each in self._client.nthreads() if each != found.place]
                    if number in failures or not others:
                        raise found.error
                    failures[number] = found
                    again = self._submit(job, tasks[number], others)
                    futures[again] = number
                    waiting.add(again)
                    continue
                folder, seconds, said = found
                if (failure := failures.get(number)) is not None:
                    why = f"{tasks[number].name}: the worker on {failure.machine} could not compute it"
                    said = [*said, ("warn", f"{why} ({failure.error}); another one has")]
                ended += 1
                yield number, folder, seconds, said
        except CancelledError as error:
            raise SurveyError(
                f"the scheduler of the workers was lost; {len(tasks) - ended} of {len(tasks)} tiles are missing: start "
                "it and its workers again, and give the same command: it goes on with what is finished"
            ) from error
        finally:
            # After an early end those that wait are not begun.
            self._client.cancel(list(futures))

    def _submit(self, job: Path | str, task: Task, among: list[str] | None = None) -> Any:
        """The future of a task, on any worker, or on one ``among`` these."""
        compute, place = self._place
        given = (compute, job, place, task, loaded_code())
        key = f"{task.name}-{uuid.uuid4().hex}"
        return self._client.submit(_attempted, *given, pure=False, key=key, resources=self._resources, workers=among)

    def _as_they_end(self, left: set[Any]) -> Iterator[Any]:
        """The futures, as they end, also those that come meanwhile; raise where no worker is left to end one."""
        from distributed import wait

        last_seen = time.monotonic()
        while left:
            with suppress(TimeoutError):
                ended = wait(left, timeout=_LOOK_EVERY_S, return_when="FIRST_COMPLETED").done
                left -= ended
                yield from ended
            if self._client.scheduler_info()["workers"]:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > _WORKER_TIMEOUT_S:
                raise SurveyError(
                    f"no worker is left, and none came back within {_WORKER_TIMEOUT_S:.0f} s; {len(left)} "
                    f"tiles are missing: give the same command again, it goes on with what is finished"
                )


@dataclass(frozen=True)
class WorkerNeeds:
    """Folders and devices that each worker of a run needs."""

    stages: Path  # Folder of the stages of the run
    photograph: Path  # One of the survey
    # Of a scheduler only workers with the resource GPU compute; those of this machine share its GPUs
    takes_gpu: bool = False
    url: str | None = None  # Of the run, by which workers of a scheduler work


@contextmanager
def workers_for(
    number: int, scheduler: str | None, needs: WorkerNeeds, note: Callable[[str], None]
) -> Iterator[Workers]:
    """Start a number of workers on this machine, or take all of a scheduler that has as many, for the stages of a run.

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
                client.register_plugin(_cores_plugin(distributed, number, gpus() if needs.takes_gpu else []))
            of = "this machine" if scheduler is None else scheduler
            note(f"workers: {len(client.nthreads())} of {of}, {_watched(client, scheduler)}")
            are_started = scheduler is None
            needs = replace(needs, takes_gpu=False, url=None) if are_started else needs
            _check(client, needs)
            yield Workers(client, needs.stages, are_started=are_started, takes_gpu=needs.takes_gpu, url=needs.url)


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
    """Address at which Dask shows its tasks in a browser, in words."""
    if scheduler is not None:
        return f"to be watched at {client.dashboard_link}, where its scheduler has bokeh"
    if find_spec("bokeh") is None:
        return "to be watched in a browser with bokeh (pip install bokeh)"
    # Of this machine alone, whatever address others know it by.
    return f"to be watched at http://127.0.0.1:{client.scheduler_info()['services']['dashboard']}/status"


def _check(client: Any, needs: WorkerNeeds) -> None:
    """Raise where a worker has several threads, another program, or lacks what it needs.

    By the URL of a run neither its folder nor a photograph is to be seen.
    """
    for place, threads in client.nthreads().items():
        if threads != 1:
            raise SurveyError(
                f"the worker {place} has {threads} threads, expected one, which computes one tile at a time; start it "
                "with --nthreads 1"
            )
    photograph = needs.photograph.absolute()
    with _token(needs.stages) as token:
        if needs.url is None:
            found = client.run(_seen, token, photograph, on_error="return")
        else:
            found = client.run(_seen_at, needs.url, on_error="return")
    left, has_gpu = client.nthreads(), False
    for place, each in found.items():
        if isinstance(each, Exception):
            if place not in left:
                # It has ended meanwhile; another may have taken its place.
                continue
            if isinstance(each, SurveyError):
                raise SurveyError(f"the worker {place} finds that {each}") from each
            # Dask passes on an error of loading as text.
            raise SurveyError(
                f"the worker {place} cannot load bathynerf ({each}); install the same version on all"
            ) from each
        code, sees_run, sees_photograph, resources = each
        has_gpu |= resources.get(GPU, 0) >= 1
        if code != loaded_code():
            raise SurveyError(f"the worker {place} has {ANOTHER_VERSION}")
        if not sees_run:
            raise SurveyError(
                f"the worker {place} does not see {needs.stages}; name a run folder with -o that all workers reach by "
                "the same path"
            )
        if not sees_photograph:
            raise SurveyError(
                f"the worker {place} does not see {photograph}; put the survey where all workers reach it by the same "
                "path"
            )
    if needs.takes_gpu and not has_gpu:
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
    return loaded_code(), token.is_dir(), photograph.is_file(), _resources(dask_worker)


def _resources(dask_worker: Any) -> dict[str, float]:
    return {} if dask_worker is None else dict(dask_worker.state.total_resources)


def _seen_at(url: str, dask_worker: Any = None) -> tuple[str, bool, bool, dict[str, float]]:
    sees_url(url)
    return loaded_code(), True, True, _resources(dask_worker)


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
