"""How much faster is the fused feature lookup in Dr.Jit than its torch twin? Side by side, forward and with gradients.

python benchmarks/bench_lookup.py [--directions z|xyz] [--samples N]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np
import torch

from fields.device import choose_device
from fields.factors import Factors, anisotropic_grids

ROUNDS = 5


def measure(directions: str, samples: int) -> dict:
    """Millions of samples a second of each device, median over rounds taken in turn, and their ratios."""
    grids = anisotropic_grids(np.array([15.0, 15.0, 0.3]), np.array([0.028, 0.028, 0.028]), 8.0, 4)
    fields = {name: Factors(grids, directions, 4, choose_device(name)) for name in ("cpu", "torch")}
    u = torch.rand(samples, 3, generator=torch.Generator().manual_seed(0))
    seconds = {(name, kind): [] for name in fields for kind in ("forward", "with_gradients")}
    for turn in range(ROUNDS + 1):
        for name, factors in fields.items():
            start = time.perf_counter()
            features = factors(u)
            middle = time.perf_counter()
            features.sum().backward()
            if turn:  # the first compiles
                seconds[name, "forward"].append(middle - start)
                seconds[name, "with_gradients"].append(time.perf_counter() - start)
    rate = {f"{n}_{k}_M_per_s": round(samples / statistics.median(s) / 1e6, 2) for (n, k), s in seconds.items()}
    for kind in ("forward", "with_gradients"):
        rate[f"ratio_{kind}"] = round(rate[f"cpu_{kind}_M_per_s"] / rate[f"torch_{kind}_M_per_s"], 1)
    return {"device": choose_device("cpu").name, "directions": directions, "samples": samples, **rate}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--directions", default="z", choices=("z", "xyz"))
    parser.add_argument("--samples", type=int, default=131072)
    options = parser.parse_args()
    print(json.dumps(measure(options.directions, options.samples), indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
