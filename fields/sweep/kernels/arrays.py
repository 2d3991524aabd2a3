"""Flat arrays of the device of the kernels, in Dr.Jit or torch: what both name differently, transfers, memory.

Whole numbers have a sign. Numbers that differ from view to view are made by `scalar`: kernels of Dr.Jit take them as
arguments and are not compiled again.
"""

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
from refract import kernels

_SIGN = 1 << 31
# Bits of a key before a digit, and of the digit.
_DIGITS = ((0, 11), (11, 11), (22, 10))


def _drjit() -> Any:
    """The module, which says nothing of its types; imported where arrays are not torch's."""
    import drjit

    return drjit


def is_torch(array: Any) -> bool:
    """Whether an array is torch's."""
    return kernels.namespace(array).name == "torch"


def flatten(image: Any) -> Any:
    """Pixels of an image (height, width), row by row; a flat array stays as it is."""
    if is_torch(image):
        return image.reshape(-1)
    drjit = _drjit()
    return image.array if drjit.is_tensor_v(image) else image


def unflatten(flat: Any, shape: tuple[int, ...]) -> Any:
    """Image of flat pixels, evaluated."""
    if is_torch(flat):
        return flat.reshape(shape)
    drjit = _drjit()
    drjit.eval(flat)
    return drjit.tensor_t(type(flat))(flat, shape)


def size_of(flat: Any) -> int:
    """Number of pixels."""
    return len(flat)


def arange(like: Any, count: int) -> Any:
    """Whole numbers 0 to ``count`` - 1, on the device of an array."""
    if is_torch(like):
        import torch

        return torch.arange(count, device=like.device)
    drjit = _drjit()
    return drjit.arange(drjit.int32_array_t(type(flatten(like))), count)


def scalar(like: Any, value: float) -> Any:
    """Scalar argument of kernels on the device of an array: whole if it is an int."""
    is_whole = isinstance(value, int | np.integer)
    if is_torch(like):
        return int(value) if is_whole else float(value)
    drjit = _drjit()
    kind = type(flatten(like))
    return drjit.opaque(drjit.int32_array_t(kind) if is_whole else drjit.float32_array_t(kind), value)


def vector(like: Any, values: np.ndarray) -> Any:
    """Numbers (N,) of the host, whole ones or float32, on the device of an array."""
    is_whole = np.issubdtype(values.dtype, np.integer)
    values = np.ascontiguousarray(values, dtype=np.int32 if is_whole else np.float32)
    if is_torch(like):
        import torch

        found = torch.from_numpy(values).to(like.device)
        return found.long() if is_whole else found
    drjit = _drjit()
    kind = type(flatten(like))
    return (drjit.int32_array_t(kind) if is_whole else drjit.float32_array_t(kind))(values)


def to_float(array: Any) -> Any:
    """Whole numbers, or a mask, as float32."""
    if is_torch(array):
        return array.float()
    drjit = _drjit()
    kind = drjit.float32_array_t(type(array))
    return drjit.select(array, kind(1.0), kind(0.0)) if drjit.is_mask_v(array) else kind(array)


def integer_part(values: Any) -> Any:
    """Integer part of values that are not negative."""
    return values.long() if is_torch(values) else _drjit().int32_array_t(type(values))(values)


def constant_array(like: Any, value: float, count: int) -> Any:
    """Array of a constant, in memory of its own."""
    if is_torch(like):
        import torch

        return torch.full((count,), value, device=like.device)
    drjit = _drjit()
    return drjit.opaque(drjit.float32_array_t(type(flatten(like))), value, count)


def copy_of(flat: Any) -> Any:
    """Copy that may be written to."""
    if is_torch(flat):
        return flat.clone()
    return type(flat)(flat)


def gather(flat: Any, index: Any) -> Any:
    """Values at indices."""
    if is_torch(flat):
        return flat[index]
    drjit = _drjit()
    return drjit.gather(type(flat), flat, drjit.uint32_array_t(type(index))(index))


def scatter(target: Any, index: Any, values: Any, mask: Any | None = None) -> None:
    """Set values at indices, where an optional mask is True."""
    if is_torch(target):
        if mask is None:
            target[index] = values
        else:
            target[index[mask]] = values[mask]
        return
    drjit = _drjit()
    index = drjit.uint32_array_t(type(index))(index)
    drjit.scatter(target, values, index, True if mask is None else mask)


def nonzero(mask: Any) -> Any:
    """Indices of the True values of a mask (N,)."""
    if is_torch(mask):
        return mask.nonzero()[:, 0]
    drjit = _drjit()
    found = drjit.compress(mask)
    return drjit.int32_array_t(type(found))(found)


def evaluate(*arrays: Any) -> None:
    """Evaluate the traced arrays of Dr.Jit."""
    if not is_torch(arrays[0]):
        _drjit().eval(*arrays)


def as_numpy(array: Any) -> np.ndarray:
    """Flat array, or image, as numpy."""
    return array.cpu().numpy() if is_torch(array) else array.numpy()


def count_true(mask: Any) -> int:
    """Number of True values of a mask (N,); waits for it."""
    if is_torch(mask):
        return int(mask.sum())
    drjit = _drjit()
    return int(drjit.count(mask)[0])


def kth_smallest(flat: Any, rank: int) -> float:
    """Value of a rank, from 0; waits for it. No value may be NaN."""
    if is_torch(flat):
        return float(flat.sort().values[rank])
    drjit = _drjit()
    # Bits of floats rise with them once those of negative ones are turned over.
    bits = drjit.reinterpret_array(drjit.uint32_array_t(type(flat)), flat)
    keys = drjit.select(bits >= _SIGN, ~bits, bits | _SIGN)
    drjit.eval(keys)
    digits = 0
    # Radix selection: a histogram of the next digit of all keys that begin with the digits found before.
    for known, width in _DIGITS:
        shift = 32 - known - width
        begins_so = (keys >> (32 - known)) == drjit.opaque(type(keys), digits) if known else True
        counts = drjit.zeros(type(keys), 1 << width)
        drjit.scatter_add(counts, type(keys)(1), (keys >> shift) & ((1 << width) - 1), begins_so)
        up_to = np.cumsum(counts.numpy(), dtype=np.int64)
        digit = int(np.searchsorted(up_to, rank, side="right"))
        rank -= int(up_to[digit - 1]) if digit else 0
        digits = digits << width | digit
    found = np.uint32(digits ^ _SIGN if digits & _SIGN else ~digits & 0xFFFFFFFF)
    return float(found.view(np.float32))


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
    if device.has_own_memory and not isinstance(array, np.ndarray):
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
    return launched if device.has_own_memory else [host(device, each) for each in launched]


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
    trim_heap()


def trim_heap() -> None:
    """Return unused memory of the C library (glibc) to the system."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)
