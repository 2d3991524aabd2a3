"""Verdicts on the parameters of an adjustment: found, held, or not observable."""

from __future__ import annotations

import math

import numpy as np

from survey.adjust.adjustment import FREE, HELD, UNKNOWN, Parameter
from survey.adjust.state import LENS_NAMES
from survey.adjust.water_settings import WATER_PARAMETERS
from survey.folder.config import WaterConfig

# One sigma beyond which a parameter is of no use. 5 cm of level move the bed by 2 cm, and so does 0.01 of index in 3 m
# of water; 0.5 % of the focal length moves the ground by 0.5 % of the flying height.
MOST_STD_LEVEL_M, MOST_STD_INDEX, MOST_STD_FOCAL = 0.05, 0.01, 0.005
# With more than this share of the standard deviation before, the photographs have told nearly nothing.
_LITTLE = 0.9


def judge(name: str, value: float, std: float, given: float, given_std: float, limit: float, unit: str) -> Parameter:
    """A parameter with its verdict; ``limit`` is the standard deviation beyond which it is of no use."""
    shown = f"{value:.{_digits(std)}f} +- {std:.2g}{unit}"
    prior = None if not math.isfinite(given_std) else given_std
    kept = f"{given:.{_digits(given_std)}f}{unit}"
    if std > limit and not given_std <= limit:
        verdict = (
            f"not observable: 1 sigma is {std:.2g}{unit}, at most {limit:.2g}{unit} would be of use; {kept} is kept"
        )
        return Parameter(name, given, std, given, prior, UNKNOWN, verdict)
    if std > _LITTLE * given_std:
        return Parameter(name, value, std, given, prior, HELD, f"held: {shown}, as given; the photographs add nothing")
    return Parameter(name, value, std, given, prior, FREE, f"found: {shown}{_against(value, std, given, prior, unit)}")


def lost_verdict(name: str, std: float, given: float, reason: str) -> Parameter:
    """A parameter of the water that keeps its given value for a reason."""
    kept = f"{given:.5f}" + (" m" if name == "level_m" else "")
    return Parameter(name, given, std, given, None, UNKNOWN, f"not observable: {reason}; {kept} is kept")


def _against(value: float, std: float, given: float, prior: float | None, unit: str) -> str:
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
    values: np.ndarray, covariance: np.ndarray, given: WaterConfig, given_std: np.ndarray, limits: np.ndarray
) -> list[Parameter]:
    """Verdicts on level, slopes and index, (4,) each, as survey.toml counts them."""
    found = []
    for i, name in enumerate(WATER_PARAMETERS):
        std, unit = float(np.sqrt(covariance[i, i])), " m" if i == 0 else ""
        before = float(getattr(given, name))
        found.append(judge(name, float(values[i]), std, before, float(given_std[i]), float(limits[i]), unit))
    return found


def lens_verdicts(
    number: int, values: np.ndarray, std: np.ndarray, given: np.ndarray, given_std: np.ndarray
) -> list[Parameter]:
    """Verdicts on the parameters of one lens, (8,) each."""
    found = []
    for i, name in enumerate(LENS_NAMES):
        # Only the focal length scales heights; all else is of use however uncertain.
        limit = MOST_STD_FOCAL * given[0] if name == "f" else math.inf
        unit = " px" if i < 3 else ""
        full = f"camera{number}.{name}"
        found.append(judge(full, float(values[i]), float(std[i]), float(given[i]), float(given_std[i]), limit, unit))
    return found
