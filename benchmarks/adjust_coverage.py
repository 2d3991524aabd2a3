"""How often truth lies within what adjustments of drawn blocks state: level, index, focal length and poses."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from survey.adjust.applied import apply_adjustment
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment, Status
from survey.adjust.result.parts import common_error
from survey.folder.pose_priors import BAROMETER_STD_M
from survey.folder.survey import Survey

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from tests.block_survey import height_error, pose_errors, survey_of, with_shift
from tests.drawn_block import DrawnBlock, draw_block

# Of a normal distribution, within so many standard deviations.
WITHIN_95 = 1.96
NAMES = ("level_m", "refractive_index", "camera0.f")
# How differently blocks are drawn, in turn.
KINDS = ({}, {"nadir_only": True}, {"dry_share": 0.0}, {"dry_share": 0.35, "num_control": 6}, {"wrong": 0.02})
# Of GPS without corrections: from photograph to photograph, and in common in plan.
GPS_STD_M, GPS_COMMON_M = (0.3, 0.3, 0.15), 1.4
# Of the errors that neighbours share, over the noise of a pixel.
SHARED = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Covered:
    """One adjusted block: errors over their stated standard deviations.

    Attributes
    ----------
    seed : int
    kind : dict
        What was asked of the block.
    scaled : dict
        Of each of `NAMES`.
    free : frozenset of str
        Names that were found from the photographs.
    positions, rotations : (V, 3)
    factor : float
        Found on the variance of matches.
    height : float or None
        Of all heights together, where those of the positions have an error in common.
    """

    seed: int
    kind: dict
    scaled: dict[str, float]
    free: frozenset[str]
    positions: np.ndarray
    rotations: np.ndarray
    factor: float
    height: float | None = None


def covered(
    seed: int,
    *,
    shared: bool = False,
    free_water: bool = False,
    num_points: int = 300,
    common_up_m: float | None = None,
) -> Covered:
    """Draw and adjust the block of a seed.

    Parameters
    ----------
    seed : int
    shared : bool
        Neighbours in a photograph have errors in common.
    free_water : bool
        Nothing is known of the water.
    num_points : int
    common_up_m : float [m], optional
        Positions are of unknown accuracy, and their heights have an error of this standard deviation in common.
    """
    kind = KINDS[seed % len(KINDS)] | ({"shared": SHARED[seed % len(SHARED)]} if shared else {})
    if common_up_m is not None:
        kind |= {"position_std": GPS_STD_M, "num_control": 0}
    block = draw_block(seed, num_points=num_points, **kind)
    survey = survey_of(block)
    if common_up_m is not None:
        shift = np.random.default_rng([seed, 77]).normal(0.0, (GPS_COMMON_M, GPS_COMMON_M, common_up_m))
        survey = with_shift(survey, shift, BAROMETER_STD_M)
    found = adjust_survey(survey, use_windows=False, free_water=free_water)
    true = _truth(block, survey.config.water.level_m - block.stated_water[0])
    rows = {name: found.parameter(name) for name in NAMES}
    positions, rotations = pose_errors(block, found.poses.centres, found.poses.rotations)
    return Covered(
        seed=seed,
        kind=kind,
        scaled={name: (row.value - true[name]) / row.std for name, row in rows.items()},
        free=frozenset(name for name, row in rows.items() if row.status == Status.FREE),
        positions=positions / found.poses.position_std,
        rotations=np.degrees(rotations) / found.poses.rotation_std_deg,
        factor=found.statistics.variance_factor["matches"],
        height=None if common_up_m is None else _height(block, survey, found),
    )


def _height(block: DrawnBlock, survey: Survey, found: Adjustment) -> float:
    common = common_error(found, apply_adjustment(survey, found).water)
    return float("nan") if common is None else height_error(block, found) / common.mean


def _truth(block: DrawnBlock, height: float) -> dict[str, float]:
    """Of each of `NAMES`, for a frame whose zero is at a height in crs."""
    return dict(zip(NAMES, (block.water[0] + height, block.water[3], block.lens.focal[0]), strict=True))


def share_within(blocks: list[Covered], name: str) -> tuple[int, int]:
    """In how many blocks a parameter that was found lies within its 95 %, and in how many it was found."""
    values = np.array([block.scaled[name] for block in blocks if name in block.free])
    return int(np.sum(np.abs(values) < WITHIN_95)), len(values)


def poses_within(blocks: list[Covered]) -> tuple[float, float]:
    """Shares of all coordinates and all angles within their 95 %."""
    return tuple(
        float(np.mean(np.abs(np.concatenate([getattr(block, name) for block in blocks])) < WITHIN_95))
        for name in ("positions", "rotations")
    )


def table(blocks: list[Covered]) -> str:
    """A line for each block, and the sums."""
    lines = []
    for block in blocks:
        words = [f"{name} {block.scaled[name]:+.2f}{'' if name in block.free else ' (held)'}" for name in NAMES]
        shares = " ".join(f"{share:.0%}" for share in poses_within([block]))
        words += [] if block.height is None else [f"heights {block.height:+.2f}"]
        lines.append(f"{block.seed:>3}  factor {block.factor:5.2f}  {'  '.join(words)}  poses {shares}  {block.kind}")
    sums = [f"{name} {within} of {found}" for name in NAMES for within, found in [share_within(blocks, name)]]
    shares = " and ".join(f"{share:.1%}" for share in poses_within(blocks))
    heights = np.array([block.height for block in blocks if block.height is not None])
    if len(heights):
        rms = np.sqrt(np.mean(heights**2))
        sums.append(f"heights {int(np.sum(np.abs(heights) < WITHIN_95))} of {len(heights)} (rms {rms:.2f})")
    return "\n".join([*lines, f"within 95 %: {', '.join(sums)}; positions and rotations {shares}"])
