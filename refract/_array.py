"""Array namespace: the functions that numpy, torch and Dr.Jit name differently, so that formulas are written once.

The optics are written once, component by component (`refract.kernels`), and run unchanged on numpy (float64, the
oracle), torch (float32 or float64, differentiable) and Dr.Jit (compiled for CPU or GPU). Arrays of vectors, and curved
surfaces, are those of numpy and torch.
"""

from __future__ import annotations

import math
import sys
from functools import wraps
from types import ModuleType, SimpleNamespace

import numpy as np

_ARRAYS = (np.ndarray, np.generic)


def _is_array(x) -> bool:
    return isinstance(x, _ARRAYS)


# Besides functions of the libraries' own names: `fma(a, b, c)` is a b + c, in one instruction where there is one;
# `double` and `like` convert arrays to float64 and to the precision of the second argument, and leave plain numbers
# alone; `fixed` detaches a value from its derivatives, and `tracked`
# says whether any argument may carry some, in reverse or forward mode; `eps` is the spacing of numbers near one;
# `same` is the value of a mask that is the same everywhere, None if it is not, or if knowing it would mean waiting for
# the device. Of numpy and torch alone: `orders` is the number of orders of derivatives, and `none` says whether a mask
# holds nowhere, false where that cannot be read.
_NUMPY = SimpleNamespace(
    name="numpy", sqrt=np.sqrt, sin=np.sin, cos=np.cos, atan=np.arctan, exp=np.exp, isnan=np.isnan,
    where=np.where, minimum=np.minimum, maximum=np.maximum, abs=np.abs,
    rsqrt=lambda x: 1.0 / np.sqrt(x), fma=lambda a, b, c: a * b + c,
    double=lambda x: x.astype(np.float64, copy=False) if _is_array(x) else x,
    like=lambda x, other: np.asarray(x, dtype=other.dtype) if _is_array(other) else x,
    eps=lambda x: 2.0**-52,
    orders=1,
    fixed=lambda x: x,
    tracked=lambda *arrays: False,
    same=lambda mask: True if mask.all() else None if mask.any() else False,
    none=lambda mask: not mask.any(),
)  # fmt: skip


def quiet(function):
    """Decorator that silences numpy's floating-point warnings.

    Skipped under torch.compile, which cannot trace `numpy.errstate`.
    """

    @wraps(function)
    def call(*args, **options):
        if compiling():
            return function(*args, **options)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return function(*args, **options)

    return call


def compiling() -> bool:
    """Whether torch.compile is tracing."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.compiler.is_compiling()


# Types of Dr.Jit met so far: a kernel asks for its library thousands of times while it is traced.
_drjit_types: set[type] = set()


def namespace(*arrays) -> SimpleNamespace:
    """Functions for the library that the first array among the arguments comes from; numpy for plain numbers.

    Looks only at libraries that are already imported, so numpy users never pay for torch.
    """
    for array in arrays:
        kind = type(array)
        if kind is np.ndarray or kind is float:
            continue
        if kind in _drjit_types:
            return _library("drjit").NAMESPACE
        torch = sys.modules.get("torch")
        if torch is not None and torch.is_tensor(array):
            return _library("torch").NAMESPACE
        # torch.compile only traces tensors of torch, and cannot trace into Dr.Jit.
        drjit = None if compiling() else sys.modules.get("drjit")
        if drjit is not None and drjit.is_array_v(array):
            _drjit_types.add(kind)
            return _library("drjit").NAMESPACE
    return _NUMPY


_libraries: dict[str, ModuleType] = {}


def _library(name: str) -> ModuleType:
    """The module of adapters to a library, imported at its first use."""
    if name not in _libraries:
        if name == "torch":
            from refract import _with_torch

            _libraries[name] = _with_torch
        else:
            from refract import _with_drjit

            _libraries[name] = _with_drjit
    return _libraries[name]


def transformed() -> bool:
    """Whether a transform of torch is tracing: see `refract._with_torch.transformed`."""
    return "torch" in sys.modules and _library("torch").transformed()


def as_like(values, like):
    """`values` in the library, type and place of the array `like`; numpy becomes float64."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.is_tensor(like):
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    return np.asarray(values, dtype=np.float64)


