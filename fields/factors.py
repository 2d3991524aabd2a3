"""Multi-scale planes times vectors: the tensor field's features (MDW-NeRF), in torch and as a fused lookup in Dr.Jit.

    N_n  = N_min b^(n-1),  b = (N_max / N_min)^(1/(L-1)),  n = 1..L
    G_n  = [v_n^m(x_m) * M_n^m(x_a, x_b)]  for each direction m with the other two axes a < b, element-wise products

A sample's features have the shape (scales L, directions D, channels F). Values between grid nodes are linear; nodes lie
at cell centres, so that a box of N cells has N nodes and its border half-cells are constant.

One kernel reads all scales and directions of a sample; its backward kernel adds the gradients of planes and vectors.
Nothing is kept between the two but the coordinates. On LLVM the gradient is the same to the last bit from run to run,
on any number of threads: a scale's cells are written by one SIMD packet alone, which goes through the samples in their
order. On CUDA atomic additions come in any order.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import drjit as dr
import numpy as np
import torch
from torch import Tensor, nn

from fields.device import Device


@dataclass(frozen=True)
class Grid:
    """Cells of one scale along x, y and z."""

    nx: int
    ny: int
    nz: int

    def along(self, axis: int) -> int:
        return (self.nx, self.ny, self.nz)[axis]


def geometric_scales(n_min: float, n_max: float, count: int) -> list[float]:
    """Resolutions N_n of L scales in geometric steps, from n_min to n_max inclusive.

    The paper prints b^n, which would start above N_min and overshoot N_max; b^(n-1) meets both.
    """
    if count == 1:
        return [float(n_max)]
    return [float(n_min * (n_max / n_min) ** (n / (count - 1))) for n in range(count)]


class Factors(nn.Module):
    """Planes and vectors of all scales and directions in two flat parameters, channels last, by torch's generator.

    ``grids``: list of Grid, coarse to fine. ``directions``: which of "x", "y", "z" have a vector; the plane spans the
    other two axes. ``channels``: a multiple of 4 for fused lookups. ``device``: Dr.Jit device for fused lookups;
    "torch" for the reference implementation.
    """

    def __init__(self, grids: list[Grid], directions: str, channels: int, device: Device):
        super().__init__()
        self.grids, self.directions, self.channels, self.device = list(grids), directions, channels, device
        self.tables: list[tuple[int, int, int, int, int]] = []
        planes = vectors = 0
        for grid in grids:
            for m in directions:
                axis, a, b = axes_of(m)
                self.tables.append((axis, a, b, planes, vectors))
                planes += grid.along(a) * grid.along(b)
                vectors += grid.along(axis)
        self.planes = nn.Parameter(0.1 * torch.randn(planes, channels))
        self.vectors = nn.Parameter(1.0 + 0.02 * torch.randn(vectors, channels))

    @property
    def num_features(self) -> int:
        """Scales times directions times channels."""
        return len(self.tables) * self.channels

    def cells(self) -> list[tuple[int, int, int, int, int, int, int, int]]:
        """Per scale and direction: axis, a, b, cells along each, first row in planes and in vectors."""
        rows = []
        for index, (axis, a, b, plane, vector) in enumerate(self.tables):
            grid = self.grids[index // len(self.directions)]
            rows.append((axis, a, b, grid.along(axis), grid.along(a), grid.along(b), plane, vector))
        return rows

    def forward(self, u: Tensor) -> Tensor:
        """Features (samples, scales * directions * channels) at box coordinates u (samples, 3) in [0, 1].

        Coordinates outside the box take the value at its border. No gradient flows to `u`.
        """
        if self.device.module is None or len(u) == 0:  # Dr.Jit launches nothing over nothing
            return lookup_torch(self, u.detach())
        if self.channels % PACKET:
            raise ValueError(
                f"the field has {self.channels} channels, but the fused lookup reads packets of {PACKET}: "
                f"take a multiple of {PACKET}, or the device torch"
            )
        return _Lookup.apply(self.planes, self.vectors, u, self)


def nodes_of(u: Tensor, cells: int) -> tuple[Tensor, Tensor, Tensor]:
    """Left node, right node and the share of the right one."""
    x = (u * cells - 0.5).clamp(0.0, cells - 1.0)
    left = x.floor().long().clamp(max=max(cells - 2, 0))
    return left, (left + 1).clamp(max=cells - 1), (x - left)[:, None]


def lookup_torch(factors: Factors, u: Tensor) -> Tensor:
    """Reference implementation of the fused lookup, in plain torch."""
    features = []
    for axis, a, b, n, n_a, n_b, plane, vector in factors.cells():
        i0, i1, s = nodes_of(u[:, axis], n)
        v = torch.lerp(factors.vectors[vector + i0], factors.vectors[vector + i1], s)
        a0, a1, s_a = nodes_of(u[:, a], n_a)
        b0, b1, s_b = nodes_of(u[:, b], n_b)
        low = torch.lerp(factors.planes[plane + b0 * n_a + a0], factors.planes[plane + b0 * n_a + a1], s_a)
        high = torch.lerp(factors.planes[plane + b1 * n_a + a0], factors.planes[plane + b1 * n_a + a1], s_a)
        features.append(v * torch.lerp(low, high, s_b))
    return torch.cat(features, dim=1)


def anisotropic_grids(size: np.ndarray, finest_cell: np.ndarray, coarsening: float, count: int) -> list[Grid]:
    """Grids of a box of ``size`` (3,) [m] whose finest cells measure ``finest_cell`` (3,) [m].

    The coarsest cells are ``coarsening`` times as long; steps between are geometric. At least two cells along an axis.
    """
    grids = []
    for scale in geometric_scales(1.0 / coarsening, 1.0, count):
        cells = np.maximum(np.round(size / finest_cell * scale), 2).astype(int)
        grids.append(Grid(int(cells[0]), int(cells[1]), int(cells[2])))
    return grids


_AXES = {"x": (0, 1, 2), "y": (1, 0, 2), "z": (2, 0, 1)}
PACKET = 4  # Numbers that a kernel reads and writes at once


def axes_of(direction: str) -> tuple[int, int, int]:
    """Axes of the vector and of the plane's columns and rows, for a direction "x", "y" or "z"."""
    return _AXES[direction]


