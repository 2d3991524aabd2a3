"""Where photographs show a point of the bed, and the ways of light that end there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from refract import FlatWater
from survey.photos.cameras import View


@dataclass(frozen=True)
class Sighting:
    """One photograph in whose frame a point lies; whether something stands before it is not asked.

    Attributes
    ----------
    view : View
    pixel : (2,) [px]
    camera, crossing, point : (3,) [m], local
        Corners of the ray; the crossing of the water is the point itself where the ray is straight.
    incidence : [rad]
        Between the ray in air and the vertical.
    """

    view: View
    pixel: np.ndarray
    camera: np.ndarray
    crossing: np.ndarray
    point: np.ndarray
    incidence: float

    @property
    def is_bent(self) -> bool:
        """Whether the ray goes through water."""
        return bool((self.crossing != self.point).any())


def sightings_of(views: Sequence[View], point: np.ndarray, water: FlatWater | None) -> list[Sighting]:
    """The photographs whose frames hold a point (3,) [m], local, as seen through the water; the steepest first."""
    found = [sighting for view in views if (sighting := _sighting(view, point, water)) is not None]
    return sorted(found, key=lambda sighting: sighting.incidence)


def _sighting(view: View, point: np.ndarray, water: FlatWater | None) -> Sighting | None:
    camera = view.camera
    pixel = camera.project(point, water)
    if not camera.sees(pixel):
        return None
    path = camera.paths(pixel, water)
    # A dry point lies before the place where its ray would meet the water.
    is_bent = bool(path.wet) and float(path.air_length) < float(np.linalg.norm(point - path.origin))
    incidence = float(np.arccos(np.clip(-path.air_direction[2], -1.0, 1.0)))
    return Sighting(view, pixel, path.origin, path.crossing if is_bent else point, point, incidence)