def root(value):
    """Square root of a number; a plain number gives a plain one, since a numpy scalar would turn tensors into numpy."""
    xp = namespace(value)
    return math.sqrt(value) if xp.name == "numpy" and not _is_array(value) else xp.sqrt(value)


def alike(*values) -> tuple:
    """`values`, plain numbers included, as arrays of the one library found among them; numpy becomes float64."""
    return common(**{f"argument {k}": value for k, value in enumerate(values, start=1)})


def as_numpy(array) -> np.ndarray:
    """A copy in numpy float64 of an array of numpy or torch, without its gradient."""
    return np.asarray(array.detach().cpu() if namespace(array).name == "torch" else array, dtype=np.float64)


# Elements of a block: a dozen temporaries of 64 kB each stay in the L2 cache, and no new page is allocated.
_BLOCK = 8192


def in_blocks(function, *arrays) -> tuple[np.ndarray, ...]:
    """Arrays that an elementwise function of numpy arrays that broadcast returns, computed block by block."""
    arrays = np.broadcast_arrays(*arrays)
    flat = [array.reshape(-1) for array in arrays]
    starts = range(0, max(flat[0].size, 1), _BLOCK)
    parts = [function(*(array[first : first + _BLOCK] for array in flat)) for first in starts]
    columns = zip(*parts, strict=True)
    return tuple((c[0] if len(c) == 1 else np.concatenate(c)).reshape(arrays[0].shape) for c in columns)


def common(**arrays) -> tuple:
    """The named arguments in one library: torch if any of them is, else numpy float64.

    Raises ValueError: naming the arguments and their shapes; TypeError if an array is Dr.Jit's.
    """
    if any(namespace(a).name == "drjit" for a in arrays.values()):
        raise TypeError("expected arrays of numpy or torch, got Dr.Jit's; refract.kernels takes their components")
    torch = sys.modules.get("torch")
    tensors = [a for a in arrays.values() if torch is not None and torch.is_tensor(a)]
    like = None
    for tensor in tensors:
        like = tensor if like is None or tensor.ndim > like.ndim else like
    same = tuple(a if any(a is t for t in tensors) else as_like(a, like) for a in arrays.values())
    shapes = {name: tuple(a.shape) for name, a in zip(arrays, same, strict=True)}
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"expected shapes that broadcast against each other, got {found}") from None
    return same


def components(vectors):
    """The x, y, z arrays of vectors (..., 3)."""
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"expected vectors of shape (..., 3), got {tuple(vectors.shape)}")
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def stack(x, y, z):
    """The inverse of `components`, broadcasting the three arrays, or plain numbers, against each other."""
    xp = namespace(x, y, z)
    if xp.name == "torch" and xp.tracked(x, y, z):
        import torch

        like = next(v for v in (x, y, z) if torch.is_tensor(v))
        return torch.stack(torch.broadcast_tensors(*(as_like(v, like) for v in (x, y, z))), dim=-1)
    return _filled(xp, (x, y, z))


def _filled(xp, components):
    """`stack` by filling component by component: torch's own stack takes three times as long."""
    like = next(v for v in components if hasattr(v, "dtype"))
    shape = (*np.broadcast_shapes(*(np.shape(v) for v in components)), 3)
    vectors = np.empty(shape) if xp.name == "numpy" else like.new_empty(shape)
    for k, component in enumerate(components):
        vectors[..., k] = component
    return vectors


def spread(*arrays) -> tuple:
    """Arrays of numpy or torch broadcast to a common shape, as views."""
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    expand = np.broadcast_to if namespace(*arrays).name == "numpy" else lambda array, shape: array.expand(shape)
    return tuple(array if array.shape == shape else expand(array, shape) for array in arrays)