class _Lookup(torch.autograd.Function):
    """Explicit forward and backward, so that Dr.Jit keeps no graph."""

    @staticmethod
    def forward(ctx, planes: Tensor, vectors: Tensor, u: Tensor, factors) -> Tensor:
        ctx.save_for_backward(planes, vectors, u)
        ctx.factors = factors
        field = _Field(factors, planes, vectors)
        out = dr.empty(field.module.Float, u.shape[0] * factors.num_features)
        sample = dr.arange(field.module.UInt, u.shape[0])
        point = _point(field.module, flat_on(field.module, u), sample, True)
        for scale in range(field.scales):
            for place, read in enumerate(field.reads(field.literal(scale), point, True)):
                for part in range(field.packets):
                    plane, vector = read.values(part)
                    dr.scatter(out, plane * vector, field.packet(sample, scale, place, part))
        return as_torch(out, u).reshape(u.shape[0], factors.num_features)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        planes, vectors, u = ctx.saved_tensors
        module = ctx.factors.device.module
        field = _Field(ctx.factors, planes, vectors)
        sums = dr.zeros(module.Float, planes.numel()), dr.zeros(module.Float, vectors.numel())
        dr.eval(sums)
        add = _add_in_order if ctx.factors.device.name == "llvm" else _add_in_any_order
        add(field, flat_on(module, u), flat_on(module, gradient), u.shape[0], sums)
        dr.eval(sums)
        to_planes, to_vectors = (as_torch(s, planes) for s in sums)
        return to_planes.reshape(planes.shape), to_vectors.reshape(vectors.shape), None, None


