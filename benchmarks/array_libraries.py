"""The array libraries that the optics run on, for benchmarks: how arrays get in and out of them, and how to wait."""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit
import numpy as np
import torch

BUDGET_S = 0.4  # per figure: as many rounds as fit, two at least; the best one counts
STREAM = 1 << 22  # 16 MB an array: eight of them are far beyond the caches
CHAINS, LENGTH = 12, 64
_SIMPLE = {"fadd", "fsub", "fmul", "fneg", "fpext", "fptrunc", "fma", "rsqrt14", "rcp14", "fabs"}
_OPERATION = re.compile(r"= (?:(f\w+)|.*?call.*?@llvm\.(?:x86\.avx512\.)?(\w+))[ .].*?<\d+ x (float|double)>")


@dataclass(frozen=True)
class Library:
    """One array library at one precision.

    Attributes
    ----------
    name : str
    vectors, numbers : from numpy (K, 3) and (K,) into the library
    back : vectors of the library to float64 (K, 3)
    finish : waits until results are there
    backward : of vectors and a function of them: the gradient of the sum of its vectors; None without gradients
    """

    name: str
    vectors: Callable[[np.ndarray], Any]
    numbers: Callable[[np.ndarray], Any]
    back: Callable[[Any], np.ndarray]
    finish: Callable[[Any], None]
    backward: Callable[[Any, Callable], None] | None


def libraries() -> Iterator[Library]:
    """All that are installed; Dr.Jit on each backend that it finds."""
    yield Library("numpy float64", np.asarray, np.asarray, np.asarray, _nothing, None)
    for bits in (32, 64):
        yield _torch(bits)
    for backend in (drjit.JitBackend.LLVM, drjit.JitBackend.CUDA):
        if drjit.has_backend(backend):
            for bits in (32, 64):
                yield _drjit(backend, bits)


def _nothing(result) -> None:
    """Results of numpy and of torch on the CPU are there when the call returns."""


def _torch(bits: int) -> Library:
    dtype = getattr(torch, f"float{bits}")

    def array(values):
        return torch.tensor(values, dtype=dtype)

    def backward(points, function):
        function(points.detach().requires_grad_()).sum().backward()

    return Library(f"torch float{bits}", array, array, lambda v: v.double().numpy(), _nothing, backward)


def _drjit(backend, bits: int) -> Library:
    module = (drjit.llvm if backend == drjit.JitBackend.LLVM else drjit.cuda).ad
    suffix = "64" if bits == 64 else ""
    Vector, Float = getattr(module, f"Array3f{suffix}"), getattr(module, f"Float{suffix}")

    def finish(result):
        drjit.eval(result)
        drjit.sync_thread()

    def backward(points, function):
        leaf = Vector(drjit.detach(points))
        drjit.enable_grad(leaf)
        drjit.backward(sum(function(leaf)))
        finish(drjit.grad(leaf))

    return Library(
        f"Dr.Jit float{bits} ({backend.name})",
        lambda v: Vector(np.ascontiguousarray(v.T, f"float{bits}")),
        lambda v: Float(np.ascontiguousarray(v, f"float{bits}")),
        lambda v: np.asarray(v, np.float64).T,
        finish,
        backward,
    )


def seconds(run: Callable[[], None]) -> float:
    """The best time of a call, after one that compiles."""
    run()
    best, started, rounds = math.inf, time.perf_counter(), 0
    while rounds < 2 or time.perf_counter() - started < BUDGET_S:
        start = time.perf_counter()
        run()
        best, rounds = min(best, time.perf_counter() - start), rounds + 1
    return best


@dataclass(frozen=True)
class Limits:
    """Bytes a second of a copy, and seconds an operation, over all cores, by (kind, precision)."""

    copy: float
    operation: dict[tuple[str, str], float]


def measure_limits() -> Limits:
    """Limits of this machine, in Dr.Jit on LLVM."""
    from drjit.llvm import Float, Float64

    arrays = [drjit.full(Float, float(k), STREAM) for k in range(4)]
    drjit.make_opaque(arrays)
    copy = 8 * 4 * STREAM / seconds(lambda: _finish([a + 1.0 for a in arrays]))
    operation = {}
    for precision, Type in (("float", Float), ("double", Float64)):
        start = drjit.opaque(Type, 1.5, 1 << 17)
        for kind, step in (
            ("fma", lambda x: drjit.fma(x, 0.75, 0.5)),
            ("sqrt", drjit.sqrt),
            ("fdiv", lambda x: 3.0 / x),
        ):
            operation[kind, precision] = _chains(start, step)
    return Limits(copy, operation)


def _finish(result: Any) -> None:
    drjit.eval(result)
    drjit.sync_thread()


def _chains(start, step: Callable) -> float:
    """Seconds of one operation: the difference between long and short independent chains of it."""

    def run(length):
        chains = [start + float(k) for k in range(CHAINS)]
        for _ in range(length):
            chains = [step(x) for x in chains]
        _finish(sum(chains))

    long, short = (seconds(lambda length=length: run(length)) for length in (LENGTH, LENGTH // 4))
    return (long - short) / (CHAINS * (LENGTH - LENGTH // 4) * drjit.width(start))


def operations(run: Callable[[], Any]) -> Counter:
    """Operations a lane of the kernel that computes ``run()``, by (kind, precision)."""
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        drjit.kernel_history_clear()
        _finish(run())
        codes = [entry["ir"].getvalue() for entry in drjit.kernel_history([drjit.KernelType.JIT])]
    counted = Counter()
    for line in max(codes, key=len).splitlines():
        found = _OPERATION.search(line)
        if found:
            kind = found[1] or found[2]
            counted["fma" if kind in _SIMPLE else kind, found[3]] += 1
    return counted


def shares(limits: Limits, run: Callable[[], Any], points: int, bytes_a_point: float) -> dict[str, float]:
    """Nanoseconds a point over all cores, and the shares of the speed of memory and of arithmetic."""
    taken = seconds(lambda: _finish(run())) / points
    counted = operations(run)
    arithmetic = sum(count * limits.operation[kind] for kind, count in counted.items() if kind in limits.operation)
    return {
        "ns": taken * 1e9,
        "operations": float(sum(np.array(list(counted.values())))),
        "memory": bytes_a_point / limits.copy / taken,
        "arithmetic": arithmetic / taken,
    }
