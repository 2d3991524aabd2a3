"""A scene made ready: its place on Earth, its cameras, its water and its ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from refract.lens import Lens
from refract.surfaces import WaterSurface
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.render.sun_on_waves import SunOnWaves
from survey.simulate.sensor import Eye, Sensor
from survey.simulate.water import WaterLevel


@dataclass(frozen=True)
class StagedScene:
    """A scene with its cameras and its ground, ready to be photographed."""

    # name, crs: As survey.toml has them
    name: str
    crs: str
    frame: LocalFrame
    # Local, without the distortion of `lens`. Where their shutters roll (`PinholeCamera.motion`), `lens` has none;
    # where they have tides, the water is a plane.
    cameras: tuple[PinholeCamera, ...]
    lens: Lens  # Of all photographs
    level: WaterLevel | None  # Water settings for survey.toml
    # Exact in geometry: it computes the ground truth, whichever renderer takes the photographs
    renderer: DirectRenderer
    sensor: Sensor
    bounds: tuple[float, float, float, float]  # (e0, n0, e1, n1), in crs: what is evaluated
    seed: int
    eye: Eye | None = None  # callable, optional: light along rays; by default that of `renderer`
    velocities: np.ndarray | None = None  # (cameras, 3) [m/s], local, or None: for XMP; None writes none
    position_std_m: float = 0.02  # [m]: of the positions in EXIF, in each direction
    readout_s: float = 0.0  # [s]: of rolling shutters, for survey.toml; 0 where all rows are exposed at once
    # (cameras,) of SunOnWaves: caustics and glint of each photograph that `renderer` takes; none where there are
    # neither
    suns: tuple[SunOnWaves, ...] = ()
    # [nm] or None: of the light that the index of `level` belongs to, for survey.toml; None for that of the photographs
    index_wavelength_nm: float | None = None
    duration_s: float = 0.0  # [s]: from the first photograph to the last, for EXIF and a gauge; 0 writes neither

    @property
    def water(self) -> WaterSurface | None:
        """The surface of the water, local."""
        return self.renderer.water

    @property
    def names(self) -> list[str]:
        """File names of the photographs: JPEG, or PNG without loss where there is no noise."""
        suffix = ".jpg" if self.sensor.noise > 0.0 or self.sensor.by_chance else ".png"
        return [f"{k:04d}{suffix}" for k in range(len(self.cameras))]

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera."""
        renderer, camera = self.at(index)
        if self.suns:
            renderer = replace(renderer, sun=self.suns[index])
        eye = self.eye or renderer.radiance_of_rays
        return self.sensor.photograph(eye, camera, self.lens, (self.seed, index))

    def at(self, index: int) -> tuple[DirectRenderer, PinholeCamera]:
        """The renderer with the water as it stands when a photograph is taken, and the camera, without its tide."""
        camera, water = self.cameras[index], self.renderer.water
        if camera.tide == 0.0 or not isinstance(water, FlatWater):
            return self.renderer, camera
        x, y, z = water.point
        own = replace(water, point=(x, y, z + camera.tide))
        return replace(self.renderer, water=own), replace(camera, tide=0.0)
