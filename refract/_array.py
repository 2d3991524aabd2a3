"""One source for three array libraries: the few functions that numpy, torch and Dr.Jit name differently.

The optics are written once, component by component, and run unchanged on numpy (float64, the oracle),
torch (float32 or float64, differentiable) and Dr.Jit (compiled for CPU or GPU).
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np

_NUMPY = SimpleNamespace(
    name="numpy", sqrt=np.sqrt, sin=np.sin, cos=np.cos, exp=np.exp,
    where=np.where, minimum=np.minimum, maximum=np.maximum, abs=np.abs,
)  # fmt: skip


def _torch_namespace(torch) -> SimpleNamespace:
    def as_tensor(x, like):
        return x if torch.is_tensor(x) else torch.as_tensor(x, dtype=like.dtype, device=like.device)

    def pair(function):
        def call(a, b):
            like = a if torch.is_tensor(a) else b
            return function(as_tensor(a, like), as_tensor(b, like))

        return call

    return SimpleNamespace(
        name="torch", sqrt=torch.sqrt, sin=torch.sin, cos=torch.cos, exp=torch.exp,
        where=torch.where, minimum=pair(torch.minimum), maximum=pair(torch.maximum), abs=torch.abs,
    )  # fmt: skip


def _drjit_namespace(dr) -> SimpleNamespace:
    return SimpleNamespace(
        name="drjit", sqrt=dr.sqrt, sin=dr.sin, cos=dr.cos, exp=dr.exp,
        where=dr.select, minimum=dr.minimum, maximum=dr.maximum, abs=dr.abs,
    )  # fmt: skip


def namespace(*arrays) -> SimpleNamespace:
    """Functions for the library that the first array among the arguments comes from; numpy for plain numbers.

    Looks only at libraries that are already imported, so numpy users never pay for torch.
    """
    torch = sys.modules.get("torch")
    drjit = sys.modules.get("drjit")
    for array in arrays:
        if torch is not None and torch.is_tensor(array):
            return _torch_namespace(torch)
        if drjit is not None and drjit.is_array_v(array):
            return _drjit_namespace(drjit)
    return _NUMPY


def as_like(values, like):
    """`values` in the library, type and place of the array `like`; numpy becomes float64."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.is_tensor(like):
        return torch.as_tensor(values, dtype=like.dtype, device=like.device)
    return np.asarray(values, dtype=np.float64)


def alike(*values) -> tuple:
    """`values`, plain numbers among them, as arrays of the one library that is found there; numpy becomes float64."""
    if namespace(*values).name != "drjit":
        return common(**{f"argument {k}": value for k, value in enumerate(values, start=1)})
    like = next(type(value) for value in values if namespace(value).name == "drjit")
    return tuple(like(value) for value in values)


def as_numpy(array) -> np.ndarray:
    """A copy in numpy float64 of an array of any library, without its gradient."""
    library = namespace(array).name
    if library == "torch":
        array = array.detach().cpu()
    elif library == "drjit":
        array = sys.modules["drjit"].detach(array)
    return np.asarray(array, dtype=np.float64)


def common(**arrays) -> tuple:
    """The named arguments as numpy float64, or, if any of them is a torch tensor, as tensors like it.

    Raises
    ------
    ValueError
        Naming the arguments and their shapes.
    """
    torch = sys.modules.get("torch")
    tensors = [a for a in arrays.values() if torch is not None and torch.is_tensor(a)]
    like = max(tensors, key=lambda tensor: tensor.ndim, default=None)
    same = tuple(a if any(a is t for t in tensors) else as_like(a, like) for a in arrays.values())
    shapes = {name: tuple(a.shape) for name, a in zip(arrays, same, strict=True)}
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"expected shapes that broadcast against each other, got {found}") from None
    return same


def components(vectors):
    """The x, y, z arrays of vectors whose last axis has length 3 (numpy, torch)."""
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"expected vectors of shape (..., 3), got {tuple(vectors.shape)}")
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def stack(x, y, z):
    """The inverse of `components`, broadcasting the three arrays against each other."""
    if namespace(x, y, z).name == "torch":
        import torch

        return torch.stack(torch.broadcast_tensors(x, y, z), dim=-1)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)
