"""The functions of `refract._array.namespace` in torch; imported only where torch is already."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch

from refract._solvers import SOLVERS, SURFACES


def transformed() -> bool:
    """Whether torch.func, forward-mode derivatives or torch.compile are tracing, so that tensors may have no values.

    A tensor under vmap cannot be asked for its tangent, so this asks torch itself whether a transform is open.
    """
    return (
        torch.compiler.is_compiling()
        or torch.autograd.forward_ad._current_level >= 0
        or torch._C._functorch.peek_interpreter_stack() is not None
    )


def as_tensor(x, like):
    return x if torch.is_tensor(x) else torch.as_tensor(x, dtype=like.dtype, device=like.device)


def pair(function):
    def call(a, b):
        like = a if torch.is_tensor(a) else b
        return function(as_tensor(a, like), as_tensor(b, like))

    return call


def if_tensor(function):
    return lambda x, *more: function(x, *more) if torch.is_tensor(x) else x


def fma(a, b, c):
    """Fused multiply-add: one pass over memory, where the types allow it."""
    if not torch.is_tensor(c):
        return a * b + c
    if not torch.is_tensor(b):
        a, b = b, a
    if not torch.is_tensor(a):
        return torch.add(c, b, alpha=a) if torch.is_tensor(b) else c + a * b
    alike = a.dtype == b.dtype == c.dtype and a.shape == b.shape == c.shape
    return torch.addcmul(c, a, b) if alike else a * b + c


def tracked(*arrays) -> bool:
    return transformed() or (torch.is_grad_enabled() and any(torch.is_tensor(x) and x.requires_grad for x in arrays))


def same(mask) -> bool | None:
    if transformed() or mask.device.type != "cpu":
        return None
    return True if mask.all() else None if mask.any() else False


NAMESPACE = SimpleNamespace(
    name="torch", sqrt=torch.sqrt, sin=torch.sin, cos=torch.cos, atan=torch.atan, exp=torch.exp, isnan=torch.isnan,
    where=torch.where, minimum=pair(torch.minimum), maximum=pair(torch.maximum), abs=torch.abs,
    rsqrt=torch.rsqrt, fma=fma,
    double=if_tensor(torch.Tensor.double),
    integer=torch.Tensor.long,
    like=if_tensor(lambda x, other: x.to(other.dtype)),
    eps=lambda x: torch.finfo(x.dtype).eps,
    orders=2,
    fixed=if_tensor(torch.Tensor.detach), tracked=tracked, same=same,
)  # fmt: skip


@torch.library.custom_op(
    "refract::solve", mutates_args=(), schema="(str name, str kind, Tensor[] numbers, Tensor[] arrays) -> Tensor[]"
)
def _solve(name, kind, numbers, arrays):
    surface = SURFACES[kind](*(number.detach().cpu().numpy() for number in numbers))
    with np.errstate(all="ignore"):  # the numpy of what torch.compile calls is not `quiet`
        found = SOLVERS[name][1](surface, *(array.detach().cpu().numpy() for array in arrays))
    return [torch.tensor(each, dtype=arrays[0].dtype, device=arrays[0].device) for each in found]


@_solve.register_fake
def _(name, kind, numbers, arrays):
    return [arrays[0].new_empty(arrays[0].shape) for _ in range(SOLVERS[name][0])]


@_solve.register_vmap
def _(info, in_dims, name, kind, numbers, arrays):
    def row(tensors, dims, at):
        return [t if dim is None else t.select(dim, at) for t, dim in zip(tensors, dims, strict=True)]

    rows = [
        _solve(name, kind, row(numbers, in_dims[2], at), row(arrays, in_dims[3], at)) for at in range(info.batch_size)
    ]
    outputs = [torch.stack(each) for each in zip(*rows, strict=True)]
    return outputs, [0] * len(outputs)


def solve(name: str, kind: str, numbers, arrays) -> tuple:
    """Result of a solver (`refract._solvers`) as tensors like the first of `arrays`, without derivatives.

    A custom operator of torch: torch.compile does not trace into it, and vmap calls it once for each row.
    """
    like = arrays[0]
    # torch.compile treats numpy arrays as tensors, but does not support their methods.
    numbers = [torch.as_tensor(number, dtype=torch.float64, device=like.device).detach() for number in numbers]
    return tuple(_solve(name, kind, numbers, [array.detach() for array in arrays]))
