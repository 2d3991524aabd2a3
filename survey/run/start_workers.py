"""Start of the workers of a run, on this machine or of a scheduler, and what is checked before they compute."""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.plan.tiling import NO_DASK, has_dask
from survey.run.worker_task import ANOTHER_VERSION, require_reachable
from survey.run.workers import ALLOWED_FAILURES, GPU, WORKER_TIMEOUT_S, Workers
from survey.stage_key import code_hash


@dataclass(frozen=True)
class WorkerNeeds:
    """Folders and devices that each worker of a run needs."""

    stages: Path  # Folder of the stages of the run
    photograph: Path  # One of the survey
    # Of a scheduler only workers with the resource GPU compute; those of this machine share its GPUs
    takes_gpu: bool = False
    url: str | None = None  # Of the run, where workers of a scheduler read and write


@contextmanager
def workers_for(
    number: int, scheduler: str | None, needs: WorkerNeeds, note: Callable[[str], None]
) -> Iterator[Workers]:
    """Start a number of workers on this machine, or take all of a scheduler that has as many, for a run."""
    if not has_dask():
        raise SurveyError(NO_DASK)
    import dask
    import distributed

    of_dask = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        # Workers have cores of their own, and as many threads as these.
        "distributed.nanny.pre-spawn-environ": {},
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        # Samples of the stack, a hundred a second, take time, and 60 MB of memory in five minutes.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.limit": "1h",
        "logging.distributed": "error",
        # Its pages and those of workers have no authentication.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with dask.config.set(of_dask), ExitStack() as stack:
        cluster: Any = scheduler
        if scheduler is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="bathynerf-"))
            cluster = stack.enter_context(_local_cluster(distributed, number, folder))
        with _client_of(distributed, cluster, scheduler, number) as client:
            if scheduler is None:
                client.register_plugin(_cores_plugin(distributed, number, gpus() if needs.takes_gpu else []))
            of = "this machine" if scheduler is None else scheduler
            note(f"workers: {len(client.nthreads())} of {of}")
            are_started = scheduler is None
            needs = replace(needs, takes_gpu=False, url=None) if are_started else needs
            _check(client, needs)
            yield Workers(client, needs.stages, are_started=are_started, takes_gpu=needs.takes_gpu, url=needs.url)


def _local_cluster(distributed: Any, number: int, folder: str) -> Any:
    """Processes of this machine that only the holder of a key of this run reaches, whatever the settings of Dask.

    Workers import from their folder: nobody else may write in it or beside it, as in Dask's folder in /tmp.
    """
    try:
        return distributed.LocalCluster(
            n_workers=number,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            security=distributed.Security.temporary(),
            protocol="tls",
            host="127.0.0.1",
            local_directory=folder,
            dashboard_address=None,
            # Any free port: 8787, the default, may be that of another cluster.
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
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
        client = distributed.Client(place, timeout=WORKER_TIMEOUT_S)
        client.wait_for_workers(number, timeout=WORKER_TIMEOUT_S)
    # TypeError without the keys of tls://, RuntimeError where Dask is told to refuse tcp://.
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        if client is not None:
            client.close()
        which = "this machine" if scheduler is None else f"--scheduler {scheduler}"
        keys = ", give Dask the keys of a tls:// address (docs/scaling.md)" if scheduler is not None else ""
        raise SurveyError(
            f"{which} gave no {number} workers within {WORKER_TIMEOUT_S:.0f} s ({error}); start them{keys}, or leave "
            "the option out"
        ) from error
    return client


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
        found = client.run(_seen, needs.url, token, photograph, on_error="return")
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
        if code != code_hash():
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
    with reporting_disk_errors(path):
        path.mkdir()
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _seen(
    url: str | None, token: Path, photograph: Path, dask_worker: Any = None
) -> tuple[str, bool, bool, dict[str, float]]:
    """Code of a worker, whether it sees a run and its photographs, or reaches the URL where they are, its resources."""
    if url is not None:
        require_reachable(url)
    resources = {} if dask_worker is None else dict(dask_worker.state.total_resources)
    return code_hash(), url is not None or token.is_dir(), url is not None or photograph.is_file(), resources


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
