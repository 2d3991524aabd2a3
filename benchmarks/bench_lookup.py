"""How fast are the field's kernels? Lookup forward, with gradients and with heads, beside the same in torch.

python benchmarks/bench_lookup.py [--grid cube|survey] [--samples N] [--rounds N] [--torch-threads N] [--json]

The cube is MDW-NeRF's: six scales from 64 to 256, three directions; the survey grid has four scales and one direction.
Samples lie anywhere, or 32 to a ray as in training. `unordered` is the kernel with sums in any order, as CUDA has them.
Rates are of the best round: the others depend more on other load of the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import drjit as dr
import numpy as np
import torch

from fields import lookup
from fields.device import choose_device
from fields.factors import Factors, Grid, anisotropic_grids, geometric_scales
from fields.heads import ColourHead, DensityHead

CHANNELS = 4
SAMPLES_OF_A_RAY = 32


def grids(kind: str) -> tuple[list[Grid], str]:
    """Grids and directions of a field."""
    if kind == "cube":
        return [Grid(n, n, n) for n in (round(n) for n in geometric_scales(64, 256, 6))], "xyz"
    return anisotropic_grids(np.array([15.0, 15.0, 0.3]), np.array([0.028, 0.028, 0.028]), 8.0, 4), "z"


def points(order: str, count: int) -> torch.Tensor:
    """Box coordinates (count, 3): "random", or along straight "rays" through the box."""
    generator = torch.Generator().manual_seed(0)
    if order == "random":
        return torch.rand(count, 3, generator=generator)
    rays = -(-count // SAMPLES_OF_A_RAY)
    start, end = torch.rand(2, rays, 1, 3, generator=generator)
    share = (torch.arange(SAMPLES_OF_A_RAY)[:, None] + torch.rand(rays, SAMPLES_OF_A_RAY, 1, generator=generator)) / 32
    return (start + (end - start) * share).view(-1, 3)[:count].contiguous()


class Model:
    """A field's features and heads on one device, in the fine stage."""

    def __init__(self, kind: str, device: str):
        chosen = choose_device(device)
        cells, directions = grids(kind)
        shape = (len(cells), len(directions), CHANNELS)
        self.factors = Factors(cells, directions, CHANNELS, chosen)
        self.density, self.colour = DensityHead(*shape, 4, device=chosen), ColourHead(*shape, degree=2)
        self.density.switch_to_fine()
        self.incoming: torch.Tensor | None = None

    def forward(self, u: torch.Tensor) -> None:
        with torch.no_grad():
            self.factors(u)

    def with_gradients(self, u: torch.Tensor) -> None:
        self.factors.zero_grad()
        features = self.factors(u)
        if self.incoming is None:  # a training has it from what follows
            self.incoming = torch.ones_like(features)
        features.backward(self.incoming)

    def with_heads(self, u: torch.Tensor, every: int = 1) -> None:
        """Density of all samples, and colour of every so many: training leaves out samples that take little light."""
        for module in (self.factors, self.density, self.colour):
            module.zero_grad()
        features = self.factors(u)
        density = self.density(features)
        seen = features if every == 1 else features[::every]
        colour = self.colour(seen, torch.nn.functional.normalize(u[::every], dim=1))
        torch.autograd.backward([density, colour], [torch.ones_like(density), torch.ones_like(colour)])


KINDS: dict[str, Callable[[Model, torch.Tensor], None]] = {
    "lookup forward": Model.forward,
    "lookup forward and backward": Model.with_gradients,
    "with heads": Model.with_heads,
    "with heads, colour of a quarter": lambda model, u: model.with_heads(u, 4),
}


@contextmanager
def in_any_order() -> Iterator[None]:
    """The kernel used on CUDA, in the fastest way on this device: each thread adds to its own copy."""
    unordered = partial(lookup._add_in_any_order, mode=dr.ReduceMode.Expand)
    ordered, lookup._add_in_order = lookup._add_in_order, unordered
    try:
        yield
    finally:
        lookup._add_in_order = ordered


def measure(kind: str, order: str, samples: int, rounds: int) -> list[dict]:
    """Rates of each device and kind of work, devices taken in turn."""
    u = points(order, samples)
    kernel, reference = Model(kind, "cpu"), Model(kind, "torch")
    seconds: dict[tuple[str, str], list] = {}
    for turn in range(rounds + 1):
        for work, run in KINDS.items():
            for name, model in (("kernel", kernel), ("unordered", kernel), ("reference", reference)):
                start, used = time.perf_counter(), time.process_time()
                if name == "unordered":
                    with in_any_order():
                        run(model, u)
                else:
                    run(model, u)
                if turn:  # the first compiles
                    took = time.perf_counter() - start, time.process_time() - used
                    seconds.setdefault((work, name), []).append(took)
    return [
        _row(work, order, samples, {n: seconds[work, n] for n in ("kernel", "unordered", "reference")})
        for work in KINDS
    ]


def _row(work: str, order: str, samples: int, seconds: dict[str, list]) -> dict:
    best = {name: min(s[0] for s in took) for name, took in seconds.items()}
    row = {"work": work, "order": order}
    for name in best:
        row[f"{name}_M_per_s"] = round(samples / best[name] / 1e6, 2)
        row[f"{name}_processor_ms"] = round(1e3 * min(s[1] for s in seconds[name]), 1)
    return row | {
        "over_unordered": round(best["unordered"] / best["kernel"], 2),
        "over_reference": round(best["reference"] / best["kernel"], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--grid", default="cube", choices=("cube", "survey"))
    parser.add_argument("--samples", type=int, default=131072)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--torch-threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    options = parser.parse_args()
    torch.set_num_threads(options.torch_threads)
    rows = [r for order in ("random", "rays") for r in measure(options.grid, order, options.samples, options.rounds)]
    result = {
        "device": choose_device("cpu").name,
        "torch_threads": options.torch_threads,
        "load_of_the_machine": round(os.getloadavg()[0], 1),
        "grid": options.grid,
        "samples": options.samples,
        "rows": rows,
    }
    print(json.dumps(result, indent=2) if options.json else _table(result))  # noqa: T201


def _table(result: dict) -> str:
    head = (
        f"{result['samples']} samples, {result['grid']} grid, {result['device']}, {result['torch_threads']} torch "
        f"threads, load {result['load_of_the_machine']}; million samples a second (processor ms)"
    )
    lines = [head, f"{'':42}{'kernel':>15}{'unordered':>15}{'reference':>15}{'x reference':>13}"]
    for row in result["rows"]:
        cells = [
            f"{row[f'{n}_M_per_s']:.2f} ({row[f'{n}_processor_ms']:.0f})" for n in ("kernel", "unordered", "reference")
        ]
        lines.append(
            f"{row['work'] + ', ' + row['order']:42}"
            + "".join(f"{c:>15}" for c in cells)
            + f"{row['over_reference']:>8}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