class _Field:
    """Planes and vectors on the device, and where each scale and direction lies in them."""

    def __init__(self, factors, planes: Tensor, vectors: Tensor):
        self.module, self.directions = factors.device.module, factors.directions
        self.scales, self.packets = len(factors.grids), factors.channels // PACKET
        self.planes, self.vectors = flat_on(self.module, planes), flat_on(self.module, vectors)
        # Per scale: cells along x, y and z, then the first plane and vector row of each direction.
        firsts = np.array(factors.tables)[:, 3:].reshape(self.scales, -1)
        self.layout = np.column_stack([[(g.nx, g.ny, g.nz) for g in factors.grids], firsts]).astype(np.uint32)

    def literal(self, scale: int) -> list:
        """A scale's layout as constants of the kernel."""
        return [self.module.UInt(int(number)) for number in self.layout[scale]]

    def gather(self, scale) -> list:
        """The same of a scale that only the kernel knows."""
        flat, columns = self.module.UInt(self.layout.ravel()), self.layout.shape[1]
        return [dr.gather(self.module.UInt, flat, scale * columns + k) for k in range(columns)]

    def packet(self, sample, scale, place: int, part):
        """Packet of the features that holds a part of a direction's channels."""
        return ((sample * self.scales + scale) * len(self.directions) + place) * self.packets + part

    def reads(self, layout: list, point: list, active) -> Iterator[_Read]:
        """Lookups of each direction in one scale at a point."""
        nodes = [_nodes(self.module, x, cells) for x, cells in zip(point, layout[:3], strict=True)]
        for place, direction in enumerate(self.directions):
            axis, a, b = axes_of(direction)
            yield _Read(
                self, layout[3 + 2 * place : 5 + 2 * place], (nodes[axis], nodes[a], nodes[b]), layout[a], active
            )


class _Read:
    """The rows about one point of one plane and its vector, and their shares."""

    def __init__(self, field: _Field, firsts: list, nodes: tuple, n_a, active):
        self.field, self.active = field, active
        (i0, i1, self.share), (a0, a1, self.share_a), (b0, b1, self.share_b) = nodes
        low, high = firsts[0] + b0 * n_a, firsts[0] + b1 * n_a
        self.plane_rows = low + a0, low + a1, high + a0, high + a1
        self.vector_rows = firsts[1] + i0, firsts[1] + i1

    def values(self, part):
        """Packets of the plane and of the vector."""
        low, low_right, high, high_right = (self._row(self.field.planes, row, part) for row in self.plane_rows)
        low, high = _lerp(low, low_right, self.share_a), _lerp(high, high_right, self.share_a)
        left, right = (self._row(self.field.vectors, row, part) for row in self.vector_rows)
        return _lerp(low, high, self.share_b), _lerp(left, right, self.share)

    def add(self, sums: tuple, incoming, part, mode) -> None:
        """Add what an incoming gradient gives to the rows of the plane and of the vector."""
        plane, vector = self.values(part)
        low, high = _split(incoming * vector, self.share_b)
        parts = *_split(low, self.share_a), *_split(high, self.share_a)
        for target, rows, values in (
            (sums[0], self.plane_rows, parts),
            (sums[1], self.vector_rows, _split(incoming * plane, self.share)),
        ):
            for row, value in zip(rows, values, strict=True):
                dr.scatter_add(target, value, row * self.field.packets + part, self.active, mode=mode)

    def _row(self, source, row, part):
        return dr.gather(self.field.module.Array4f, source, row * self.field.packets + part, self.active)


