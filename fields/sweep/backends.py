"""Which twin of the sweep's inner loops runs on a device: Dr.Jit's or torch's. Only the one asked for is imported."""

from __future__ import annotations

import importlib
from types import ModuleType

from fields.device import Device


def warping(device: Device) -> ModuleType:
    """`fields.sweep.warping_drjit` or `fields.sweep.warping_torch`: the same functions with the same signatures."""
    return importlib.import_module(f"fields.sweep.warping_{_library(device)}")


def scoring(device: Device) -> ModuleType:
    """`fields.sweep.scoring_drjit` or `fields.sweep.scoring_torch`: the same functions with the same signatures."""
    return importlib.import_module(f"fields.sweep.scoring_{_library(device)}")


def _library(device: Device) -> str:
    return "torch" if device.module is None else "drjit"
