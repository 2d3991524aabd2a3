"""The fused feature lookup in Dr.Jit, forward and backward, joined to torch.

One kernel reads all scales and directions of a sample; its backward kernel adds the gradients of planes and vectors.
Nothing is kept between the two but the coordinates.
"""

from __future__ import annotations

import drjit as dr
import torch
from torch import Tensor

CHANNELS = 4


def lookup_drjit(factors, u: Tensor) -> Tensor:
    """Features (samples, scales * directions * channels); see `fields.factors.Factors.forward`.

    Raises
    ------
    ValueError
        If the field has another number of channels than the packets of the kernel.
    """
    if factors.channels != CHANNELS:
        raise ValueError(f"the fused lookup reads packets of {CHANNELS} channels, the field has {factors.channels}")
    return _Lookup.apply(factors.planes, factors.vectors, u, factors)


class _Lookup(torch.autograd.Function):
    """Explicit forward and backward, so that Dr.Jit keeps no graph."""

    @staticmethod
    def forward(ctx, planes: Tensor, vectors: Tensor, u: Tensor, factors) -> Tensor:
        ctx.save_for_backward(planes, vectors, u)
        ctx.factors = factors
        module = factors.device.module
        out = dr.zeros(module.Float, u.shape[0] * factors.num_features)
        sample = dr.arange(module.UInt, u.shape[0])
        coordinates = _columns(module, u)
        sources = _flat(module, planes), _flat(module, vectors)
        for place, cell in enumerate(factors.cells()):
            plane, vector, _ = _values(module, *sources, coordinates, cell)
            dr.scatter(out, plane * vector, sample * len(factors.tables) + place)
        return _host(out).reshape(u.shape[0], factors.num_features)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        planes, vectors, u = ctx.saved_tensors
        factors = ctx.factors
        module = factors.device.module
        Packet = module.Array4f
        to_planes, to_vectors = dr.zeros(module.Float, planes.numel()), dr.zeros(module.Float, vectors.numel())
        sample = dr.arange(module.UInt, u.shape[0])
        coordinates = _columns(module, u)
        sources = _flat(module, planes), _flat(module, vectors)
        incoming = _flat(module, gradient)
        for place, cell in enumerate(factors.cells()):
            plane, vector, ((rows_p, shares_p), (rows_v, shares_v)) = _values(module, *sources, coordinates, cell)
            g = dr.gather(Packet, incoming, sample * len(factors.tables) + place)
            for row, share in zip(rows_p, shares_p, strict=True):
                dr.scatter_add(to_planes, g * vector * share, row, mode=dr.ReduceMode.Expand)
            for row, share in zip(rows_v, shares_v, strict=True):
                dr.scatter_add(to_vectors, g * plane * share, row, mode=dr.ReduceMode.Expand)
        dr.eval(to_planes, to_vectors)
        return _host(to_planes).reshape(planes.shape), _host(to_vectors).reshape(vectors.shape), None, None


def _flat(module, tensor: Tensor):
    return module.Float(tensor.detach().contiguous().reshape(-1).numpy())


def _host(array) -> Tensor:
    """Torch keeps the field in host memory, wherever the kernels run; on LLVM nothing is copied."""
    return torch.from_numpy(array.numpy())


def _columns(module, u: Tensor):
    flat, index = _flat(module, u), dr.arange(module.UInt, u.shape[0]) * 3
    return [dr.gather(module.Float, flat, index + axis) for axis in range(3)]


def _nodes(module, x, cells: int):
    """Left and right node and the share of the right one; constant beyond the outer cell centres."""
    Float, UInt = module.Float, module.UInt
    x = dr.clip(x * float(cells) - 0.5, 0.0, cells - 1.0)
    left = dr.minimum(UInt(x), UInt(max(cells - 2, 0)))
    return left, dr.minimum(left + 1, UInt(cells - 1)), x - Float(left)


def _values(module, planes, vectors, coordinates, cell):
    """Plane and vector packets of one scale and direction, and the rows and shares that they came from."""
    axis, a, b, n, n_a, n_b, plane, vector = cell
    Packet = module.Array4f
    i0, i1, s = _nodes(module, coordinates[axis], n)
    a0, a1, s_a = _nodes(module, coordinates[a], n_a)
    b0, b1, s_b = _nodes(module, coordinates[b], n_b)
    rows_v, shares_v = (vector + i0, vector + i1), (1.0 - s, s)
    rows_p = (plane + b0 * n_a + a0, plane + b0 * n_a + a1, plane + b1 * n_a + a0, plane + b1 * n_a + a1)
    shares_p = ((1.0 - s_a) * (1.0 - s_b), s_a * (1.0 - s_b), (1.0 - s_a) * s_b, s_a * s_b)
    value_p = sum(dr.gather(Packet, planes, r) * w for r, w in zip(rows_p, shares_p, strict=True))
    value_v = sum(dr.gather(Packet, vectors, r) * w for r, w in zip(rows_v, shares_v, strict=True))
    return value_p, value_v, ((rows_p, shares_p), (rows_v, shares_v))
