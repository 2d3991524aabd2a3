"""What do trace and project cost, and how far off are they, per library, precision and number of steps?

    python benchmarks/bench_optics.py [--plain]

Prints tables of run time against error over drone geometry and over the extremes, and what torch takes beside a few
plain lines; with --plain only these. Two minutes; on a busy machine believe no figure but the ratios to plain lines,
which count processor time.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch

from refract import FlatWater, project, trace

ROUNDS = 40
FOCAL_PX = 1750.0
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
COUNT = 1 << 18
STEPS = range(7)
BUDGET_S = 0.4  # per figure: as many rounds as fit, two at least; the best one counts


@dataclass(frozen=True)
class Library:
    """One array library at one precision.

    Attributes
    ----------
    name : str
    array : from numpy into the library
    """

    name: str
    array: Callable[[np.ndarray], Any]


LIBRARIES = (
    Library("numpy float64", np.asarray),
    *(Library(f"torch float{bits}", partial(torch.tensor, dtype=getattr(torch, f"float{bits}"))) for bits in (32, 64)),
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


def plain_trace(origin, direction, level: float, n_water: float) -> tuple:
    """Crossing, length and bent direction."""
    length = (level - origin[..., 2]) / direction[..., 2]
    crossing = origin + length[..., None] * direction
    scaled = direction / n_water
    fall = torch.sqrt(1.0 - (1.0 - direction[..., 2:] ** 2) / n_water**2)
    return crossing, length, torch.cat([scaled[..., :2], -fall], dim=-1)


def plain_project(points, camera, level: float, n_water: float):
    """Direction of view, by four of Newton's steps from the share of nadir: as exact as that in drone geometry."""
    H, h = camera[..., 2] - level, level - points[..., 2]
    way = points[..., :2] - camera[..., :2]
    D = torch.linalg.vector_norm(way, dim=-1)
    u = H / (H + h / n_water)
    for _ in range(4):
        S = torch.sqrt((n_water * H) ** 2 + (n_water**2 - 1.0) * (D * u) ** 2)
        u = u - (u + h * u / S - 1.0) / (1.0 + h * (n_water * H) ** 2 / S**3)
    leg = torch.cat([u[..., None] * way, (level - camera[..., 2:]).expand(*u.shape, 1)], dim=-1)
    return leg / torch.linalg.vector_norm(leg, dim=-1, keepdim=True)


def _nanoseconds(*runs: Callable[[], object], count: int) -> list[float]:
    """Least processor time of one thread, in turn, so that other work on the machine disturbs all alike."""
    best = [np.inf] * len(runs)
    for _ in range(ROUNDS):
        for place, run in enumerate(runs):
            start = time.thread_time()
            run()
            best[place] = min(best[place], time.thread_time() - start)
    return [seconds / count * 1e9 for seconds in best]


def plain_table(cameras: np.ndarray, rays: np.ndarray, points: np.ndarray, water: FlatWater) -> str:
    """Processor time of `trace` and `project` in torch on one thread, beside that of the plain lines."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    rows = ["| torch, one thread | what | ns a ray | plain lines, ns | ratio |", "|---|---|---|---|---|"]
    plane = 0.0, water.n_water
    for dtype, (name, centre) in product(
        (torch.float32, torch.float64), (("one camera", cameras[0]), ("a camera a ray", cameras))
    ):
        camera, ray, point = (torch.tensor(v, dtype=dtype) for v in (centre, rays, points))
        ours = partial(trace, camera, ray, water), partial(project, point, camera, water)
        plain = partial(plain_trace, camera, ray, *plane), partial(plain_project, point, camera, *plane)
        for what, own_lines, plain_lines in zip(("trace", "project"), ours, plain, strict=True):
            own, least = _nanoseconds(own_lines, plain_lines, count=len(rays))
            place = f"{str(dtype).removeprefix('torch.')}, {name}"
            rows.append(f"| {place} | {what} | {own:.3g} | {least:.3g} | {own / least:.1f} |")
    torch.set_num_threads(threads)
    return "\n".join(rows)


def drone_geometry() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras 5 to 120 m over the water, rays to 50 deg, and beds 0 to 15 m under it at their ends: (COUNT, 3) each."""
    rng = np.random.default_rng(1)
    H, h = rng.uniform(5.0, 120.0, COUNT), rng.uniform(0.0, 15.0, COUNT)
    angle, azimuth = np.radians(rng.uniform(0.0, 50.0, COUNT)), rng.uniform(0.0, 2.0 * np.pi, COUNT)
    sine, cosine = np.sin(angle), np.cos(angle)
    D = H * sine / cosine + h * sine / np.sqrt(WATER.n_water**2 - sine**2)
    along = np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], -1)
    down = np.array([0.0, 0.0, -1.0])
    return -H[:, None] * down, sine[:, None] * along + cosine[:, None] * down, D[:, None] * along + h[:, None] * down


