"""How often is one plane through points of the water doubted, rightly and wrongly?

    python benchmarks/bench_water_plane.py [--count 1000]

Draws points (16 to 150, within 20 to 200 m) on planes, with scatter of 1, 2 or 5 cm where 2 cm are stated: normal,
with 5 % of wrong points (ten times as far off), of long tails (t of 3 degrees), and mixed (0.3 to 3 times). Prints the
false alarms, then how many riffles of 20 cm (within 10 m) points of 2 cm show, by their number.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from survey.water.surface import plane_warning

KINDS = ("normal", "wrong points", "long tails", "mixed")
NUMBERS = (16, 24, 40, 80, 150)
STATED_M, COMMON_M = 0.02, 0.015


def drawn(rng: np.random.Generator, kind: str, count: int, std: float, fall_m: float, width: float) -> np.ndarray:
    """Points (N, 3) [m] on a tilted plane with a riffle of a height in the middle."""
    long = rng.uniform(20.0, 200.0)
    places = rng.uniform((-0.5 * long, -0.5 * width * long), (0.5 * long, 0.5 * width * long), (count, 2))
    noise = rng.standard_t(3, count) if kind == "long tails" else rng.standard_normal(count)
    if kind == "wrong points":
        noise[rng.random(count) < 0.05] *= 10.0
    if kind == "mixed":
        noise *= rng.uniform(0.3, 3.0, count)
    heights = -0.5 * fall_m * np.tanh(places[:, 0] / 3.0) + places @ rng.normal(0.0, 0.003, 2) + std * noise
    return np.column_stack([places, heights])


def is_doubted(points: np.ndarray) -> bool:
    """Whether `check` warns."""
    stds = np.full(len(points), STATED_M)
    level_std = float(np.hypot(COMMON_M, 1.5 * STATED_M / np.sqrt(len(points))))
    return plane_warning(points, stds, level_std, "gnss_points") is not None


def main() -> None:
    """Draw, and print shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    asked, rng = parser.parse_args(), np.random.default_rng(5)
    for kind in KINDS:
        alarms = 0
        for _ in range(asked.count):
            width = float(rng.uniform(0.1, 1.0)) if rng.random() < 0.5 else 0.02
            points = drawn(rng, kind, int(rng.integers(16, 150)), float(rng.choice([0.01, 0.02, 0.05])), 0.0, width)
            alarms += is_doubted(points)
        sys.stdout.write(f"planes, {kind}: {alarms} of {asked.count} doubted\n")
    for number in NUMBERS:
        found = sum(
            is_doubted(drawn(rng, "normal", number, STATED_M, 0.2, float(rng.uniform(0.1, 1.0))))
            for _ in range(asked.count)
        )
        sys.stdout.write(f"riffles of 20 cm, {number} points: {100.0 * found / asked.count:.0f} % doubted\n")


if __name__ == "__main__":
    main()
