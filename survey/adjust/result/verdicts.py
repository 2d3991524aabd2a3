"""Verdicts on the parameters of an adjustment: found, held, or not observable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from survey.adjust.block.state import LENS_NAMES, RATE_NAME, READOUT_NAME, WATER_PARAMETERS, Layout, State
from survey.adjust.result.adjustment import FREE, HELD, UNKNOWN, Parameter
from survey.folder.motion import rows_between
from survey.settings.config import WaterConfig

# Beyond this many standard deviations of their difference, two values contradict each other. Where four parameters are
# tested, one of them is beyond the latter by chance in one survey of a thousand (docs/adjustment.md).
MOST_SIGMAS, MOST_SIGMAS_OF_FOUR = 3.0, 3.66
# One sigma beyond which a parameter is of no use. 5 cm of level move the bed by 2 cm, and so does 0.01 of index in 3 m
# of water; 0.5 % of the focal length moves the ground by 0.5 % of the flying height.
MOST_STD_LEVEL_M, MOST_STD_INDEX, MOST_STD_FOCAL = 0.05, 0.01, 0.005
# Limit of use of a readout: std of the way that the camera flies from first row to last, in pixels on the ground.
MOST_STD_ROWS_PX = 0.5
# With a std above this share of that of the prior, the photographs add nearly nothing.
_LITTLE = 0.9
# A prior with a smaller std than this was held.
_EXACT = 1e-6


class Estimate(NamedTuple):
    """A value and its standard deviation, infinite where nothing is known."""

    value: float
    std: float


def with_verdict(name: str, found: Estimate, before: Estimate, limit: float, unit: str) -> Parameter:
    """A parameter with its verdict, found and as given before; of no use beyond a standard deviation of ``limit``."""
    (value, std), (given, given_std) = found, before
    shown = f"{value:.{_digits(std)}f} +- {std:.2g}{unit}"
    prior = None if not math.isfinite(given_std) else given_std
    kept = f"{given:.{_digits(given_std)}f}{unit}"
    if given_std < _EXACT:
        return Parameter(name, given, std, given, prior, HELD, f"held: {given:.6g}{unit}, exactly as given")
    if std > limit and not given_std <= limit:
        verdict = (
            f"not observable: 1 sigma is {std:.2g}{unit}, at most {limit:.2g}{unit} would be of use; {kept} is kept"
        )
        return Parameter(name, given, std, given, prior, UNKNOWN, verdict)
    if std > _LITTLE * given_std:
        verdict = f"held: {shown}{_against(std, given, prior, unit)}; the photographs add nothing"
        return Parameter(name, value, std, given, prior, HELD, verdict)
    return Parameter(name, value, std, given, prior, FREE, f"found: {shown}{_against(std, given, prior, unit)}")


def unobservable_verdict(name: str, std: float, given: float, reason: str) -> Parameter:
    """A parameter of the water that keeps its given value for a reason."""
    kept = f"{given:.5f}" + (" m" if name == "level_m" else "")
    return Parameter(name, given, std, given, None, UNKNOWN, f"not observable: {reason}; {kept} is kept")


def _against(std: float, given: float, prior: float | None, unit: str) -> str:
    if prior is None:
        return ""
    return f" (given {given:.{_digits(std)}f} +- {prior:.2g}{unit})"


def _digits(std: float) -> int:
    """Decimals that show two digits of a standard deviation."""
    if not math.isfinite(std) or std <= 0.0:
        return 4
    return min(max(1 - math.floor(math.log10(std)), 0), 9)


def water_limits(points: np.ndarray) -> np.ndarray:
    """Limits (4,) of use of level, slopes and index; slopes count by their effect at the edge of the points."""
    middle = np.median(points[:, :2], axis=0)
    reach = float(np.quantile(np.linalg.norm(points[:, :2] - middle, axis=1), 0.95))
    slope = MOST_STD_LEVEL_M / max(reach, 1e-6)
    return np.array([MOST_STD_LEVEL_M, slope, slope, MOST_STD_INDEX])


def water_verdicts(
    values: np.ndarray, std: np.ndarray, given: WaterConfig, given_std: np.ndarray, limits: np.ndarray
) -> list[Parameter]:
    """Verdicts on level, slopes and index, (4,) each, as survey.toml counts them."""
    found = []
    for i, name in enumerate(WATER_PARAMETERS):
        unit = " m" if i == 0 else ""
        before = Estimate(float(getattr(given, name)), float(given_std[i]))
        found.append(with_verdict(name, Estimate(float(values[i]), float(std[i])), before, float(limits[i]), unit))
    if found[0].status == UNKNOWN:
        # Slopes turn the plane about a point other than that of the level: without a level they are of no use.
        found[1:3] = [_kept_as_given(row) if row.status == FREE else row for row in found[1:3]]
    return found


def _kept_as_given(row: Parameter) -> Parameter:
    return replace(row, value=row.given, status=UNKNOWN, verdict="not observable: the level is not; the slope is kept")


def lens_verdicts(
    number: int, values: np.ndarray, std: np.ndarray, given: np.ndarray, given_std: np.ndarray
) -> list[Parameter]:
    """Verdicts on the parameters of one lens, (8,) each."""
    found = []
    for i, name in enumerate(LENS_NAMES):
        # Only the focal length scales heights; all else is of use however uncertain.
        limit = MOST_STD_FOCAL * given[0] if name == "f" else math.inf
        unit = " px" if i < 3 else ""
        before = Estimate(float(given[i]), float(given_std[i]))
        found.append(
            with_verdict(f"camera{number}.{name}", Estimate(float(values[i]), float(std[i])), before, limit, unit)
        )
    return found


def rate_verdict(found: Estimate, before: Estimate, hours: np.ndarray) -> Parameter:
    """Verdict on the rate of the level [m/h]; of no use if it leaves levels of photographs (V,) [h] as uncertain as one
    that is of none.
    """
    limit = MOST_STD_LEVEL_M / max(float(np.abs(hours).max()), 1e-9)
    return with_verdict(RATE_NAME, found, before, limit, " m/h")


def readout_limits(state: State, layout: Layout, heights: Sequence[int]) -> np.ndarray:
    """Limits (L,) of use [s] of readouts: they move the last row against the first by half a pixel on the ground.

    Parameters
    ----------
    heights : (L,) [px]
        Of the photographs of each lens.
    """
    assert layout.flow is not None
    away = np.maximum(state.centres[:, 2] - np.median(state.points[:, 2]), 1e-6)
    rows = np.array([rows_between(height) for height in heights])[layout.lens_of]
    px_per_s = np.linalg.norm(layout.flow, axis=1) * rows * state.lenses[layout.lens_of, 0] / away
    fastest = np.array([px_per_s[layout.lens_of == number].max() for number in range(len(layout.aspect))])
    return MOST_STD_ROWS_PX / np.maximum(fastest, 1e-9)


def readout_verdict(number: int, found: Estimate, before: Estimate, limit: float) -> Parameter:
    """Verdict on the readout [s] of the shutter behind one lens; ``limit`` as for `with_verdict`."""
    return with_verdict(f"camera{number}.{READOUT_NAME}", found, before, limit, " s")
