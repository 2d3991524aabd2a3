"""The array libraries that the optics run on, for benchmarks: how arrays get in and out of them, and how to wait."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit
import numpy as np
import torch

BUDGET_S = 0.4  # per figure: as many rounds as fit, two at least; the best one counts


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
