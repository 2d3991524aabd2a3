"""What focal lengths that differ between photographs do to drawn blocks, adjusted with one for all and with one each.

    python benchmarks/bench_focal_drift.py [--seeds 200-223] [--share 0.004]

Blocks of 20 photographs and 400 points over wet ground, positions good to 2 cm, as exact tie points with noise. Prints
a row for each: by how much -2 ln of the marginal likelihood falls with a focal length for each photograph; median and
scatter of the errors of the heights, and errors of positions over their stated standard deviations, with one focal
length and with one each; then their root mean squares over the blocks where it falls by more than `--gain`. About five
seconds of one core for each block. `--share 0` has no drift: what is found there is a false alarm.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
from scipy.spatial import cKDTree

from survey.adjust import focal_lengths, refine, stages
from survey.adjust.result.adjustment import Adjustment

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from tests.block_survey import pose_errors, rms, survey_of
from tests.drawn_block import DrawnBlock, draw_block

SETTINGS = {"num_points": 400, "num_views": 20}
# Tie points are held against the drawn point that is nearest in plan, if it is so near [m].
_NEAR_M = 1.0
NAMES = ("median, one [mm]", "each", "scatter, one [mm]", "each", "positions / std, one", "each")


@dataclass(frozen=True)
class Row:
    """A block with one focal length and with one for each photograph.

    Attributes
    ----------
    gain : float
        By how much -2 ln of the marginal likelihood falls with one each.
    is_used : bool
        Whether the adjustment took one each.
    figures : tuple of 6 float
        Those of `NAMES`.
    """

    gain: float
    is_used: bool
    figures: tuple[float, ...]


def drifting(block: DrawnBlock, share: float) -> DrawnBlock:
    """The block with focal lengths that differ by a standard deviation of a share."""
    factors = 1.0 + share * np.random.default_rng([block.seed, 77]).standard_normal(len(block.cameras))
    middle = np.array([block.lens["cx"], block.lens["cy"]])
    return replace(block, pixel=middle + (block.pixel - middle) * factors[block.view][:, None])


def row_of(seed: int, share: float) -> Row:
    """Draw and adjust one block, twice."""
    block = drifting(draw_block(seed, **SETTINGS), share)
    survey, gains = survey_of(block), []
    original = focal_lengths.focal_drift

    def noted(known, done):
        with mock.patch.object(focal_lengths, "_SIGNIFICANT", -np.inf):
            found = original(known, done)
        gains.append(found.gain)
        return original(known, done)

    with mock.patch.object(focal_lengths, "focal_drift", noted):
        each = refine.adjust_survey(survey, use_windows=False)
    with mock.patch.object(stages, "with_focals", lambda _known, done, _adjusted: (done, None)):
        one = refine.adjust_survey(survey, use_windows=False)
    pairs = zip(_figures(block, one), _figures(block, each), strict=True)
    return Row(gains[0], each.poses.focals is not None, tuple(value for pair in pairs for value in pair))


def _figures(block: DrawnBlock, found: Adjustment) -> tuple[float, float, float]:
    """Median and scatter of the errors of the heights [mm], errors of positions over their standard deviations."""
    apart, nearest = cKDTree(block.points[:, :2]).query(found.points[:, :2])
    errors = (found.points - block.points[nearest])[apart < _NEAR_M, 2]
    positions = pose_errors(block, found.poses.centres, found.poses.rotations)[0]
    return 1e3 * float(np.median(errors)), 1e3 * float(errors.std()), rms(positions / found.poses.position_std)


def _seeds(words: str) -> range:
    first, _, last = words.partition("-")
    return range(int(first), int(last or first) + 1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=_seeds, default=_seeds("200-223"), help="first and last")
    parser.add_argument("--share", type=float, default=0.004, help="standard deviation of the focal lengths")
    parser.add_argument("--gain", type=float, default=10.0, help="blocks of the last row: those that fall by more")
    options = parser.parse_args()
    print(f"| seed | falls by | taken | {' | '.join(NAMES)} |\n|{9 * '---|'}")  # noqa: T201
    rows = []
    for seed in options.seeds:
        rows.append(row_of(seed, options.share))
        row = rows[-1]
        cells = [f"{seed}", f"{row.gain:.1f}", "yes" if row.is_used else "no", *(f"{v:.2f}" for v in row.figures)]
        print(f"| {' | '.join(cells)} |", flush=True)  # noqa: T201
    shown = np.array([row.figures for row in rows if row.gain > options.gain]).reshape(-1, len(NAMES))
    means = [f"{rms(column):.2f}" for column in shown.T] if len(shown) else []
    taken = f"{sum(row.is_used for row in rows)} of {len(rows)}"
    print(f"| rms of {len(shown)} | | {taken} | {' | '.join(means)} |")  # noqa: T201


if __name__ == "__main__":
    main()
