"""Photographs with their height maps, as the sweep passes them to the estimation of colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fields.sweep.bed import trusted
from fields.sweep.maps import DepthMap
from refract import FlatWater, PinholeCamera


@dataclass
class Sources:
    """Photographs with a height map: one entry per matched view.

    Attributes
    ----------
    cameras : list of PinholeCamera
    maps : sequence of DepthMap
    images : list of (height, width, 3) uint8
    water : FlatWater or None
    absorption, veil : (3,) floats, optional
        Of the water, where they are known; see `fields.water_column.WaterColumn`.
    """

    cameras: list[PinholeCamera]
    maps: Sequence[DepthMap]
    images: list[np.ndarray]
    water: FlatWater | None
    absorption: tuple[float, ...] | None = None
    veil: tuple[float, ...] | None = None

    @cached_property
    def pixels(self) -> list[np.ndarray]:
        """Flat indices of the trusted pixels of each map, inside its image."""
        found = []
        for camera, depth_map in zip(self.cameras, self.maps, strict=True):
            keep = trusted(depth_map)
            keep[camera.height :], keep[:, camera.width :] = False, False
            found.append(np.flatnonzero(keep))
        return found
