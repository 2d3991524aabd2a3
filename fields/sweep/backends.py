"""Which twin of the sweep's loops runs on a device. Only the one asked for is imported."""

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


def images(device: Device) -> ModuleType:
    """`fields.sweep.images_host` or `fields.sweep.images_device`: the same functions with the same signatures."""
    if device.apart:
        from fields.sweep import images_device

        return images_device
    from fields.sweep import images_host

    return images_host


def scoring(device: Device) -> ModuleType:
    """`fields.sweep.scoring_drjit` or `fields.sweep.scoring_torch`: the same functions with the same signatures."""
    if device.module is None:
        from fields.sweep import scoring_torch

        return scoring_torch
    from fields.sweep import scoring_drjit

    return scoring_drjit
