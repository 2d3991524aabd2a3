"""How many Newton steps does the way back through the surface need, per library and precision?

    python benchmarks/bench_optics.py

Prints the table of docs/optics.md: the angle between the direction of view after so many steps and the exact
one, over drone geometry, with the crossings per second beside it.
"""

from __future__ import annotations

import importlib
import sys
import time

import numpy as np
import torch

from refract import kernels
from refract.projection import EXACT_STEPS

COUNT = 1_000_000
N_WATER = 1.333
FOCAL_PX = 1750.0
STEPS = (1, 2, 3, 4)
LEVEL = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), N_WATER)


def drone_geometry():
    """Triples of camera centres 5 to 120 m over the water and beds 0 to 15 m under it, incidence to 50 deg."""
    rng = np.random.default_rng(1)
    H, h = rng.uniform(5.0, 120.0, COUNT), rng.uniform(0.0, 15.0, COUNT)
    angle, azimuth = np.radians(rng.uniform(0.0, 50.0, COUNT)), rng.uniform(0.0, 2.0 * np.pi, COUNT)
    D = H * np.tan(angle) + h * np.sin(angle) / np.sqrt(N_WATER**2 - np.sin(angle) ** 2)
    zero = np.zeros(COUNT)
    return (zero, zero, H), (D * np.cos(azimuth), D * np.sin(azimuth), -h)


def view_error(crossing, exact, camera) -> np.ndarray:
    """Angle [rad] between the directions of view from `camera` to two crossings."""
    seen, true = (
        np.stack([np.asarray(c, np.float64) for c in x], -1) - np.stack(camera, -1) for x in (crossing, exact)
    )
    cross = np.linalg.norm(np.cross(seen, true), axis=-1)
    return cross / np.linalg.norm(seen, axis=-1) / np.linalg.norm(true, axis=-1)


def libraries():
    """Name, wrapper of one array, and a function that waits for results, per library and precision."""
    yield "numpy float64", np.asarray, lambda crossing: None
    yield "torch float32", lambda c: torch.tensor(c, dtype=torch.float32), lambda crossing: None
    import drjit

    if drjit.has_backend(drjit.JitBackend.LLVM):

        def wait(crossing):
            drjit.eval(*crossing)
            drjit.sync_thread()

        yield "Dr.Jit float32 (LLVM)", importlib.import_module("drjit.llvm").Float, wait


def main() -> None:
    """Measure and print."""
    camera, point = drone_geometry()
    exact, _ = kernels.crossing_of_point(camera, point, *LEVEL, EXACT_STEPS)
    rows = ["| library | steps | worst, rad | rms, rad | worst, px | rms, px | M/s |", "|---|---|---|---|---|---|---|"]
    for name, wrap, wait in libraries():
        wrapped = tuple(map(wrap, camera)), tuple(map(wrap, point))
        for steps in STEPS:
            best = float("inf")
            for _ in range(4):  # the first run compiles
                start = time.perf_counter()
                crossing, _ = kernels.crossing_of_point(*wrapped, *LEVEL, steps)
                wait(crossing)
                best = min(best, time.perf_counter() - start)
            error = view_error(crossing, exact, camera)
            worst, rms = error.max(), float(np.sqrt(np.mean(error**2)))
            rows.append(
                f"| {name} | {steps} | {worst:.1e} | {rms:.1e} | {worst * FOCAL_PX:.1e} | {rms * FOCAL_PX:.1e} "
                f"| {COUNT / best / 1e6:.0f} |"
            )
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
