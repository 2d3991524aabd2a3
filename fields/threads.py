"""Number of threads of torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def half_the_threads() -> Iterator[None]:
    """Halve torch's threads: they synchronise hundreds of times per step.

    A thread that has to share its core, with Dr.Jit's or with another program, holds up the others for a time slice
    each: on two cores, one of them taken, two threads need 5 times as long as one (25 times for small batches).
    """
    before = torch.get_num_threads()
    torch.set_num_threads(max(before // 2, 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)
