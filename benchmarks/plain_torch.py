"""The least that torch can do: rays through a level plane in a few plain lines, as a measure for `trace` and `project`.

Every ray must fall from above the plane, and every point lie under it: nothing is checked, masked or counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch

from refract import FlatWater, project, trace

ROUNDS = 40


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