def extreme_rays(H, h) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres and rays (K, 3) and depths (K,) for all pairs of heights and depths, incidence 0 to 89.9 deg.

    K counts the heights slowest, then the depths.
    """
    leaning = np.radians(np.concatenate([np.linspace(0.0, 70.0, 15), 90.0 - np.geomspace(0.1, 20.0, 60)]))
    H, h, angle, azimuth = (v.ravel() for v in np.meshgrid(H, h, leaning, np.linspace(0.0, 1.5, 8), indexing="ij"))
    sine = np.sin(angle)
    rays = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.cos(angle)], -1)
    return np.stack([0.0 * H, 0.0 * H, H], -1), rays, h


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle [rad] between vectors (K, 3), accurate for small ones."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def _double(vectors: Any) -> np.ndarray:
    return np.asarray(vectors, np.float64)


def round_trip(library: Library, H, h, steps: int) -> np.ndarray:
    """Angles [rad] between rays and the directions in which their points appear: project after trace."""
    centres, rays, depths = extreme_rays(H, h)
    centre, ray = library.array(centres), library.array(rays)
    points = trace(centre, ray, WATER).at_height(library.array(-depths), WATER)
    return angle_between(_double(project(points, centre, WATER, steps=steps).direction), _double(ray))


def drone_errors(library: Library) -> list[np.ndarray]:
    """Angles [rad] between the directions of `project` after each number of steps and the true ones."""
    cameras, rays, points = drone_geometry()
    centre, point = library.array(cameras), library.array(points)
    return [angle_between(_double(project(point, centre, WATER, steps=steps).direction), rays) for steps in STEPS]


def of_steps(library: Library) -> list[dict]:
    """Time and errors of `project` after each number of steps, with and without gradients, and those of `trace`."""
    cameras, rays, points = drone_geometry()
    centre, ray, point = (library.array(v) for v in (cameras, rays, points))
    H, h = np.geomspace(1e-3, 1e4, 10), np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 10)])

    def down(direction):
        path = trace(centre, direction, WATER)
        return path.crossing + path.water_direction

    def pair(function, leaf):
        plain, graded = seconds(lambda: function(leaf)), None
        if torch.is_tensor(leaf):
            graded = seconds(lambda: function(leaf.detach().requires_grad_()).sum().backward())
        return plain / COUNT * 1e9, graded and graded / COUNT * 1e9

    plain, graded = pair(down, ray)
    records = [{"what": "trace", "steps": "", "ns": plain, "graded_ns": graded}]
    for steps, error in zip(STEPS, drone_errors(library), strict=True):
        plain, graded = pair(lambda p, steps=steps: project(p, centre, WATER, steps=steps).direction, point)
        records.append(
            {"what": "project", "steps": steps, "ns": plain, "graded_ns": graded, "worst": error.max()}
            | {"rms": float(np.sqrt(np.mean(error**2))), "extreme": round_trip(library, H, h, steps).max()}
        )
    return [{"library": library.name} | record for record in records]


def error_table(records: list[dict]) -> str:
    rows = [
        "| library | what | steps | ns a ray | with gradients | worst, rad | rms, rad | worst, px | extremes, rad |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in records:
        graded = "" if r["graded_ns"] is None else f"{r['graded_ns']:.3g}"
        errors = ["", "", "", ""]
        if "worst" in r:
            errors = [f"{v:.1e}" for v in (r["worst"], r["rms"], r["worst"] * FOCAL_PX, r["extreme"])]
        cells = [r["library"], r["what"], str(r["steps"]), f"{r['ns']:.3g}", graded, *errors]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def main() -> None:
    """Measure and print, or draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plain", action="store_true", help="measure only torch beside plain lines")
    arguments = parser.parse_args()
    torch.set_num_threads(os.cpu_count() or 1)
    sys.stdout.write(plain_table(*drone_geometry(), WATER) + "\n")
    if not arguments.plain:
        records = [record for library in LIBRARIES for record in of_steps(library)]
        sys.stdout.write("\n" + error_table(records) + "\n")


if __name__ == "__main__":
    main()
