"""The water that a block of photographs determines: a value, a standard deviation and a verdict per parameter."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from survey.files.json_values import json_text
from survey.folder.config import WaterConfig

PARAMETERS = ("level_m", "slope_east", "slope_north", "refractive_index")


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of the water.

    Attributes
    ----------
    name : one of `PARAMETERS`
    value, std : of the adjustment
        Heights in m, in crs; slopes in m per m along the grid axes; the index relative to air.
    std_measured, std_pose, std_lens, std_bed :
        The parts of `std`: scatter of the tie points, errors of the poses and of the lens, roughness of the bed.
    given : what the search started from
    is_observable : bool
    verdict : a sentence
    """

    name: str
    value: float
    std: float
    std_measured: float
    std_pose: float
    std_lens: float
    std_bed: float
    given: float
    is_observable: bool
    verdict: str


@dataclass(frozen=True)
class WaterEstimate:
    """The water as a block determines it.

    Attributes
    ----------
    water : WaterConfig
        Values to use: estimates of the observable parameters, those of survey.toml for the rest.
    estimates : tuple of ParameterEstimate, in the order of `PARAMETERS`
    covariance : 4 x 4, in that order
    num_views, num_points, num_measurements : int
    num_dry : int
        Points above the water, which do not constrain it.
    rms_px : [px]
        Of the residuals of a pixel coordinate; None where there was no adjustment.
    pose_std_m, pose_std_deg, lens_std_px :
        What was assumed.
    """

    water: WaterConfig
    estimates: tuple[ParameterEstimate, ...]
    covariance: tuple[tuple[float, ...], ...]
    num_views: int
    num_points: int
    num_measurements: int
    num_dry: int
    rms_px: float | None
    pose_std_m: float
    pose_std_deg: float
    lens_std_px: float

    @property
    def is_observable(self) -> bool:
        """Whether anything is observable: without the level, nothing is."""
        return self.estimates[0].is_observable

    def correlation(self) -> np.ndarray:
        """Correlations (4, 4) of the estimates."""
        covariance = np.array(self.covariance)
        std = np.sqrt(np.diag(covariance))
        return covariance / np.outer(std, std)

    def to_json(self) -> str:
        """All of it as JSON; units are in the names, and NaN is null."""
        return json_text({**asdict(self), "correlation": self.correlation()})
