"""The water of a scene: its surface in the local frame, with waves or as measured.

Its colour results from absorption, and from scattering into the path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo import read_reference, require_same_crs
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import in_height_unit, vertices_of
from refract import FlatWater
from refract.curved import BicubicWater, WavyWater
from survey.errors import SurveyError
from survey.simulate.scene_file import WaveSettings


def with_waves(plane: FlatWater, waves: Sequence[WaveSettings]) -> WavyWater:
    """A plane with trains of waves on it."""
    vectors, phases = [], []
    for wave in waves:
        toward, number = math.radians(wave.toward_deg), 2.0 * math.pi / wave.length_m
        vectors.append((number * math.sin(toward), number * math.cos(toward)))
        phases.append(math.radians(wave.phase_deg))
    return WavyWater(
        plane.point,
        [wave.amplitude_m for wave in waves],
        vectors,
        phases,
        n_water=plane.n_water,
        slope_x=plane.slope_x,
        slope_y=plane.slope_y,
    )


def measured_surface(path: Path, frame: LocalFrame, n_water: float) -> BicubicWater:
    """The surface interpolated between measured points in crs, from a raster, cloud or mesh."""
    shape = read_reference(path)
    require_same_crs(frame.crs, shape.crs, "the scene", str(path))
    shape = in_height_unit(shape, height_unit_m(frame.crs))
    points = frame.local_from_crs(vertices_of(shape))
    try:
        return BicubicWater.from_points(points[:, :2], points[:, 2], n_water=n_water)
    except ValueError as error:
        raise SurveyError(f"{path} gives no water surface: {error}") from error


@dataclass(frozen=True)
class WaterOptics:
    """Optical properties of the water."""

    # (3,) [1/m]: of red, green and blue; the default is a lake with a little yellow substance
    absorption: tuple[float, float, float] = (0.17, 0.042, 0.055)
    scattering: float = 0.2  # [1/m]: of all colours alike
    # [-]: mean cosine of scattering; natural water scatters forward (0.92: Mobley 1994, for Petzold's measurements)
    asymmetry: float = 0.92
    # (3,): radiance of infinitely deep water, for the mode without light transport
    veil: tuple[float, float, float] = (0.03, 0.17, 0.21)
    veiling: float = 0.06  # [1/m]: rate at which the veil builds up, in the same mode
    sky: float = 0.55  # [-]: radiance that the surface reflects, in the same mode

    @property
    def delta_eddington(self) -> tuple[float, float]:
        """Scattering [1/m] and asymmetry by delta-Eddington scaling (Joseph, Wiscombe and Weinman 1976).

        The share ``g**2`` in the forward peak counts as not scattered, the rest has the asymmetry ``g / (1 + g)``. Lost
        is the halo of a few degrees around bright objects.
        """
        g = self.asymmetry
        return self.scattering * (1.0 - g * g), g / (1.0 + g)

    def seen_through(self, dry: np.ndarray, depth: np.ndarray, in_water: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) of ground of radiance ``dry`` (N, 3) seen through water.

        The light goes down by the depth (N,) [m] of the ground, and up to the surface by `in_water` (N,) [m].
        """
        bed = dry * np.exp(-np.array(self.absorption) * (depth + in_water)[:, None])
        return bed + np.array(self.veil) * (1.0 - np.exp(-self.veiling * in_water))[:, None]
