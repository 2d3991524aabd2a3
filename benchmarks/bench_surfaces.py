"""What do curved water surfaces cost, relative to flat water, and how often is another path found than the one traced?

    OMP_NUM_THREADS=1 python benchmarks/bench_surfaces.py

Prints a table: microseconds per ray for the way down (intersect, normal, bend), per point
for the way back up, the same as multiples of flat water, and the share of points seen along the traced ray, along
another path, and along none.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from refract import kernels
from refract.curved import BicubicWater, WavyWater
from refract.surfaces import FlatWater

COUNT = 20_000
STEPS = 4
# Directions nearer to each other than this are those of one path.
SAME_RAD = 1e-9
REPEATS = 3
LEVEL = (0.0, 0.0, 0.0)


def waves(*trains):
    """Waves of (amplitude m, wavelength m, heading deg), phases 0, 1, 2, ... rad."""
    amplitude, length, heading = np.array(trains, dtype=np.float64).T
    k = 2.0 * np.pi / length[:, None] * np.stack([np.cos(np.radians(heading)), np.sin(np.radians(heading))], axis=-1)
    return WavyWater(LEVEL, amplitude, k, np.arange(len(trains)))


def raster(water, spacing, half=60.0):
    """`water` as cubic pieces."""
    x = np.arange(-half, half + 0.5 * spacing, spacing)
    return BicubicWater((-half, -half), spacing, water.height(*np.meshgrid(x, x)))


def surfaces():
    """Name, surface, depth of the water [m], and number of points."""
    swell = waves((0.05, 10.0, 20), (0.02, 4.0, 100))
    chop = waves((0.02, 1.5, 20), (0.01, 0.8, 100), (0.005, 0.4, 60))
    yield "flat", FlatWater(LEVEL), 3.0, COUNT
    yield "swell, 2 waves (slope 0.06)", swell, 3.0, COUNT
    yield "chop, 3 waves (slope 0.24), 0.3 m deep", chop, 0.3, COUNT
    yield "chop, 3 waves (slope 0.24), 3 m deep", chop, 3.0, COUNT
    yield "raster of 2 m, plane", raster(FlatWater(LEVEL, slope_x=0.001), 2.0), 3.0, COUNT
    yield "raster of 1 m, swell", raster(swell, 1.0), 3.0, COUNT


def drone_rays(count):
    """Cameras 20 to 60 m up and rays to 40 deg off nadir: triples."""
    rng = np.random.default_rng(1)
    angle, turn = np.radians(rng.uniform(0.0, 40.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    camera = rng.uniform(-5.0, 5.0, count), rng.uniform(-5.0, 5.0, count), rng.uniform(20.0, 60.0, count)
    return camera, (np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle))


def best_time(task):
    """Least seconds of some repeats, and the last result."""
    best, result = float("inf"), None
    for _ in range(REPEATS):
        start = time.perf_counter()
        result = task()
        best = min(best, time.perf_counter() - start)
    return best, result


def down(surface, camera, ray, depth):
    """Bed points ``depth`` [m] below where the rays meet the surface."""
    crossing = kernels.point_at_distance(camera, ray, surface.intersect(camera, ray))
    leg = kernels.bend(ray, surface.normal(crossing[0], crossing[1]), 1.0, surface.n_water)
    return kernels.point_at_distance(crossing, leg, -depth / leg[2])


def main() -> None:
    """Measure and print."""
    rows = [
        "| surface | down, µs | × flat | up, µs | × flat | the traced ray | another | none | worst, rad |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    flat = None
    for name, surface, depth, count in surfaces():
        camera, ray = drone_rays(count)
        seconds_down, bed = best_time(lambda s=surface, c=camera, r=ray, d=depth: down(s, c, r, d))
        seconds_up, (seen, _) = best_time(lambda s=surface, c=camera, b=bed: s.crossing(c, b, STEPS))
        cost = 1e6 * seconds_down / count, 1e6 * seconds_up / count
        flat = flat or cost
        way = np.stack(kernels.minus(seen, camera), axis=-1)
        angle = np.linalg.norm(np.cross(way, np.stack(ray, axis=-1)), axis=-1) / np.linalg.norm(way, axis=-1)
        same, none = angle < SAME_RAD, np.isnan(angle)
        shares = (float(np.mean(m)) for m in (same, ~same & ~none, none))
        rows.append(
            f"| {name} | {cost[0]:.2f} | {cost[0] / flat[0]:.1f} | {cost[1]:.2f} | {cost[1] / flat[1]:.0f} "
            + "".join(f"| {share:.1%} " for share in shares)
            + f"| {angle[same].max():.0e} |"
        )
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
