"""Direct rendering through water: refracted rays and simple light, exact in geometry and free of noise.

Rays cross a flat surface by formulas of this module, not by those of `refract`, so that the photographs test the
optics there. Other surfaces are crossed by `refract`.
"""

from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater, PinholeCamera, trace
from refract.snell import fresnel_coefficients
from refract.surfaces import WaterSurface
from survey.simulate.conditions import WaterOptics
from survey.simulate.ground import Ground

# Rays at a time, so that they and derived arrays stay in the cache.
_RAYS_AT_A_TIME = 1 << 15


@dataclass(frozen=True)
class Hits:
    points: np.ndarray  # (N, 3) [m], local: NaN for a ray that meets nothing
    # body, face (N,): body of the ground, `BED` for the bed, `NOTHING` for none, and the face of it
    body: np.ndarray
    face: np.ndarray
    # (N,) [m]: path length in water; zero for points above it, infinite for a ray that meets nothing in it
    in_water: np.ndarray
    incidence: np.ndarray  # (N,): cosine of the angle of incidence at the water surface


@dataclass(frozen=True)
class DirectRenderer:
    """Renderer of a ground without light transport, through water if there is any.

    `indices` are those of the water for red, green and blue; None where all have that of ``water``, which is also that
    of the truth.
    """

    ground: Ground
    water: WaterSurface | None
    colour: WaterOptics
    indices: tuple[float, float, float] | None = None

    def trace(self, camera: PinholeCamera, pixels: np.ndarray) -> Hits:
        """Hits of the rays of pixels (N, 2) [px] of a camera."""
        direction = camera.directions(pixels)
        return self.trace_rays(np.broadcast_to(camera.centres(pixels), direction.shape), direction)

    def trace_rays(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Hits of rays from origins (N, 3) [m] in unit directions (N, 3), local."""
        in_air, bent, incidence = np.full(len(direction), np.inf), direction, np.ones(len(direction))
        if self.water is not None:
            in_air, bent, incidence = _cross(self.water, origin, direction)
        t, body, face = self.ground.first_hit(origin, direction, in_air)
        points, in_water = origin + np.where(np.isfinite(t), t, np.nan)[:, None] * direction, np.zeros(len(t))
        wet = np.flatnonzero(~np.isfinite(t) & np.isfinite(in_air))
        crossing, bent = origin[wet] + in_air[wet, None] * direction[wet], bent[wet]
        in_water[wet], body[wet], face[wet] = self.ground.first_hit(crossing, bent, np.full(len(wet), np.inf))
        points[wet] = crossing + np.where(np.isfinite(in_water[wet]), in_water[wet], np.nan)[:, None] * bent
        return Hits(points, body, face, in_water, incidence)

    def radiance(self, camera: PinholeCamera, pixels: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) that reaches pixels (N, 2) [px]."""
        direction = camera.directions(pixels)
        return self.radiance_of_rays(np.broadcast_to(camera.centres(pixels), direction.shape), direction)

    def radiance_of_rays(self, origin: np.ndarray, direction: np.ndarray, seed: int = 0) -> np.ndarray:
        """Linear radiance (N, 3) along rays; see `trace_rays`. Deterministic: `seed` is not used."""
        parts = range(0, len(direction), _RAYS_AT_A_TIME)
        ends = [slice(k, k + _RAYS_AT_A_TIME) for k in parts]
        if self.indices is None or not isinstance(self.water, FlatWater):
            return np.concatenate([self._radiance(origin[part], direction[part]) for part in ends])
        bent = [replace(self, water=replace(self.water, n_water=n), indices=None) for n in self.indices]
        channels = [each.radiance_of_rays(origin, direction)[:, channel] for channel, each in enumerate(bent)]
        return np.stack(channels, axis=-1)

    def _radiance(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        hits = self.trace_rays(origin, direction)
        dry = self.ground.colour(hits.points, hits.body, hits.face)
        if self.water is None:
            return dry
        depth = np.where(np.isfinite(hits.in_water), np.maximum(depth_below(self.water, hits.points), 0.0), 0.0)
        wet = hits.in_water > 0.0
        seen = self.colour.seen_through(dry, depth, hits.in_water)
        crossed = fresnel_coefficients(hits.incidence, n_from=1.0, n_to=self.water.n_water)
        mirrored = crossed.reflectance[:, None]
        return np.where(wet[:, None], (1.0 - mirrored) * seen + mirrored * self.colour.sky, dry)


def _cross(water: WaterSurface, origin: np.ndarray, direction: np.ndarray):
    """Distance to the surface (N,) [m], direction below it (N, 3), and cosine of incidence (N,)."""
    if not isinstance(water, FlatWater):
        paths = trace(origin, direction, water)
        # Of the angle by which rays were bent; from sin a = n sin(a - bend): tan a = n sin(bend) / (n cos(bend) - 1).
        cosine = np.clip(np.einsum("ij,ij->i", paths.water_direction, direction), -1.0, 1.0)
        tangent = water.n_water * np.sqrt(1.0 - cosine**2) / np.maximum(water.n_water * cosine - 1.0, 1e-12)
        return paths.air_length, paths.water_direction, 1.0 / np.hypot(1.0, tangent)
    normal = np.array(water.up)
    falling = -direction @ normal
    with np.errstate(divide="ignore"):
        in_air = (origin - water.point) @ normal / falling
    in_air = np.where(falling > 0.0, in_air, np.inf)
    # Snell: the component along the surface is divided by the index, the other follows from unit length.
    along = (direction + falling[:, None] * normal) / water.n_water
    bent = along - np.sqrt(1.0 - np.sum(along**2, axis=1, keepdims=True)) * normal
    return in_air, bent, np.abs(falling)


def depth_below(water: WaterSurface | None, points: np.ndarray) -> np.ndarray:
    """Vertical depth (N,) [m] of points (N, 3) below the water, or below the origin of local without it."""
    level = 0.0 if water is None else water.height(points[:, 0], points[:, 1])
    return level - points[:, 2]
