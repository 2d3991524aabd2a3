"""Flat arrays between numpy and the device of the kernels, in Dr.Jit or torch; memory and threads of the device."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from fields.device import Device
from fields.sweep.kernels.flat import flatten

# Alignment of arrays. Kernels of Dr.Jit load whole vectors, and one is compiled for each combination of aligned arrays.
ALIGNED_BYTES = 64
# In float32: as much as the last vector of a view may reach beyond its end.
_SPARE = ALIGNED_BYTES // 4
_SWITCH_INTERVAL_S = 3e-4


def floats(device: Device, array: Any) -> Any:
    """Flat float32 array of the device; arrays that are on the device are not copied.

    Dr.Jit on the CPU reads a contiguous array of float32 where it lies, if that is aligned: it must not be written to
    afterwards.
    """
    if not isinstance(array, np.ndarray):
        return flatten(array)
    flat = np.ascontiguousarray(array, dtype=np.float32).ravel()
    if device.module is not None:
        return device.module.Float(_aligned(flat))
    import torch

    return torch.tensor(flat, device=device.place)


def indices(device: Device, array) -> Any:
    """Flat array of indices on the device, copied: uint32 in Dr.Jit, int64 in torch.

    Those that are on the device stay there.
    """
    if device.apart and not isinstance(array, np.ndarray):
        return array if device.module is None else device.module.UInt(array)
    if device.module is not None:
        return device.module.UInt(_aligned(np.ascontiguousarray(array, dtype=np.uint32).ravel()))
    import torch

    return torch.tensor(np.asarray(array, dtype=np.int64), device=device.place).reshape(-1)


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
    import torch

    return torch.from_numpy(flat.view(np.int64 if wide else np.int32)).to(device.place)


def constant(device: Device, value: float) -> Any:
    """Scalar that kernels of Dr.Jit take as an argument, so that another value compiles no other kernel."""
    if device.module is not None:
        import drjit

        return drjit.opaque(device.module.Float, float(value))
    import torch

    return torch.tensor(float(value), device=device.place)


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
        import drjit

        array = drjit.empty(device.module.Float, size + _SPARE)
        return Buffer(array, size, array.numpy() if device.name == "llvm" else None)


def hypothesis_and_pixel(device: Device, count: int, strip: int) -> tuple[Any, Any]:
    """Quotient and remainder of the numbers 0 to ``count`` by ``strip``, in Dr.Jit.

    By a product: processors have no division of vectors of whole numbers.
    """
    import drjit

    module = device.module
    index = drjit.arange(module.UInt, count)
    number = module.UInt((module.Float64(index) + 0.5) * drjit.opaque(module.Float64, 1.0 / strip))
    return number, index - number * drjit.opaque(module.UInt, strip)


def host(device: Device, array) -> np.ndarray:
    """Flat array of the device as numpy."""
    return array.numpy() if device.module is not None else array.reshape(-1).cpu().numpy()


def results(device: Device, launched: list[Any]) -> list[Any]:
    """Results of kernels as flat arrays where the passes work on them: on the host, after a wait, or on the device."""
    return launched if device.apart else [host(device, each) for each in launched]


@contextmanager
def sharing_cores(device: Device, workers: int) -> Iterator[None]:
    """Leave processor cores to threads of Python that work in parallel to the kernels.

    Threads of Dr.Jit keep a core busy while they wait for the next kernel, so all but one of the workers get the core
    of one. Python hands over its lock every 5 ms unless it is released, longer than most calls of numpy take here.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        with _fewer_threads(device, workers - 1):
            yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def _fewer_threads(device: Device, fewer: int) -> Iterator[None]:
    if device.name != "llvm":
        yield
        return
    import drjit

    count = drjit.thread_count()
    drjit.set_thread_count(max(count - fewer, 1))
    try:
        yield
    finally:
        drjit.set_thread_count(count)


def free_unused(device: Device) -> None:
    """Free the unused memory that the device keeps for arrays of the same size."""
    if device.module is not None:
        import drjit

        drjit.flush_malloc_cache()
    elif device.place == "cuda":
        import torch

        torch.cuda.empty_cache()


def release(device: Device) -> None:
    """Return unused memory of the device and of the C library (glibc) to the system."""
    free_unused(device)
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
