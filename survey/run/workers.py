"""Worker processes that compute stages of tiles: on this machine, or on a cluster that stands, by Dask distributed.

A worker reads what it needs from the run folder, which all workers reach by the same path, and leaves its result whole
in a folder of its own there; the process of the run gives it its place. Workers of a scheduler do the same at the URL
of a run that has one, and need no common disk.
"""

from __future__ import annotations

import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from geo.errors import GeoError
from survey.errors import SurveyError
from survey.progress import current
from survey.run.worker_task import Task, compute_at_url, compute_task
from survey.stage_key import code_hash

# Folder of the result of a task (or its name at the URL), seconds, and kinds and texts of its messages.
Computed = tuple[Path | str, float, list[tuple[str, str]]]

Item = TypeVar("Item")
Result = TypeVar("Result")

# A task whose workers end so often is given up: most likely it takes more memory than there is.
ALLOWED_FAILURES = 3
# Resource of Dask that a worker with a GPU of its own has, and a task on one takes.
GPU = "GPU"
# Items of a sequence under way for each worker: results that wait for their turn are held.
_AT_ONCE = 2
# How long workers of a cluster may take to come [s].
WORKER_TIMEOUT_S = 60.0
# Interval at which the number of workers is checked [s].
_LOOK_EVERY_S = 5.0


class Workers:
    """Workers of the scheduler of a Dask client, for a run by the folder of its stages, or by its URL.

    ``are_started`` says whether the run has started them, on this machine, ``takes_gpu`` whether only those with the
    resource GPU compute.
    """

    def __init__(
        self, client: Any, folder: Path, *, are_started: bool, takes_gpu: bool = False, url: str | None = None
    ):
        self._client, self._are_started = client, are_started
        self._place: tuple[Callable[..., Any], Path | str] = (compute_task, folder.absolute())
        if url is not None:
            self._place = compute_at_url, url
        self._resources = {GPU: 1} if takes_gpu else None
        # Results are fetched from a URL between two looks at the tasks: a worker has its next task already.
        self._tasks_of_worker = 1 if url is None else _AT_ONCE

    def computed(self, job: Path | str, tasks: Sequence[Task]) -> Generator[tuple[int, *Computed], None, None]:
        """Compute tasks; as each ends its number, the folder of its result, its seconds, and what it had to say.

        Those of the highest cost begin first, each where a worker is free: Dask would share out all at once, and let a
        worker that has ended its own wait for one that has not. With a URL job and folders are names there.
        """
        from distributed import KilledWorker
        from distributed.comm.core import CommClosedError

        queue = deque(sorted(range(len(tasks)), key=lambda number: tasks[number].cost, reverse=True))
        futures, waiting, ended = dict[Any, int](), set[Any](), 0

        def begin() -> None:
            most = self._tasks_of_worker * max(len(self._client.nthreads()), 1)
            while queue and len(waiting) < most:
                number = queue.popleft()
                future = self._submit(job, tasks[number])
                futures[future] = number
                waiting.add(future)

        try:
            for future in self._as_they_end(waiting, begin):
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
                ended += 1
                yield number, *found
        except (CancelledError, CommClosedError) as error:
            raise SurveyError(
                f"the scheduler of the workers was lost; {len(tasks) - ended} of {len(tasks)} tiles are missing: start "
                "it and its workers again, and give the same command: it goes on with what is finished"
            ) from error
        finally:
            # After an early end those that wait are not begun.
            self._client.cancel(list(futures))

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Results of a function in the order of the items, of which a few for each worker are under way.

        What a worker cannot compute this process does, and warns of it once.
        """
        from distributed import KilledWorker
        from distributed.comm.core import CommClosedError

        is_said = False
        left, under_way = iter(items), deque[tuple[Any, Any]]()
        most = _AT_ONCE * max(len(self._client.nthreads()), 1)
        try:
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
                except CommClosedError:
                    raise
                except (SurveyError, GeoError, OSError) as error:
                    # A full disk, or a photograph that this worker alone cannot read.
                    if not is_said:
                        current().warn(
                            f"a worker could not do its part of structure from motion ({error}); this machine does"
                        )
                    is_said, found = True, function(item)
                yield found
        except KilledWorker as error:
            raise SurveyError(
                f"{error.allowed_failures + 1} workers that looked for features and matches were ended by the system, "
                "most likely for want of memory; give the same command with fewer workers, or without --scheduler"
            ) from error
        except (CancelledError, CommClosedError) as error:
            raise SurveyError(
                "the scheduler of the workers was lost during structure from motion; start it and its workers again, "
                "and give the same command"
            ) from error
        finally:
            self._client.cancel([future for _, future in under_way])

    def _submit(self, job: Path | str, task: Task) -> Any:
        """The future of a task."""
        compute, place = self._place
        key = f"{task.name}-{uuid.uuid4().hex}"
        given = job, place, task, code_hash()
        return self._client.submit(compute, *given, pure=False, key=key, resources=self._resources)

    def _as_they_end(self, left: set[Any], begin: Callable[[], None] = lambda: None) -> Iterator[Any]:
        """The futures, as they end, also those that come meanwhile; raise where no worker is left to end one.

        ``begin`` may add futures: it is called at the start, after each that ends, and every few seconds.
        """
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
