"""The functions of `refract._array.namespace` in torch; imported only where torch is already."""

from types import SimpleNamespace

import torch


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
    like=if_tensor(lambda x, other: x.to(other.dtype)),
    eps=lambda x: torch.finfo(x.dtype).eps,
    orders=2,
    fixed=if_tensor(torch.Tensor.detach), tracked=tracked, same=same,
    none=lambda mask: not transformed() and not mask.any(),
)  # fmt: skip
