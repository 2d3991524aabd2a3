"""Flat arrays of the device of the kernels, in Dr.Jit or torch, transfers, memory, and the queue of jobs.

Whole numbers have a sign. Numbers that differ from view to view are made by `scalar`: kernels of Dr.Jit take them as
arguments and are not compiled again.

One view's kernels run while another view is prepared, in one thread: Dr.Jit launches kernels asynchronously; reading a
result waits for all that were launched. So a job yields what it would launch and receives the results: between the two
another job launches its own kernels, and this thread prepares the next ones. Several threads would wait for each other
at the GIL.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeVar

import numpy as np

from fields.device import Device
from refract.kernels import namespace


def _drjit() -> Any:
    """The module, which says nothing of its types; imported where arrays are not torch's."""
    import drjit

    return drjit


def _torch() -> Any:
    import torch

    return torch


def is_torch(array: Any) -> bool:
    return namespace(array).name == "torch"


def arange(like: Any, count: int) -> Any:
    """Whole numbers 0 to ``count`` - 1, on the device of an array."""
    if is_torch(like):
        return _torch().arange(count, device=like.device)
    return _drjit().arange(_drjit().int32_array_t(type(like)), count)


def scalar(like: Any, value: float) -> Any:
    """Scalar argument of kernels on the device of an array: whole if it is an int."""
    is_whole = isinstance(value, int | np.integer)
    if is_torch(like):
        return int(value) if is_whole else float(value)
    dr, kind = _drjit(), type(like)
    return dr.opaque(dr.int32_array_t(kind) if is_whole else dr.float32_array_t(kind), value)


def to_float(array: Any) -> Any:
    """Whole numbers, or a mask, as float32."""
    if is_torch(array):
        return array.float()
    dr = _drjit()
    kind = dr.float32_array_t(type(array))
    return dr.select(array, kind(1.0), kind(0.0)) if dr.is_mask_v(array) else kind(array)


def integer_part(values: Any) -> Any:
    """Integer part of values that are not negative."""
    return values.long() if is_torch(values) else _drjit().int32_array_t(type(values))(values)


def zeros_of(like: Any) -> Any:
    """Array of zeros of the size of one of float32, in memory of its own."""
    if is_torch(like):
        return _torch().zeros_like(like)
    return _drjit().opaque(_drjit().float32_array_t(type(like)), 0.0, len(like))


def gather(flat: Any, index: Any) -> Any:
    if is_torch(flat):
        return flat[index]
    return _drjit().gather(type(flat), flat, _drjit().uint32_array_t(type(index))(index))


def scatter(target: Any, index: Any, values: Any, mask: Any) -> None:
    """Set values at indices where a mask is True."""
    if is_torch(target):
        target[index[mask]] = values[mask]
    else:
        _drjit().scatter(target, values, _drjit().uint32_array_t(type(index))(index), mask)


def evaluate(*arrays: Any) -> None:
    """Evaluate the traced arrays of Dr.Jit."""
    if not is_torch(arrays[0]):
        _drjit().eval(*arrays)


# Alignment of arrays. Kernels of Dr.Jit load whole vectors, and one is compiled for each combination of aligned arrays.
ALIGNED_BYTES = 64
# In float32: as much as the last vector of a view may reach beyond its end.
_SPARE = ALIGNED_BYTES // 4
_SWITCH_INTERVAL_S = 3e-4


def floats(device: Device, array: np.ndarray) -> Any:
    """Flat float32 array of the device.

    Dr.Jit on the CPU reads a contiguous array of float32 where it lies, if that is aligned: it must not be written to
    afterwards.
    """
    flat = np.ascontiguousarray(array, dtype=np.float32).ravel()
    if device.module is not None:
        return device.module.Float(_aligned(flat))
    return _torch().tensor(flat, device=device.place)


def indices(device: Device, array: np.ndarray) -> Any:
    """Flat array of indices on the device, copied: uint32 in Dr.Jit, int64 in torch."""
    if device.module is not None:
        return device.module.UInt(_aligned(np.ascontiguousarray(array, dtype=np.uint32).ravel()))
    return _torch().tensor(np.asarray(array, dtype=np.int64), device=device.place).reshape(-1)


def _aligned(flat: np.ndarray) -> np.ndarray:
    """Flat array aligned to vectors, copied if need be."""
    if flat.ctypes.data % ALIGNED_BYTES == 0:
        return flat
    room = np.empty(flat.nbytes + ALIGNED_BYTES, dtype=np.uint8)
    first = -room.ctypes.data % ALIGNED_BYTES
    copy = room[first : first + flat.nbytes].view(flat.dtype)
    copy[:] = flat
    return copy


def words(device: Device, array: np.ndarray) -> Any:
    """Flat array of the bits of uint32 or uint64 numbers; signed in torch."""
    flat = np.ascontiguousarray(array).ravel()
    wide = flat.dtype == np.uint64
    if device.module is not None:
        return (device.module.UInt64 if wide else device.module.UInt)(flat)
    return _torch().from_numpy(flat.view(np.int64 if wide else np.int32)).to(device.place)


