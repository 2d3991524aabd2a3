"""Which twin of the sweep's inner loops runs on a device: Dr.Jit's or torch's. Only the one asked for is imported."""

from __future__ import annotations

from types import ModuleType

from fields.device import Device


def warping(device: Device) -> ModuleType:
    """`fields.sweep.warping_drjit` or `fields.sweep.warping_torch`: the same functions with the same signatures."""
    if device.module is None:
        from fields.sweep import warping_torch

        return warping_torch
    from fields.sweep import warping_drjit

    return warping_drjit


def scoring(device: Device) -> ModuleType:
    """`fields.sweep.scoring_drjit` or `fields.sweep.scoring_torch`: the same functions with the same signatures."""
    if device.module is None:
        from fields.sweep import scoring_torch

        return scoring_torch
    from fields.sweep import scoring_drjit

    return scoring_drjit
