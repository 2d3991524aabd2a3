"""Devices with their images in their own memory between the kernels of the sweep, as CUDA devices have them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fields.device import Device, choose_device


def device_apart(wanted: str) -> Device:
    """A device by the way of CUDA, which LLVM compiles and torch runs as well; skips where there is no LLVM."""
    chosen = choose_device(wanted)
    if wanted == "cpu" and chosen.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {chosen.reason}")
    return replace(chosen, name="torch" if chosen.module is None else "cuda", has_own_memory=True)
