"""Array namespace: the functions that numpy, torch and Dr.Jit name differently, so that formulas are written once.

The optics are written once, component by component (`refract.kernels`), and run unchanged on numpy (float64, the
oracle), torch (float32 or float64, differentiable) and Dr.Jit (compiled for CPU or GPU). Arrays of vectors, and curved
surfaces, are those of numpy and torch.
"""

import math
import sys
from collections.abc import Callable
from functools import cache, wraps
from types import ModuleType, SimpleNamespace
from typing import Any

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
            return _drjit()
        torch = sys.modules.get("torch")
        if torch is not None and torch.is_tensor(array):
            return _torch().NAMESPACE
        # torch.compile only traces tensors of torch, and cannot trace into Dr.Jit.
        drjit = None if compiling() else sys.modules.get("drjit")
        if drjit is not None and drjit.is_array_v(array):
            _drjit_types.add(kind)
            return _drjit()
    return _NUMPY


@cache
def _drjit() -> SimpleNamespace:
    import drjit

    dr: Any = drjit  # says nothing of its types
    return SimpleNamespace(
        name="drjit", sqrt=dr.sqrt, sin=dr.sin, cos=dr.cos, atan=dr.atan, exp=dr.exp, isnan=dr.isnan,
        where=dr.select, minimum=dr.minimum, maximum=dr.maximum, abs=dr.abs, rsqrt=dr.rsqrt, fma=dr.fma,
        double=lambda x: dr.float64_array_t(type(x))(x) if dr.is_array_v(x) else x,
        like=lambda x, other: type(other)(x),
        eps=lambda x: 2.0 * dr.epsilon(x),
        same=lambda mask: None,
        fixed=dr.detach, tracked=lambda *arrays: any(dr.is_array_v(x) and dr.grad_enabled(x) for x in arrays),
    )  # fmt: skip


_torch_module: list[ModuleType] = []


def _torch() -> ModuleType:
    """The adapters to torch, imported at their first use."""
    if not _torch_module:
        from refract import _with_torch

        _torch_module.append(_with_torch)
    return _torch_module[0]


def transformed() -> bool:
    """Whether a transform of torch is tracing: see `refract._with_torch.transformed`."""
    return "torch" in sys.modules and _torch().transformed()


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
    # Filled component by component: torch's own stack takes three times as long.
    like = next(v for v in (x, y, z) if hasattr(v, "dtype"))
    shape = (*np.broadcast_shapes(*(np.shape(v) for v in (x, y, z))), 3)
    vectors = np.empty(shape) if xp.name == "numpy" else like.new_empty(shape)
    for k, component in enumerate((x, y, z)):
        vectors[..., k] = component
    return vectors


def spread(*arrays) -> tuple:
    """Arrays of numpy or torch broadcast to a common shape, as views."""
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    expand = np.broadcast_to if namespace(*arrays).name == "numpy" else lambda array, shape: array.expand(shape)
    return tuple(array if array.shape == shape else expand(array, shape) for array in arrays)


def number(value):
    """A plain number as float, several as numpy float64; arrays of torch as they are."""
    if namespace(value).name != "numpy":
        return value
    array = np.asarray(value, dtype=np.float64)
    return array if array.ndim else float(array)


def hold(condition: Callable[[np.ndarray], np.ndarray], *numbers) -> bool:
    """Whether a condition holds for all values; True while a transform of torch hides the values of tensors."""
    if transformed():
        return True
    return all(bool(condition(as_numpy(value)).all()) for value in numbers)


def require_index(index) -> None:
    """ValueError unless all values of an index of water relative to air are 1 to 2."""
    if not hold(lambda n: (n >= 1.0) & (n <= 2.0), index):
        raise ValueError(f"expected an index of water relative to air of 1 to 2 (fresh: 1.333), got {index}")


def in_library(value, like):
    """Several numbers of numpy in the library of the array `like`, in float64; all else as it is."""
    xp = namespace(like)
    if not isinstance(value, np.ndarray) or xp.name == "numpy":
        return value
    return as_like(value, xp.double(like))


class OutsideFit(UserWarning):
    """A formula is used outside the range of values that it was fitted to."""


def require(name: str, values, holds, expected: str) -> None:
    """Raise where `values`, but for NaN, are not what ``holds(values)`` says.

    Raises ValueError: with the first of the wrong values, and what was `expected`.
    """
    values = as_numpy(values)
    wrong = values[~(holds(values) | np.isnan(values))]
    if wrong.size:
        raise ValueError(f"{name} is {wrong[0]:g}, expected {expected}; check its unit and its sign")
