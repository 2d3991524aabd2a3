"""Flat arrays of a device: the functions that Dr.Jit and torch name differently.

Whole numbers have a sign. Numbers that differ from view to view are made by `scalar`: kernels of Dr.Jit take them as
arguments and are not compiled again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

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
    drjit.eval(target)


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
        rest = 32 - known - width
        begins_so = (keys >> (32 - known)) == drjit.opaque(type(keys), digits) if known else True
        counts = drjit.zeros(type(keys), 1 << width)
        drjit.scatter_add(counts, type(keys)(1), (keys >> rest) & ((1 << width) - 1), begins_so)
        up_to = np.cumsum(counts.numpy(), dtype=np.int64)
        digit = int(np.searchsorted(up_to, rank, side="right"))
        rank -= int(up_to[digit - 1]) if digit else 0
        digits = digits << width | digit
    found = np.uint32(digits ^ _SIGN if digits & _SIGN else ~digits & 0xFFFFFFFF)
    return float(found.view(np.float32))