def _add_in_order(field: _Field, u, gradient, samples: int, sums: tuple) -> None:
    """Gradients of planes and vectors, added in the order of the samples by a launch of a few wide packets.

    Packets share out the scales (and the parts of their channels), and each goes through all samples, as many at a time
    as it has lanes. No two of them write to the same row, a packet runs on one thread, and Dr.Jit adds its lanes' rows
    one after the other: nothing has to be atomic, and the sums do not depend on the order of threads.
    """
    UInt = field.module.UInt
    lanes, units = _lanes(field.module), field.scales * field.packets
    workers = min(dr.thread_count(), units)
    index = dr.arange(UInt, workers * lanes)
    lane, num = index % lanes, dr.opaque(UInt, samples)

    def one_unit(unit):
        scale, part = unit // field.packets, unit % field.packets
        layout = field.gather(scale)

        def some_samples(sample):
            active = sample < num
            point = _point(field.module, u, sample, active)
            for place, read in enumerate(field.reads(layout, point, active)):
                packet = field.packet(sample, scale, place, part)
                incoming = dr.gather(field.module.Array4f, gradient, packet, active)
                read.add(sums, incoming, part, dr.ReduceMode.NoConflicts)
            return (sample + lanes,)

        # Lanes leave the loop together: a packet continues while its first lane has a sample.
        dr.while_loop((UInt(lane),), lambda sample: sample - lane < num, some_samples, mode="symbolic")
        return (unit + workers,)

    dr.while_loop((index // lanes,), lambda unit: unit < units, one_unit, mode="symbolic")


def _add_in_any_order(
    field: _Field, u, gradient, samples: int, sums: tuple, *, mode: dr.ReduceMode = dr.ReduceMode.Auto
) -> None:
    """Gradients of planes and vectors by atomic additions, a thread for each sample."""
    sample = dr.arange(field.module.UInt, samples)
    point = _point(field.module, u, sample, True)
    for scale in range(field.scales):
        for place, read in enumerate(field.reads(field.literal(scale), point, True)):
            for part in range(field.packets):
                packet = field.packet(sample, scale, place, part)
                incoming = dr.gather(field.module.Array4f, gradient, packet)
                read.add(sums, incoming, part, mode)


@cache
def _lanes(module) -> int:
    """Lanes of a SIMD packet of LLVM, read from a kernel: Dr.Jit has no other way to get them."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.eval(dr.opaque(module.Float, 1.0, 2) + 1.0)
        text = dr.kernel_history((dr.KernelType.JIT,))[-1]["ir"].read()
    found = re.search(r"<(\d+) x float>", text)
    if found is None:
        raise RuntimeError("a kernel of Dr.Jit has no packet of floats: expected <N x float> in the code for LLVM")
    return int(found[1])


def flat_on(module, tensor: Tensor):
    """The numbers of a tensor on the device of the kernels; not copied on LLVM, nor from a CUDA tensor to CUDA."""
    flat = tensor.detach().contiguous().reshape(-1)
    if not flat.is_cuda:
        return module.Float(flat.numpy())
    # The two libraries work in streams of their own.
    torch.cuda.current_stream().synchronize()
    return module.Float(flat)


def as_torch(array, like: Tensor) -> Tensor:
    """An array of the kernels as a tensor where another one lies: in host memory, or that of the device."""
    if not like.is_cuda:
        return torch.from_numpy(array.numpy())
    dr.eval(array)
    dr.sync_thread()
    return array.torch()


def _point(module, u, sample, active) -> list:
    return [dr.gather(module.Float, u, sample * 3 + axis, active) for axis in range(3)]


def _nodes(module, x, cells):
    """Left and right node and the share of the right one; constant beyond the outer cell centres."""
    number = module.Float(cells)
    x = dr.clip(x * number - 0.5, 0.0, number - 1.0)
    left = dr.minimum(module.UInt(x), dr.maximum(cells, 2) - 2)
    return left, dr.minimum(left + 1, cells - 1), x - module.Float(left)


def _lerp(left, right, share):
    return dr.fma(right - left, share, left)


def _split(value, share):
    """Shares of a gradient for the left and the right of two nodes."""
    right = value * share
    return value - right, right
