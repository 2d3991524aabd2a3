"""Time, memory and truth of the adjustment of large blocks, with exact matches and noise in place of photographs.

    python benchmarks/bench_block_size.py PHOTOGRAPHS ... [--strip] [--positions 0.3] [-o FILE]

Photographs in parallel strips over a bed under water, or on one line; of each place those within half a footprint, and
four of five find a point. Positions are those of GPS with errors of a known standard deviation; lens, water and poses
are found. Prints parameters, processor time and peak of memory beside what the survey takes, errors of positions over
their stated standard deviations, and the error of the water's level. Each size runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from survey.adjust.refine import adjust_survey
from tests.block_survey import pose_errors, survey_of
from tests.drawn_block import draw_block

_SPACING, _HEIGHT_M, _DEPTH_M, _POINTS = 0.3, 25.0, 1.5, 30


def measured(num_views: int, *, strip: bool, position_std: float) -> dict:
    """Figures of one block."""
    layout = {"strip": True} if strip else {"spacing": _SPACING}
    block = draw_block(
        5, num_points=_POINTS * num_views, num_views=num_views, nadir_only=True, num_control=0, dry_share=0.0,
        height=_HEIGHT_M, depth=_DEPTH_M, position_std=(position_std,) * 3, **layout,
    )  # fmt: skip
    survey = survey_of(block)
    before, start = _peak_mb(), time.process_time()
    found = adjust_survey(survey, use_windows=False)
    seconds = time.process_time() - start
    errors, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    level = next(each for each in found.parameters if each.name == "level_m")
    return {
        "photographs": num_views,
        "observations": len(found.residuals.view),
        "parameters": len(found.covariance.names),
        "seconds": round(seconds, 1),
        "peak_mb": round(_peak_mb() - before),
        "median_position_error_m": round(float(np.median(np.linalg.norm(errors, axis=1))), 4),
        "covered": round(float(np.mean(np.abs(errors) <= 1.96 * found.poses.position_std)), 3),
        "level": level.verdict,
    }


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Measure the sizes that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", nargs="+", type=int)
    parser.add_argument("--strip", action="store_true", help="all on one line")
    parser.add_argument("--positions", type=float, default=0.3, metavar="M", help="standard deviation of positions")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file of all rows")
    options = parser.parse_args()
    if len(options.photographs) == 1:
        row = measured(options.photographs[0], strip=options.strip, position_std=options.positions)
        print(json.dumps(row))  # noqa: T201
        return
    rows = []
    for number in options.photographs:
        command = [sys.executable, __file__, str(number), "--positions", str(options.positions)]
        command += ["--strip"] * options.strip
        rows.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
        print(json.dumps(rows[-1]), flush=True)  # noqa: T201
        if options.output is not None:
            options.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
