"""The water of a scene: its level, in crs, and its surface in the local frame, still, with waves or as measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo import read_reference
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import in_height_unit, vertices_of
from refract import FlatWater, HeightFieldWater, WavyWater
from survey.errors import SurveyError
from survey.simulate.scene_file import WaveSettings


@dataclass(frozen=True)
class WaterLevel:
    """Still water, as in survey.toml.

    Attributes
    ----------
    level_m : [m]
        Height of the surface at `level_at`, in crs.
    level_at : (easting, northing), in crs
    slope_east, slope_north : [-]
        Rise per metre along the grid axes.
    refractive_index : [-]
        Relative to air.
    """

    level_m: float
    level_at: tuple[float, float]
    slope_east: float = 0.0
    slope_north: float = 0.0
    refractive_index: float = 1.333

    def plane(self, frame: LocalFrame) -> FlatWater:
        """The surface in local."""
        at = np.array([*self.level_at, self.level_m])
        normal = frame.local_from_grid(at) @ (-self.slope_east, -self.slope_north, 1.0)
        x, y, z = frame.local_from_crs(at).tolist()
        slopes = -normal[:2] / normal[2]
        return FlatWater((x, y, z), n_water=self.refractive_index, slope_x=float(slopes[0]), slope_y=float(slopes[1]))


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


def measured(path: Path, frame: LocalFrame, n_water: float) -> HeightFieldWater:
    """The surface interpolated between measured points in crs, from a raster, cloud or mesh.

    Raises
    ------
    SurveyError, GeoError
        If no surface can be fitted through them.
    """
    shape = in_height_unit(read_reference(path), height_unit_m(frame.crs))
    points = frame.local_from_crs(vertices_of(shape))
    try:
        return HeightFieldWater.from_points(points[:, :2], points[:, 2], n_water=n_water)
    except ValueError as error:
        raise SurveyError(f"{path} gives no water surface: {error}") from error
