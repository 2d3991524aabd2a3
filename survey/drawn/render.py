"""Photographs of the ground through water: bent rays, light on its way, and the grey levels of a sensor.

Written on its own, without `refract`: what is drawn here is a test of the optics there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import PinholeCamera
from survey.drawn.ground import Ground
from survey.drawn.shapes import near_solids

# Rays at a time: they and what is derived from them stay in the cache.
_RAYS_AT_A_TIME = 1 << 15
# Rays per pixel along each axis.
_SUBPIXELS = 2
# Absorption of red, green and blue per metre of path, of a lake with a little yellow substance [1/m].
_ABSORPTION = np.array([0.17, 0.042, 0.055])
# Light scattered into the path per metre of it [1/m], and where that ends for a path without end.
_SCATTERING, _VEIL = 0.06, np.array([0.03, 0.17, 0.21])
_SKY = 0.55
_GAMMA = 2.2


@dataclass(frozen=True)
class Hits:
    """Where rays end.

    Attributes
    ----------
    points : (N, 3) [m], local
    body, plane : (N,)
        Body of the ground, -1 for the bed, and the plane of it.
    in_water : (N,) [m]
        Way in water; zero for points above it.
    incidence : (N,)
        Cosine of the angle of incidence at the water surface.
    """

    points: np.ndarray
    body: np.ndarray
    plane: np.ndarray
    in_water: np.ndarray
    incidence: np.ndarray


@dataclass(frozen=True)
class Renderer:
    """Looks at a ground, through water if there is any.

    Parameters
    ----------
    ground : Ground
    normal : (3,) unit, or None
        Of the water surface, which passes through the origin of the local frame; None for no water.
    n_water : [-]
    """

    ground: Ground
    normal: np.ndarray | None
    n_water: float

    def trace(self, camera: PinholeCamera, pixels: np.ndarray) -> Hits:
        """What pixels (N, 2) [px] of a camera see."""
        direction = camera.directions(pixels)
        origin = np.broadcast_to(camera.centre, direction.shape)
        if self.normal is None:
            t, body, plane = self._first(origin, direction, np.full(len(direction), np.inf))
            return Hits(origin + t[:, None] * direction, body, plane, 0.0 * t, 1.0 + 0.0 * t)
        falling = -direction @ self.normal
        in_air = origin @ self.normal / falling
        t, body, plane = self._first(origin, direction, in_air)
        points, in_water = origin + t[:, None] * direction, np.zeros(len(t))
        wet = np.flatnonzero(~np.isfinite(t))
        crossing = origin[wet] + in_air[wet, None] * direction[wet]
        # Snell: the component along the surface shrinks by the index, the other fills up to unit length.
        along = (direction[wet] + falling[wet, None] * self.normal) / self.n_water
        bent = along - np.sqrt(1.0 - np.sum(along**2, axis=1, keepdims=True)) * self.normal
        in_water[wet], body[wet], plane[wet] = self._first(crossing, bent, np.full(len(wet), np.inf))
        points[wet] = crossing + in_water[wet, None] * bent
        return Hits(points, body, plane, in_water, falling)

    def radiance(self, camera: PinholeCamera, pixels: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) that reaches pixels (N, 2) [px]."""
        hits = self.trace(camera, pixels)
        dry = self.ground.colour(hits.points, hits.body, hits.plane)
        if self.normal is None:
            return dry
        depth = np.maximum(-(hits.points @ self.normal), 0.0)
        # Light goes down to the bed and up to the surface.
        bed = dry * np.exp(-_ABSORPTION * (depth + hits.in_water)[:, None])
        seen = bed + _VEIL * (1.0 - np.exp(-_SCATTERING * hits.in_water))[:, None]
        mirrored = self._fresnel(hits.incidence)[:, None]
        wet = (hits.in_water > 0.0)[:, None]
        return np.where(wet, (1.0 - mirrored) * seen + mirrored * _SKY, dry)

    def photograph(self, camera: PinholeCamera, noise: float, rng: np.random.Generator) -> np.ndarray:
        """The image (height, width, 3) uint8 of a camera, with `noise` [grey levels]."""
        fine = camera.scaled(_SUBPIXELS)
        pixels = fine.pixel_centres().reshape(-1, 2)
        parts = [self.radiance(fine, pixels[k : k + _RAYS_AT_A_TIME]) for k in range(0, len(pixels), _RAYS_AT_A_TIME)]
        image = np.concatenate(parts).reshape(camera.height, _SUBPIXELS, camera.width, _SUBPIXELS, 3).mean(axis=(1, 3))
        grey = 255.0 * np.clip(image, 0.0, 1.0) ** (1.0 / _GAMMA)
        if noise > 0.0:
            grey += noise * rng.standard_normal(grey.shape)
        return np.clip(np.round(grey), 0.0, 255.0).astype(np.uint8)

    def _first(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray):
        """Distance to the first thing up to `t_end`, infinite for none, and its body and plane, each (N,)."""
        t = self.ground.bed.hit(origin, direction, t_end)
        body, plane = np.full(len(t), -1), np.zeros(len(t), dtype=np.int64)
        ends = np.minimum(t, t_end)
        top = max((solid.centre[2] + solid.radius for solid in self.ground.solids), default=-np.inf)
        # Ways through air mostly end above all bodies.
        low = np.flatnonzero(origin[:, 2] + ends * direction[:, 2] < top)
        if not low.size:
            return t, body, plane
        near = near_solids(self.ground.solids, origin[low], direction[low], ends[low])
        for index, solid in enumerate(self.ground.solids):
            rays = low[near[:, index]]
            t_solid, plane_solid = solid.hit(origin[rays], direction[rays])
            nearer = (t_solid < t[rays]) & (t_solid <= t_end[rays])
            rays = rays[nearer]
            t[rays], body[rays], plane[rays] = t_solid[nearer], index, plane_solid[nearer]
        return t, body, plane

    def _fresnel(self, cosine: np.ndarray) -> np.ndarray:
        """Share of unpolarised light that the surface mirrors."""
        n = self.n_water
        inside = np.sqrt(1.0 - (1.0 - cosine**2) / n**2)
        across = ((cosine - n * inside) / (cosine + n * inside)) ** 2
        along = ((n * cosine - inside) / (n * cosine + inside)) ** 2
        return 0.5 * (across + along)
