"""Worker processes that compute stages of tiles: of this machine, or of a cluster that stands, by Dask distributed.

A worker reads what it needs from the run folder, which all workers reach by the same path, and leaves its result whole
in a folder of its own there; the process of the run gives it its place. Workers of a scheduler do the same at the URL
of a run that has one, and need no common disk.
"""

import os
import shutil
import tempfile
import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from geo.errors import GeoError
from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.files.remote import Remote
from survey.plan.tiling import NO_DASK, has_dask
from survey.progress import current
from survey.run.remote_run import JOBS
from survey.run.worker_task import ANOTHER_VERSION, Messages, Task, compute_task
from survey.stage_key import code_hash

Item = TypeVar("Item")
Result = TypeVar("Result")

# A task whose workers end so often is given up: most likely it takes more memory than there is.
ALLOWED_FAILURES = 3
# Items of a sequence under way for each worker: results that wait for their turn are held.
_AT_ONCE = 2
# How long workers of a cluster may take to come, and the interval at which their number is checked [s].
WORKER_TIMEOUT_S, _LOOK_EVERY_S = 60.0, 5.0
# Settings of Dask while workers are at work.
_OF_DASK = {
    "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
    # Workers have cores of their own, and as many threads as these.
    "distributed.nanny.pre-spawn-environ": {},
    **{f"distributed.worker.memory.{limit}": False for limit in ("target", "spill", "pause", "terminate")},
    # Samples of the stack, a hundred a second, take time, and 60 MB of memory in five minutes.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.limit": "1h",
    "logging.distributed": "error",
    # Its pages and those of workers have no authentication.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


@dataclass(frozen=True)
class WorkerNeeds:
    """Folders and devices that each worker of a run needs."""

    stages: Path  # Folder of the stages of the run
    photograph: Path  # One of the survey
    takes_gpu: bool = False  # Whether workers of this machine share its GPUs
    url: str | None = None  # Of the run, where workers of a scheduler read and write


class Workers:
    """Workers of the scheduler of a Dask client, for a run by the folder of its stages, or by its URL.

    ``are_started`` says whether the run has started them, on this machine.
    """

    def __init__(self, client: Any, place: Path | str, *, are_started: bool):
        self._client, self._place, self._are_started = client, place, are_started
        # Results are fetched from a URL between two looks at the tasks: a worker has its next task already.
        self._tasks_of_worker = 1 if isinstance(place, Path) else _AT_ONCE

    def computed(self, job: str, tasks: Sequence[Task]) -> Generator[tuple[int, str, float, Messages], None, None]:
        """Compute tasks; as each ends its number, the place of its result, its seconds, and what it had to say.

        Those of the highest cost begin first, each where a worker is free: Dask would share out all at once, and let a
        worker that has ended its own wait for one that has not.
        """
        queue = deque(sorted(range(len(tasks)), key=lambda number: tasks[number].cost, reverse=True))
        numbers, waiting, ended = dict[Any, int](), set[Any](), 0

        def begin() -> None:
            most = self._tasks_of_worker * max(len(self._client.nthreads()), 1)
            while queue and len(waiting) < most:
                future = self._submit(job, tasks[queue[0]])
                numbers[future] = queue.popleft()
                waiting.add(future)

        advice = "fewer --workers, or more --tiles" if self._are_started else "more --tiles"
        try:
            with _in_words(
                f"that computed it were ended by the system, most likely for want of memory; what other tiles have is "
                f"kept: give the same command with {advice}",
                lambda: (
                    f"; {len(tasks) - ended} of {len(tasks)} tiles are missing: start it and its workers again, "
                    "and give the same command: it goes on with what is finished"
                ),
                has_names=True,
            ):
                for future in self._as_they_end(waiting, begin):
                    found = future.result()
                    ended += 1
                    yield numbers[future], *found
        finally:
            # After an early end those that wait are not begun.
            self._client.cancel(list(numbers))

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Results of a function in the order of the items, of which a few for each worker are under way.

        What a worker cannot compute this process does, and warns of it once.
        """
        is_said, left, under_way = False, iter(items), deque[tuple[Any, Any]]()
        most = _AT_ONCE * max(len(self._client.nthreads()), 1)
        try:
            with _in_words(
                "that looked for features and matches were ended by the system, most likely for want of memory; give "
                "the same command with fewer workers, or without --scheduler",
                lambda: " during structure from motion; start it and its workers again, and give the same command",
            ):
                while True:
                    with warnings.catch_warnings():
                        # Data that is scattered to one worker would be lost with it.
                        warnings.filterwarnings("ignore", "Sending large graph")
                        under_way += [
                            (item, self._client.submit(function, item, pure=False))
                            for item in islice(left, most - len(under_way))
                        ]
                    if not under_way:
                        return
                    item, future = under_way.popleft()
                    try:
                        found = future.result()
                    except (SurveyError, GeoError, OSError) as error:
                        if type(error).__name__ == "CommClosedError":
                            raise
                        # A full disk, or a photograph that this worker alone cannot read.
                        if not is_said:
                            current().warn(
                                f"a worker could not do its part of structure from motion ({error}); this machine does"
                            )
                        is_said, found = True, function(item)
                    yield found
        finally:
            self._client.cancel([future for _, future in under_way])

    def _submit(self, job: str, task: Task) -> Any:
        key, given = f"{task.name}-{uuid.uuid4().hex}", (job, self._place, task, code_hash())
        return self._client.submit(compute_task, *given, pure=False, key=key)

    def _as_they_end(self, left: set[Any], begin: Callable[[], None]) -> Iterator[Any]:
        """The futures, as they end, with those that ``begin`` adds meanwhile; raise where no worker is left."""
        from distributed import wait

        last_seen = time.monotonic()
        begin()
        while left:
            ended: set[Any] = set()
            with suppress(TimeoutError):
                ended = wait(left, timeout=_LOOK_EVERY_S, return_when="FIRST_COMPLETED").done
            left -= ended
            begin()
            yield from ended
            if self._client.scheduler_info()["workers"]:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > WORKER_TIMEOUT_S:
                raise SurveyError(
                    f"no worker is left, and none came back within {WORKER_TIMEOUT_S:.0f} s: give the same command "
                    "again, it goes on with the tiles that are finished"
                )


@contextmanager
def _in_words(killed: str, lost: Callable[[], str], *, has_names: bool = False) -> Iterator[None]:
    """Raise SurveyError where a task ends all its workers, and where the scheduler is lost, in these words.

    Keys of tasks that have names are the name and a number behind a hyphen.
    """
    from distributed import KilledWorker
    from distributed.comm.core import CommClosedError

    try:
        yield
    except KilledWorker as error:
        name = str(error.task).rpartition("-")[0] or error.task
        task = f"{name}: " if has_names else ""
        raise SurveyError(f"{task}{error.allowed_failures + 1} workers {killed}") from error
    except (CancelledError, CommClosedError) as error:
        raise SurveyError(f"the scheduler of the workers was lost{lost()}") from error


@contextmanager
def workers_for(
    number: int, scheduler: str | None, needs: WorkerNeeds, note: Callable[[str], None]
) -> Iterator[Workers]:
    """Start a number of workers on this machine, or take all of a scheduler that has as many, for a run."""
    if not has_dask():
        raise SurveyError(NO_DASK)
    import dask
    import distributed

    are_started = scheduler is None
    with dask.config.set(_OF_DASK), ExitStack() as stack:
        cluster: Any = scheduler
        if are_started:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="bathynerf-"))
            cluster = stack.enter_context(_local_cluster(distributed, number, folder))
        client = stack.enter_context(_client_of(distributed, cluster, scheduler, number))
        if are_started:
            client.register_plugin(_cores_plugin(distributed, number, gpus() if needs.takes_gpu else []))
            needs = replace(needs, url=None)
        note(f"workers: {len(client.nthreads())} of {scheduler or 'this machine'}")
        _check(client, needs)
        place = needs.stages.absolute() if needs.url is None else needs.url
        yield Workers(client, place, are_started=are_started)


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
    """Raise where a worker has several threads, another program, or does not see the run and its photographs."""
    for place, threads in client.nthreads().items():
        if threads != 1:
            raise SurveyError(
                f"the worker {place} has {threads} threads, expected one, which computes one tile at a time; start it "
                "with --nthreads 1"
            )
    photograph, token = needs.photograph.absolute(), needs.stages.absolute() / f".{uuid.uuid4().hex}.part"
    with reporting_disk_errors(token):
        token.mkdir()
    try:
        found = client.run(_seen, needs.url, token, photograph, on_error="return")
    finally:
        shutil.rmtree(token, ignore_errors=True)
    left = client.nthreads()
    for place, seen in found.items():
        if isinstance(seen, Exception):
            if place not in left:
                # It has ended meanwhile; another may have taken its place.
                continue
            if isinstance(seen, SurveyError):
                raise SurveyError(f"the worker {place} finds that {seen}") from seen
            # Dask passes on an error of loading as text.
            raise SurveyError(
                f"the worker {place} cannot load bathynerf ({seen}); install the same version on all"
            ) from seen
        code, sees_run, sees_photograph = seen
        for is_met, fault in (
            (code == code_hash(), f"has {ANOTHER_VERSION}"),
            (
                sees_run,
                f"does not see {needs.stages}; name a run folder with -o that all workers reach by the same path",
            ),
            (sees_photograph, f"does not see {photograph}; put the survey where all reach it by the same path"),
        ):
            if not is_met:
                raise SurveyError(f"the worker {place} {fault}")


def _seen(url: str | None, token: Path, photograph: Path) -> tuple[str, bool, bool]:
    """Code of a worker, whether it sees a run and its photographs, or reaches the URL where they are."""
    if url is not None:
        Remote(url).files(JOBS)  # Raises where it cannot be reached
    return code_hash(), url is not None or token.is_dir(), url is not None or photograph.is_file()


def gpus() -> list[str]:
    """The GPUs that this process sees, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [number.strip() for number in named.split(",") if number.strip()]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]


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
