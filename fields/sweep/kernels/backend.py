"""The backends of the kernels, Dr.Jit and torch: modules that mypy checks against one Protocol.

Only the one that a device needs is imported.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from fields.device import Device
from fields.sweep.kernels.stack import Hypotheses, ViewStack


class Kernels(Protocol):
    """Kernels on flat arrays of a device; `drjit_kernels` and `drjit_scoring` say what each does."""

    SAMPLES_PER_LAUNCH: int
    NOISE_VARIANCE: float

    def rays_of_rows(self, stack: ViewStack, view: int, first_row: int, rows: int) -> Any: ...

    def rays_of_pixels(self, stack: ViewStack, view: int, pixels: Any) -> Any: ...

    def rays_and_heights(self, stack: ViewStack, view: int, pixels: Any) -> Any: ...

    def project_rays(self, stack: ViewStack, rays: Any, z: Any, view: int) -> Any: ...

    def sample(self, stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> Any: ...

    def sample_packed(self, stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> Any: ...

    def buffers(self, device: Device, count: int, size: int) -> list[Any]: ...

    def warp(
        self, values: list[Any], stack: ViewStack, rays: Any, hypotheses: Hypotheses, neighbours: list[int]
    ) -> None: ...

    def windows(self, device: Device, reference: Any, values: list[Any], width: int, radius: int) -> Any: ...

    def ncc(self, windows: Any, radius: int, least_known: float = 1.0) -> list[Any]: ...

    def best_half(self, device: Device, scores: list[Any]) -> Any: ...

    def best_height(self, device: Device, mean: Any, start: Any, step: float, count: int) -> tuple[Any, Any, Any]: ...

    def compare_heights(
        self, stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: Any | None = None
    ) -> tuple[Any, Any, Any]: ...

    def count_seeing_through(self, stack: ViewStack, view: int, peers: list[int], tolerance: float) -> Any: ...

    def find_duplicates(
        self, stack: ViewStack, rays: Any, own_height: Any, other: int, tolerance: float, close_m: float
    ) -> tuple[np.ndarray, np.ndarray]: ...

    def vote_on_points(
        self, stack: ViewStack, points: tuple, view: int, close_m: float, sure: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


def kernels(device: Device) -> Kernels:
    """The kernels of a device."""
    if device.module is None:
        from fields.sweep.kernels import torch_kernels

        return torch_kernels
    from fields.sweep.kernels import drjit_kernels

    return drjit_kernels
