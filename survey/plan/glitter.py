"""Sun glitter on the water: affected photographs, and places of the bed that are seen free of it.

Facets of the water reflect the sun into the camera where their normal is halfway between the directions to the sun and
to the camera. C. Cox and W. Munk (Journal of the Optical Society of America 44, 1954, 838-850) measured their slopes: a
slope s has the density ``exp(-s^2 / v) / (pi v)`` with ``v = 0.003 + 0.00512 W``, W the wind [m/s] 12.5 m above the
sea. Glitter is taken to end where facets are a tenth as frequent as level ones. On rivers and ponds, where fetch is
short, it is narrower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from refract import FlatWater, PinholeCamera
from survey.folder.survey import Survey
from survey.plan.area import ASSUMED_DEPTH_M, Places, places_of

# A light breeze, in which most surveys of clear shallow water are flown [m/s].
USUAL_WIND_M_S = 3.0
# Glitter ends where facets are this frequent, relative to level ones.
_RAREST = 0.1
_MOST_PLACES = 400
# Samples along the longer side of a frame.
_STEPS = 24


@dataclass(frozen=True)
class Glitter:
    """Effect of sun glitter on a flight."""

    num_views: int
    num_mirrored: int  # Photographs whose frame contains the mirror image of the sun on level water
    share: tuple[float, float]  # (median, largest): share of a photograph within the glitter
    # views, free_views (low, median) or None: photographs of a place, and those that show it free of glitter: 10 %
    # quantile over the places, and median. None where too few views overlap.
    views: tuple[float, float] | None
    free_views: tuple[float, float] | None


def slope_variance(wind_m_s: float) -> float:
    """Mean square slope [-] of the sea in a wind (Cox and Munk 1954)."""
    return 0.003 + 0.00512 * wind_m_s


def largest_facet_slope(wind_m_s: float) -> float:
    """Largest slope angle [rad] of facets at the edge of the glitter."""
    return math.atan(math.sqrt(-math.log(_RAREST) * slope_variance(wind_m_s)))


def glitters(directions: np.ndarray, sun: np.ndarray, up: np.ndarray, wind_m_s: float) -> np.ndarray:
    """Mask of unit rays (..., 3) that end in the glitter of a sun in direction (3,); `up`: normal of the water."""
    facet = sun - directions
    with np.errstate(invalid="ignore"):
        lean = (facet @ up) / np.linalg.norm(facet, axis=-1)
    return (lean >= math.cos(largest_facet_slope(wind_m_s))) & (directions @ up < 0.0) & (sun @ up > 0.0)


class GlitterOfFlight:
    """Rays of a flight over water of a normal (3,), local, for the glitter of any sun; places of the bed under it."""

    def __init__(
        self, cameras: list[PinholeCamera], up: np.ndarray, places: Places | None = None, water: FlatWater | None = None
    ):
        self._cameras, self._up = cameras, up
        self._frames = [camera.directions(_pixels(camera)) for camera in cameras]
        places = None if places is None else places.some(_MOST_PLACES)
        self._seen = None if places is None else places.seen
        self._rays = [] if places is None else [c.directions(c.project(places.cells, water)) for c in cameras]

    @classmethod
    def of(cls, survey: Survey) -> GlitterOfFlight:
        """Glitter on a survey with water, for a bed two metres deep."""
        water, _ = survey.require_water()
        cameras = [view.camera for view in survey.views]
        return cls(cameras, np.array(water.up), places_of(survey, ASSUMED_DEPTH_M), water)

    def under(self, suns: np.ndarray, wind_m_s: float) -> Glitter:
        """Under the suns (V, 3) of the photographs, or one (3,) for all: unit directions, local."""
        suns, up = np.broadcast_to(suns, (len(self._cameras), 3)), self._up
        pairs = list(zip(self._frames, suns, strict=True))
        shares = [float(glitters(rays, sun, up, wind_m_s).mean()) for rays, sun in pairs]
        mirrors = suns - 2.0 * (suns @ up)[:, None] * up
        num_mirrored = sum(
            bool(sun @ up > 0.0 and camera.sees(camera.project(camera.centre + mirror, None)))
            for camera, sun, mirror in zip(self._cameras, suns, mirrors, strict=True)
        )
        every = free = None
        if self._seen is not None:
            glittering = np.array(
                [glitters(rays, sun, up, wind_m_s) for rays, sun in zip(self._rays, suns, strict=True)]
            )
            every, free = _low_and_median(self._seen), _low_and_median(self._seen & ~glittering)
        return Glitter(len(shares), num_mirrored, (float(np.median(shares)), max(shares)), every, free)

    def highest_sun(self, wind_m_s: float) -> float:
        """Largest elevation [rad] of the sun that keeps steep views free of glitter; negative where there is none."""
        # Of the steepest half of the views.
        down = np.array([float(camera.cam_from_local[2] @ self._up) for camera in self._cameras])
        steep = np.argsort(down, kind="stable")[: max(len(down) // 2, 1)]
        cosines = [self._frames[number] @ -self._up for number in steep]
        widest = max(float(np.arccos(np.clip(each, -1.0, 1.0)).max()) for each in cosines)
        # A reflected ray turns by twice the slope of the facet.
        return 0.5 * math.pi - widest - 2.0 * largest_facet_slope(wind_m_s)


def _pixels(camera: PinholeCamera) -> np.ndarray:
    """Grid of pixels (N, 2) over a frame, in the middles of squares."""
    side = max(camera.width, camera.height) / _STEPS
    u, v = np.meshgrid(np.arange(0.5 * side, camera.width, side), np.arange(0.5 * side, camera.height, side))
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def _low_and_median(seen: np.ndarray) -> tuple[float, float]:
    counts = seen.sum(axis=0)
    return float(np.quantile(counts, 0.1)), float(np.median(counts))