def constant(device: Device, value: float) -> Any:
    """Scalar that kernels of Dr.Jit take as an argument, so that another value compiles no other kernel."""
    if device.module is not None:
        return _drjit().opaque(device.module.Float, float(value))
    return _torch().tensor(float(value), device=device.place)


@dataclass(frozen=True)
class Buffer:
    """Array of Dr.Jit that kernels fill and of which views are read."""

    # flat array of float32: longer than asked for by a vector: kernels load whole vectors, of a view that ends where
    # the array does beyond it, and there may be no memory behind it
    array: Any
    size: int  # How many numbers were asked for
    # its memory on the host, on the CPU; None elsewhere: Dr.Jit returns the address of an array only after all kernels
    # have finished: allocate before launching them
    memory: np.ndarray | None

    @staticmethod
    def of(device: Device, size: int) -> Buffer:
        """Uninitialised buffer of a size."""
        array = _drjit().empty(device.module.Float, size + _SPARE)
        return Buffer(array, size, array.numpy() if device.name == "llvm" else None)


def hypothesis_and_pixel(device: Device, count: int, strip: int) -> tuple[Any, Any]:
    """Quotient and remainder of the numbers 0 to ``count`` by ``strip``, in Dr.Jit.

    By a product: processors have no division of vectors of whole numbers.
    """
    dr, module = _drjit(), device.module
    index = dr.arange(module.UInt, count)
    number = module.UInt((module.Float64(index) + 0.5) * dr.opaque(module.Float64, 1.0 / strip))
    return number, index - number * dr.opaque(module.UInt, strip)


def host(device: Device, array) -> np.ndarray:
    """Flat array of the device as numpy, after a wait for the kernels that fill it."""
    return array.numpy() if device.module is not None else array.reshape(-1).cpu().numpy()


@contextmanager
def sharing_cores(device: Device, workers: int) -> Iterator[None]:
    """Leave processor cores to threads of Python that work in parallel to the kernels.

    Threads of Dr.Jit keep a core busy while they wait for the next kernel, so all but one of the workers get the core
    of one. Python hands over its lock every 5 ms unless it is released, longer than most calls of numpy take here.
    """
    interval, count = sys.getswitchinterval(), _drjit().thread_count() if device.name == "llvm" else 0
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    if count:
        _drjit().set_thread_count(max(count - workers + 1, 1))
    try:
        yield
    finally:
        if count:
            _drjit().set_thread_count(count)
        sys.setswitchinterval(interval)


def free_unused(device: Device) -> None:
    """Free the unused memory that the device keeps for arrays of the same size."""
    if device.module is not None:
        _drjit().flush_malloc_cache()
    elif device.place == "cuda":
        _torch().cuda.empty_cache()


def release(device: Device) -> None:
    """Return unused memory of the device and of the C library (glibc) to the system."""
    free_unused(device)
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


Found = TypeVar("Found")


@dataclass(frozen=True)
class Launch:
    """Kernels that may still be running."""

    results: list[Any]  # flat arrays of the device
    # arrays that they read: threads of Dr.Jit that free memory of numpy need the GIL: it must not happen while this
    # thread holds it
    inputs: Any = None


# Yields what is to be launched, receives the results as flat arrays of the host each time, and returns what it found.
Job = Generator[Callable[[], Launch], list[np.ndarray], Found]


def run_job(device: Device, job: Job[Found]) -> Found:
    (found,) = run_jobs(device, [job])
    return found


def run_jobs(device: Device, jobs: Iterable[Job[Found]], most: int = 2) -> Iterator[Found]:
    """Results of jobs in their order; at most ``most`` are under way, one of which has kernels running."""
    numbered, turn = enumerate(jobs), _Queue({}, deque())
    running: tuple[int, Job, Launch] | None = None
    for next_number in count():
        while next_number not in turn.found:
            finished = None
            if running is not None:
                number, job, launched = running
                # Waits; no kernel runs until the next launch, and the inputs of the last ones are freed.
                finished = number, job, [host(device, each) for each in launched.results]
                running = None
                del launched
            if turn.ready:
                number, job, launch = turn.ready.popleft()
                running = number, job, launch()
            if finished is not None:
                turn.advance(*finished)
            if len(turn.ready) + (running is not None) < most:
                following = next(numbered, None)
                if following is not None:
                    turn.advance(*following, None)
                elif not turn.ready and running is None and next_number not in turn.found:
                    return
        yield turn.found.pop(next_number)


@dataclass(frozen=True)
class _Queue:
    """Results by job number, and the jobs that wait, with their next launch."""

    found: dict[int, Any]
    ready: deque[tuple[int, Job, Callable[[], Launch]]]

    def advance(self, number: int, job: Job, results: list[np.ndarray] | None) -> None:
        """Send a job its results and queue its next launch, or store what it returns."""
        try:
            self.ready.append((number, job, next(job) if results is None else job.send(results)))
        except StopIteration as end:
            self.found[number] = end.value
