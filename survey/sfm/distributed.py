"""Features and matches computed on the workers of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Protocol):
    """Workers that compute a function of many items."""

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items."""


_WORKERS: ContextVar[Callable[[], AbstractContextManager[Workers]] | None] = ContextVar("workers", default=None)


@contextmanager
def computing_on(start: Callable[[], AbstractContextManager[Workers]]) -> Iterator[None]:
    """Within it, features and matches are computed on workers, which ``start`` gives when they are needed."""
    token = _WORKERS.set(start)
    try:
        yield
    finally:
        _WORKERS.reset(token)


def workers() -> AbstractContextManager[Workers] | None:
    """The workers to compute on; None where this process computes all itself."""
    start = _WORKERS.get()
    return None if start is None else start()
