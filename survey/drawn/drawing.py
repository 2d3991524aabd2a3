"""A drawn scene made ready: its place on Earth, its cameras, its water and its ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from survey.drawn.ground import build_ground
from survey.drawn.render import Renderer
from survey.drawn.scene import DrawnScene


@dataclass(frozen=True)
class Drawing:
    """A scene with its cameras and its ground, ready to be photographed.

    Attributes
    ----------
    scene : DrawnScene
    frame : LocalFrame
        Its origin lies on the water surface, in the middle of the area.
    cameras : tuple of PinholeCamera
    water : FlatWater or None
    renderer : Renderer
    """

    scene: DrawnScene
    frame: LocalFrame
    cameras: tuple[PinholeCamera, ...]
    water: FlatWater | None
    renderer: Renderer

    @classmethod
    def of(cls, scene: DrawnScene) -> Drawing:
        """Build the ground of a scene."""
        frame = LocalFrame(parse_crs(scene.crs), (*scene.origin, scene.level_m))
        normal, water = None, None
        if scene.water:
            normal = frame.local_from_grid(frame.origin) @ (-scene.slope_east, -scene.slope_north, 1.0)
            normal = normal / np.linalg.norm(normal)
            slopes = -normal[:2] / normal[2]
            water = FlatWater((0.0, 0.0, 0.0), scene.n_water, float(slopes[0]), float(slopes[1]))
        renderer = Renderer(build_ground(scene), normal, scene.n_water)
        return cls(scene, frame, tuple(scene.cameras()), water, renderer)

    @property
    def names(self) -> list[str]:
        return [f"{k:04d}{self.scene.suffix}" for k in range(len(self.cameras))]

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Easting and northing, low then high, in crs, of what is evaluated."""
        (e, n), (width, depth) = self.scene.origin, self.scene.size_m
        return (e - 0.5 * width, n - 0.5 * depth, e + 0.5 * width, n + 0.5 * depth)

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera."""
        rng = np.random.default_rng([self.scene.seed, 3, index])
        return self.renderer.photograph(self.cameras[index], self.scene.noise, rng)
