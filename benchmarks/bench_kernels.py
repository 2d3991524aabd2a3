"""Where does the time of the sweep go? By function, and how near its kernels come to the limits of the machine.

    python benchmarks/bench_kernels.py SURVEY [--quality Q]

Seconds are processor time of the whole process, all cores together; samples are pixels x heights x neighbours. Prints
tables in Markdown. The kernels run on the middle view at full size; the best of
many rounds counts. `kernel_limits` says how the limits of arithmetic and memory are measured; here they are those
of one core.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from pathlib import Path
from unittest.mock import patch

import drjit
import numpy as np
from array_libraries import Limits, measure_limits, shares
from array_libraries import seconds as best_seconds

from fields.sweep import height_range
from fields.sweep.block import Block, Overlap
from fields.sweep.kernels import drjit_kernels
from fields.sweep.kernels.arrays import floats
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.passes import PASSES
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings, view_passes
from survey.folder.survey import load_survey
from survey.plan.area import limits, local_area
from survey.plan.choices import Choices
from survey.plan.recipe import RECIPES
from survey.progress import current
from survey.run.job import Job

FUNCTIONS = {
    "paths of pixels": (drjit_kernels, ("rays_of_rows",)),
    "warp": (drjit_kernels, ("warp",)),
    "scores": (drjit_kernels, ("prepare_windows", "ncc", "best_half")),
    "best hypothesis": (drjit_kernels, ("best_height",)),
    "height maps compared": (drjit_kernels, ("compare_heights",)),
    "parallax": (Overlap, ("parallax",)),
}
# Kernels: the pass of the sweep that they are taken from.
KERNEL_PASS = PASSES[2]


def timed(spent: Counter, name: str, function: Callable) -> Callable:
    """A function that adds the processor time of its calls, until their kernels have ended."""

    @wraps(function)
    def call(*args, **options):
        start = time.process_time()
        result = function(*args, **options)
        drjit.sync_thread()
        spent[name] += time.process_time() - start
        return result

    return call


@contextmanager
def clocks(spent: Counter) -> Iterator[None]:
    """The functions of the sweep, timed."""
    with ExitStack() as stack:
        for name, (owner, functions) in FUNCTIONS.items():
            for function in functions:
                stack.enter_context(patch.object(owner, function, timed(spent, name, getattr(owner, function))))
        yield


def stage_table(block: Block, chosen: list[int], bound: tuple[float, float], heights: tuple[float, float]) -> str:
    """Markdown of the seconds of the search for the range of heights, and of the sweep."""
    lines = ["| | samples | processor time | a sample |", "|---|---|---|---|"]
    work = [view_passes(block, chosen, p, bound if k == 0 else None) for k, p in enumerate(PASSES)]
    samples = sum(each.samples for of_pass in work for each in of_pass)
    for name, run, number in (
        ("range of heights", partial(height_range.find_range, block, heights), None),
        ("sweep", partial(sweep, block, chosen, SweepSettings(bound), lambda done: None), samples),
    ):
        spent: Counter = Counter()
        start = time.process_time()
        with clocks(spent):
            run()
        total = time.process_time() - start
        rows = [(f"**{name}**", total), *spent.items(), ("the rest", total - sum(spent.values()))]
        for row, seconds in rows:
            each = f"{1e9 * seconds / number:.2f} ns" if number else ""
            lines.append(f"| {row} | {f'{number / 1e6:.0f} million' if number else ''} | {seconds:.2f} s | {each} |")
    return "\n".join(lines)


def kernel_table(block: Block, bound: tuple[float, float], machine: Limits) -> str:
    """Markdown of the two kernels that take most, against the limits of the machine."""
    stack, device, p = block.stack(KERNEL_PASS.scale), block.device, KERNEL_PASS
    view = len(stack.cameras) // 2
    others, count = block.neighbours(view, p.neighbours), p.hypotheses or 0
    rows = min(stack.height, drjit_kernels.SAMPLES_PER_LAUNCH // (len(others) * count * stack.width))
    start = np.full((rows, stack.width), 0.5 * (bound[0] + bound[1]), np.float32)
    legs, grey = drjit_kernels.rays_of_rows(stack, view, 0, rows), floats(stack.device, stack.images[view][:rows])
    size = start.size * count
    values, greys = drjit_kernels.buffers(device, len(others), size), drjit_kernels.reference_buffer(device, size)
    warp = partial(drjit_kernels.warp, values, stack, legs, Hypotheses(start, 0.05, count), others)
    samples = len(others) * count * rows * stack.width
    lines = ["| | a sample | operations | of the arithmetic limit | of the memory limit |", "|---|---|---|---|---|"]

    def finished() -> None:
        warp()
        drjit.sync_thread()

    # Hypotheses are one loop of a kernel: its operations cannot be counted in the code.
    lines.append(f"| warp | {1e9 * best_seconds(finished) / samples:.2f} ns | | | |")
    # Bytes a sample: W read, scores written.
    kernels: list[tuple[str, Callable, float]] = []
    for radius in (1, 2, 3):
        scores = partial(scored, device, grey, greys, values, stack.width, radius)
        kernels.append((f"scores, {2 * radius + 1} x {2 * radius + 1}", scores, 4 + 8 / len(others)))
    for name, run, num_bytes in kernels:
        found = shares(machine, run, samples, num_bytes)
        counts = f"{found['ns']:.2f} ns | {found['operations'] / len(others):.0f}"
        lines.append(
            f"| {name} | {counts} | {100 * found['arithmetic'] / len(others):.0f} % | {100 * found['memory']:.0f} % |"
        )
    return "\n".join(lines)


def scored(device, grey, greys, values: list, width: int, radius: int):
    """The score of all neighbours."""
    windows = drjit_kernels.prepare_windows(device, grey, greys, values, width, radius)
    return drjit_kernels.best_half(device, drjit_kernels.ncc(windows, radius))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("--quality", default="draft", choices=list(RECIPES))
    options = parser.parse_args()
    job = Job(load_survey(options.survey), Choices(quality=options.quality, device="cpu"), current())
    heights, block = limits(job.survey), job.block
    bound = height_range.find_range(block, heights)
    block.set_overlap_height(0.5 * (bound[0] + bound[1]))
    chosen = block.cover(*RECIPES[options.quality].times_seen, local_area(job.survey))
    sys.stdout.write(stage_table(block, chosen, bound, heights) + "\n\n")
    # In processor time too: other programs on the machine do not count.
    with patch.object(time, "perf_counter", time.process_time):
        machine = measure_limits()
        sys.stdout.write(f"{kernel_table(block, bound, machine)}\n\nA copy moves {machine.copy / 1e9:.1f} GB/s.\n")


if __name__ == "__main__":
    main()
