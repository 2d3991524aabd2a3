"""How near a Dr.Jit kernel comes to the speed of memory and of arithmetic, both measured beside it.

The arithmetic of a kernel is counted in its LLVM code, by kind and precision, and costed with what one operation of
that kind takes in a loop of nothing else: fused multiply-adds in independent chains, roots, and divisions. An
addition, a product, a conversion and an approximate reciprocal count as one multiply-add; comparisons, selections,
integers, loads and stores count nothing. So the limit is what no kernel of these operations can beat.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit
import numpy as np
from array_libraries import seconds

STREAM = 1 << 22  # 16 MB an array: eight of them are far beyond the caches
CHAINS, LENGTH = 12, 64
_SIMPLE = {"fadd", "fsub", "fmul", "fneg", "fpext", "fptrunc", "fma", "rsqrt14", "rcp14", "fabs"}
_OPERATION = re.compile(r"= (?:(f\w+)|.*?call.*?@llvm\.(?:x86\.avx512\.)?(\w+))[ .].*?<\d+ x (float|double)>")


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
