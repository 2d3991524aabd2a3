"""Backends of the inner loops, Dr.Jit on CUDA, Dr.Jit on LLVM or torch, and the number of threads of torch."""

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

# Dr.Jit loads older ones too, but up to 16 LLVM has no x86 code for its minimum and maximum and ends the process.
_OLDEST_LLVM = 17
_LLVM_VERSIONS = (19, 20, 18, 17)


@dataclass(frozen=True)
class Device:
    """Array types of one Dr.Jit backend, or of none."""

    name: str  # "cuda", "llvm" or "torch"
    module: Any  # the Dr.Jit module with Float, UInt, ... ; None for torch.
    reason: str  # why this one, in words for the plan.
    place: str = "cpu"  # "cpu" or "cuda": where torch keeps its tensors


def _find_llvm() -> str | None:
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        return os.environ["DRJIT_LIBLLVM_PATH"]
    for version in _LLVM_VERSIONS:
        hits = sorted(Path("/usr/lib").glob(f"*-linux-gnu/libLLVM*{version}*.so*"))
        hits += sorted(Path("/usr/lib").glob(f"llvm-{version}/lib/libLLVM*.so*"))
        # Asks ldconfig and a compiler, which takes a third of a second.
        found = str(hits[0]) if hits else ctypes.util.find_library(f"LLVM-{version}")
        if found:
            return found
    if sys.platform == "darwin":
        roots = (Path("/opt/homebrew/opt"), Path("/usr/local/opt"))
        dylibs = [path for root in roots for path in root.glob("llvm*/lib/libLLVM.dylib")]
        return str(dylibs[0]) if dylibs else None
    return None


def _drjit():
    """The module, or None where it cannot be loaded: without libatomic its import ends in a NameError."""
    try:
        import drjit as dr
    except (ImportError, NameError):
        return None
    return dr


def _cuda() -> Device | None:
    dr = _drjit()
    if dr is None or not dr.has_backend(dr.JitBackend.CUDA):
        return None
    import drjit.cuda as module

    return Device("cuda", module, "a CUDA device is there", "cuda")


def _llvm() -> Device | None:
    path = _find_llvm()
    if path is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = path
    dr = _drjit()
    if dr is None or not dr.has_backend(dr.JitBackend.LLVM) or dr.detail.llvm_version()[0] < _OLDEST_LLVM:
        return None
    import drjit.llvm as module

    return Device("llvm", module, f"no CUDA device requested or found; LLVM at {path or 'its default place'}")


@cache
def memory_bytes(device: Device) -> int:
    """Memory [bytes] of a CUDA device, by its driver; 0 of the others, and where it is unknown."""
    if device.place != "cuda":
        return 0
    number, found = ctypes.c_int(), ctypes.c_size_t()
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return 0
    failed = driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(number), 0)
    failed = failed or driver.cuDeviceTotalMem_v2(ctypes.byref(found), number)
    return 0 if failed else found.value


def tensor_place(device: Device) -> str:
    """Place of fields in torch for a device: the host where this build of torch has no CUDA."""
    import torch

    return device.place if torch.cuda.is_available() else "cpu"


@cache
def choose_device(wanted: str = "auto") -> Device:
    """The backend for the inner loops.

    Raises ValueError if CUDA is requested but not available, or the word is unknown. ``wanted``: "auto" takes CUDA,
    then LLVM, then torch; "cpu" LLVM, then torch.
    """
    if wanted not in ("auto", "cpu", "cuda", "torch"):
        raise ValueError(f"device is {wanted!r}, expected auto, cpu, cuda or torch")
    if wanted in ("auto", "cuda"):
        found = _cuda()
        if found is not None:
            return found
        if wanted == "cuda":
            raise ValueError("device is cuda, but Dr.Jit finds no CUDA device; use --device cpu")
    if wanted != "torch":
        found = _llvm()
        if found is not None:
            return found
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    why = (
        f"{path} is not LLVM {_OLDEST_LLVM} or newer that Dr.Jit can load"
        if path
        else f"no libLLVM {_OLDEST_LLVM} or newer was found (DRJIT_LIBLLVM_PATH takes its full path)"
    )
    import torch

    place = "cuda" if torch.cuda.is_available() and wanted != "cpu" else "cpu"
    reason = "torch was requested" if wanted == "torch" else f"{why}: torch runs the sweep, slower"
    return Device("torch", None, reason, place)


@contextmanager
def half_the_threads() -> Iterator[None]:
    """Halve torch's threads: they synchronise hundreds of times per step.

    A thread that has to share its core, with Dr.Jit's or with another program, holds up the others for a time slice
    each: on two cores, one of them taken, two threads need 5 times as long as one (25 times for small batches).
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(max(before // 2, 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)
