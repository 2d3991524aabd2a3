"""Rays over a water surface and back, and arrays of each library, for the tests of `refract`."""

import numpy as np
import pytest

from refract import kernels
from refract.curved import CurvedWater


def llvm():
    """The module of Dr.Jit's differentiable arrays on LLVM; skips the test where it is missing or too old.

    Older LLVMs would end the process.
    """
    pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    from fields.device import choose_device

    chosen = choose_device("cpu")
    if chosen.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {chosen.reason}")
    from drjit.llvm import ad

    return ad


# Array libraries of vectors, with a precision; numbers are Dr.Jit's, too.
LIBRARIES = ["numpy", "torch.float64", "torch.float32"]
DOUBLE, SINGLE = LIBRARIES[:2], ["torch.float32", "drjit"]


def array_of(library, values):
    """Values of numpy in a library."""
    if library == "numpy":
        return np.asarray(values)
    if library == "drjit":
        return llvm().Float(values)
    import torch

    return torch.tensor(np.asarray(values), dtype=getattr(torch, library.removeprefix("torch.")))


def as_double(found):
    """An array of any library as float64 of numpy."""
    return np.asarray(found, dtype=np.float64)


class Bowl(CurvedWater):
    """``z = level + b (x^2 + y^2)``; only height and gradient."""

    def __init__(self, level=0.3, n_water=1.333, b=1e-3):
        self.level, self.n_water, self.b = level, n_water, b

    def height(self, x, y):
        return self.level + self.b * (x * x + y * y)

    def gradient(self, x, y):
        return 2.0 * self.b * x, 2.0 * self.b * y


def cameras(rng, count, height=(5.0, 60.0), spread=3.0):
    """Camera centres ``height`` [m] over z = 0."""
    return rng.uniform(-spread, spread, count), rng.uniform(-spread, spread, count), rng.uniform(*height, count)


def falling_rays(rng, count, steepest_deg=0.0, flattest_deg=50.0):
    """Unit rays with incidences to the vertical between two angles, in all directions."""
    incidence = np.radians(rng.uniform(steepest_deg, flattest_deg, count))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.sin(incidence) * np.cos(azimuth), np.sin(incidence) * np.sin(azimuth), -np.cos(incidence)


def bed_points(water, camera, ray, depth):
    """Where the rays end ``depth`` [m] (along the vertical) below their crossing."""
    surface = kernels.point_at_distance(camera, ray, water.intersect(camera, ray))
    leg = kernels.bend(ray, water.normal(surface[0], surface[1]), 1.0, water.n_water)
    return kernels.point_at_distance(surface, leg, depth / -leg[2])


def view_angle(camera, seen, ray):
    """Angles [rad] between unit rays and the directions from the camera to what is seen."""
    way = np.stack([s - c for s, c in zip(seen, camera, strict=True)], -1)
    return np.linalg.norm(np.cross(way, np.stack(ray, -1)), axis=-1) / np.linalg.norm(way, axis=-1)
