"""The density weighting network (DWN) in Dr.Jit, forward and backward, joined to torch: one row a sample and scale.

    gate = GELU(W3 GELU(W2 GELU(W1 a + b1) + b2) + b3),  density of a row = fine . sum over directions of gate * a

Its maps are too small for matrix routines: in torch nearly all of the time goes to moving the rows about. Gradients of
the weights are summed per lane over every so many rows, then over the lanes: the same from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import drjit as dr
import torch
from torch import Tensor

from fields.factors import PACKET, as_torch, flat_on

# Lanes of the backward kernel per scale: few sums to add up at the end, yet enough packets for the processors.
LANES = {"llvm": 256, "cuda": 8192}


def weighted_drjit(
    features: Tensor, layers: Sequence[tuple[Tensor, Tensor]], fine: Tensor, shape: tuple, device
) -> Tensor:
    """Density (samples,) of features (samples, L D F), without the bias of the last map.

    Raises ValueError if F is not a multiple of the kernel's packets. ``layers``: weight and bias of the three maps of
    the gate; ``fine`` (1, L F); ``shape`` (L, D, F).
    """
    if shape[2] % PACKET:
        raise ValueError(
            f"the head weighs {shape[2]} channels, but its kernel reads packets of {PACKET}: "
            f"take a multiple of {PACKET}, or the device torch"
        )
    sizes = [(weight.shape[0], weight.shape[1]) for weight, _ in layers]
    flat = torch.cat([t.reshape(-1) for layer in (*layers, (fine,)) for t in layer])
    return _Weighting.apply(features, flat, _Gate(device, shape, sizes)).sum(dim=1)


class _Weighting(torch.autograd.Function):
    """Density of each row (samples, L) from features and the flat parameters."""

    @staticmethod
    def forward(ctx, features: Tensor, flat: Tensor, gate: _Gate) -> Tensor:
        ctx.save_for_backward(features, flat)
        ctx.gate = gate
        row = dr.arange(gate.module.UInt, features.shape[0] * gate.scales)
        a = gate.read(flat_on(gate.module, features), row, True)
        layers, fine = gate.load(flat_on(gate.module, flat), row % gate.scales)
        gates, _ = gate.run(layers, a)
        return as_torch(_dot(gate.summed(a, gates[-1]), fine, 0.0), features).reshape(-1, gate.scales)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        features, flat = ctx.saved_tensors
        gate = ctx.gate
        to_features, to_flat = gate.gradients(features, flat, gradient)
        return to_features.reshape(features.shape), to_flat, None


class _Gate:
    """The network of one row."""

    def __init__(self, device, shape: tuple, sizes: list[tuple[int, int]]):
        self.device, self.module, self.sizes = device, device.module, sizes
        self.of_maps = sum(outputs * (inputs + 1) for outputs, inputs in sizes)
        self.scales, self.directions, self.channels = shape
        self.packets = self.directions * self.channels // PACKET

    def read(self, source, row, active) -> list:
        """Numbers of a row, direction by direction."""
        packets = [dr.gather(self.module.Array4f, source, row * self.packets + p, active) for p in range(self.packets)]
        return [number for packet in packets for number in packet]

    def load(self, flat, scale) -> tuple[list, list]:
        """Weights and biases of the maps, and the last map's weights for this scale."""
        Float, UInt = self.module.Float, self.module.UInt
        layers, first = [], UInt(0)
        for outputs, inputs in self.sizes:
            numbers = [dr.gather(Float, flat, first + k) for k in range(outputs * (inputs + 1))]
            layers.append((numbers[: outputs * inputs], numbers[outputs * inputs :]))
            first = first + len(numbers)
        fine = [dr.gather(Float, flat, self.of_maps + scale * self.channels + c) for c in range(self.channels)]
        return layers, fine

    def run(self, layers: list, a: list) -> tuple[list, list]:
        """Forward pass of a row through each map, and the slopes of its GELU."""
        values: list[Sequence] = [a]
        slopes: list[Sequence] = []
        for weights, biases in layers:
            x = values[-1]
            sums = [_dot(weights[j * len(x) : (j + 1) * len(x)], x, bias) for j, bias in enumerate(biases)]
            value, slope = zip(*(_gelu(s) for s in sums), strict=True)
            values.append(value)
            slopes.append(slope)
        return values, slopes

    def summed(self, a: list, gate: list) -> list:
        """Weighted features summed over directions (F)."""
        return [
            _dot(a[c + self.channels :: self.channels], gate[c + self.channels :: self.channels], a[c] * gate[c])
            for c in range(self.channels)
        ]

    def gradients(self, features: Tensor, flat: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of the features and of the flat parameters."""
        Float, UInt, module = self.module.Float, self.module.UInt, self.module
        source, incoming, parameters = (flat_on(module, t) for t in (features, gradient, flat))
        lanes = LANES[self.device.name] * self.scales  # a multiple of the scales: each lane stays with one
        lane, num = dr.arange(UInt, lanes), dr.opaque(UInt, gradient.numel())
        to_features = dr.empty(Float, features.numel())
        zeros = [dr.zeros(Float, lanes) for _ in range(self.of_maps + self.channels)]

        def one_row(row, sums):
            active = row < num
            layers, fine = self.load(parameters, lane % self.scales)
            outside, to_a, to_sums = self._row(
                layers, fine, self.read(source, row, active), dr.gather(Float, incoming, row, active)
            )
            for p in range(self.packets):
                packet = module.Array4f(to_a[p * PACKET : (p + 1) * PACKET])
                dr.scatter(to_features, packet, row * self.packets + p, active)
            return row + lanes, [dr.fma(x, y, s) for s, (x, y) in zip(sums, [*to_sums, *outside], strict=True)]

        _, sums = dr.while_loop((UInt(lane), zeros), lambda row, _: row < num, one_row, mode="symbolic")
        # In one array: each that goes to torch waits for the device.
        joint = as_torch(dr.concat(sums), flat).reshape(len(sums), -1, self.scales)
        per_scale = joint.sum(dim=1)
        maps, fine = per_scale[: self.of_maps], per_scale[self.of_maps :]
        to_flat = torch.cat([maps.sum(dim=1), fine.T.reshape(-1)])
        return as_torch(to_features, features), to_flat

    def _row(self, layers: list, fine: list, a: list, incoming) -> tuple[list, list, list]:
        """Backwards through a row: pairs whose products belong to the last map, to the others, and what goes to `a`."""
        values, slopes = self.run(layers, a)
        gate = values[-1]
        outside = [(total, incoming) for total in self.summed(a, gate)]
        to_weighted = [f * incoming for f in fine] * self.directions
        to_a = [g * w for g, w in zip(gate, to_weighted, strict=True)]
        delta = [x * w for x, w in zip(a, to_weighted, strict=True)]
        pairs: list[tuple] = []
        for k in reversed(range(len(layers))):
            delta = [d * slope for d, slope in zip(delta, slopes[k], strict=True)]
            weights, x = layers[k][0], values[k]
            pairs = [(d, number) for d in delta for number in x] + [(d, 1.0) for d in delta] + pairs
            delta = [_dot(weights[i :: len(x)], delta, 0.0) for i in range(len(x))]
        return outside, [t + d for t, d in zip(to_a, delta, strict=True)], pairs


def _dot(left: Sequence, right: Sequence, start):
    for x, y in zip(left, right, strict=True):
        start = dr.fma(x, y, start)
    return start


def _gelu(x):
    """GELU x Phi(x), and its slope Phi(x) + x phi(x).

    The tail of the normal law by Abramowitz and Stegun, 7.1.26, within 1e-7; its exponential serves the slope as well.
    """
    bell = dr.exp(-0.5 * x * x)
    t = dr.rcp(dr.fma(dr.abs(x), 0.3275911 / sqrt(2.0), 1.0))
    series = 0.5 * 1.061405429
    for coefficient in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        series = dr.fma(series, t, 0.5 * coefficient)
    tail = series * t * bell
    phi = dr.select(x > 0.0, 1.0 - tail, tail)
    return x * phi, dr.fma(x * 0.3989422804014327, bell, phi)
