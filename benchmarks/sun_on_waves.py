"""The sun on waves in photographs of a drawn survey: caustics and glint, with other waves in each photograph.

The waves of one photograph are a tile of a random surface that repeats, with slopes of
equal variance in each octave of wavelengths. Viewing rays are not refracted by them, so that the ground truth is that
of still water. Caustics: a ray of the sun that enters where the surface slopes by ``s`` ends ``(1 - 1 / n) d s`` away
from where it would under still water, at depth ``d``. Rays through all of the tile are counted on a grid at several
depths, blurred by the disc of the sun, and multiply the light of the bed. Glint: ripples smaller than a cell of the
tile have Gaussian slopes of standard deviation ``r`` about ``s``. With ``h`` the half vector between the directions to
camera and sun, ``p`` the density of ripples whose normal is ``h``, and ``E`` the irradiance of the sun, the radiance is
``R E p / (4 cos(view) cos(h)^4)``, R by Fresnel (Cox and Munk, J. Opt. Soc. Am. 44(11), 838-850, 1954).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from refract import FlatWater, PinholeCamera
from refract.snell import fresnel_coefficients
from survey.errors import SurveyError
from survey.simulate.conditions import Light
from survey.simulate.direct import DirectRenderer, depth_below
from survey.simulate.sidecars import StagedScene

# Toward the sun where it glints: 72 degrees over the horizon, so that level views meet its mirror image too.
HIGH_SUN = (0.27, 0.18, 1.0)
# Of the tile: cells along a side, and their size [m].
_CELLS, _CELL_M = 256, 0.03
# Shortest and longest waves [m], and ripples against them. Standard deviation of slopes along each axis, after Cox and
# Munk: that of a wind of 3 m/s, and what it grows by per share of glint: to a wind of 10 m/s for 0.3.
_WAVES_M, _RIPPLES = (0.12, 1.6), 0.5
_SLOPE_STD, _SLOPE_PER_SHARE = 0.09, 0.25
# Depths of the caustics, and rays for each cell along an axis.
_LAYERS, _RAYS = 12, 3
# Light on the bed is at least this share of its mean: the sky shines everywhere.
_LEAST_LIGHT = 0.1
# Rays along each axis that sample the glint of a photograph; the largest brightness of the sun.
_PROBES, _BRIGHTEST = (40, 30), 1000.0


@dataclass(frozen=True)
class SunOnWaves:
    """Caustics and glint of the sun on the waves of one photograph."""

    plane: FlatWater  # The mean surface
    light: Light
    # (2, cells, cells) [-]: rise of the surface along local x and y; the tile begins at the origin of local
    slopes: np.ndarray
    ripples: float  # [-]: standard deviation of slopes below a pixel of the tile
    # (layers, cells, cells) [-]: light on level ground over its mean, at depths from 0 to ``deepest_m``; empty without
    # caustics
    caustics: np.ndarray
    deepest_m: float  # [m]
    glint: float  # [-]: brightness of the reflected sun as a multiple of the formula's; 0 for none

    def on_bed(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Light (N,) on points (N, 3) [m], local, at depths (N,) [m], relative to that under still water."""
        gain = np.ones(len(points))
        if not len(self.caustics):
            return gain
        sun = self.light.sun[:2] / self.plane.n_water
        places = points[:, :2] + depth[:, None] * sun / np.sqrt(1.0 - sun @ sun)
        layer = np.clip(depth / self.deepest_m, 0.0, 1.0) * (len(self.caustics) - 1)
        below = np.minimum(layer.astype(int), len(self.caustics) - 2)
        # Whole layers take turns: the tile repeats along its own axes alone.
        for number in np.unique(below):
            in_layer = below == number
            low, high = (_on_tile(self.caustics[number + k], places[in_layer]) for k in (0, 1))
            gain[in_layer] = low + (layer[in_layer] - number) * (high - low)
        return gain

    def with_caustics(self, depth_m: float, contrast: float) -> SunOnWaves:
        """The sun with caustics.

        `contrast` is standard deviation over mean of the light on the bed at its mean depth [m]; other depths follow.
        """
        deepest_m = 2.0 * depth_m
        caustics = _caustics(self.slopes, self.plane.n_water, deepest_m, depth_m, contrast)
        return replace(self, caustics=caustics, deepest_m=deepest_m)

    def reflected(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Radiance (N,) of the sun that the surface reflects into rays from origins in unit directions (N, 3)."""
        return self.glint * self._mirrored(origin, direction) if self.glint > 0.0 else np.zeros(len(direction))

    def _mirrored(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        up = np.array(self.plane.up)
        falling = np.maximum(-direction @ up, 1e-3)
        crossing = origin + (((origin - self.plane.point) @ up) / falling)[:, None] * direction
        half = self.light.sun - direction
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        missing = np.stack([-half[:, k] / half[:, 2] - _on_tile(self.slopes[k], crossing[:, :2]) for k in (0, 1)])
        density = np.exp(-0.5 * np.sum(missing**2, axis=0) / self.ripples**2) / (2.0 * np.pi * self.ripples**2)
        cosine = np.clip(-np.einsum("ij,ij->i", direction, half), 0.0, 1.0)
        mirrored = fresnel_coefficients(cosine, n_from=1.0, n_to=self.plane.n_water).reflectance
        return mirrored * self.light.sun_irradiance * density / (4.0 * falling * half[:, 2] ** 4)


@dataclass(frozen=True)
class SunlitRenderer(DirectRenderer):
    """Renderer of one photograph with the sun on its waves, which run on the plane of the water."""

    sun: SunOnWaves | None = None

    def _radiance(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        if self.water is None or self.sun is None:
            raise SurveyError("waves need water and a sun, expected both; draw a scene with water")
        hits = self.trace_rays(origin, direction)
        dry = self.ground.colour(hits.points, hits.body, hits.face)
        depth = np.where(np.isfinite(hits.in_water), np.maximum(depth_below(self.water, hits.points), 0.0), 0.0)
        wet = hits.in_water > 0.0
        lit = dry * np.where(wet, self.sun.on_bed(np.nan_to_num(hits.points), depth), 1.0)[:, None]
        seen = self.colour.seen_through(lit, depth, hits.in_water)
        crossed = fresnel_coefficients(hits.incidence, n_from=1.0, n_to=self.water.n_water)
        mirrored = crossed.reflectance[:, None]
        surface = mirrored * self.colour.sky + self.sun.reflected(origin, direction)[:, None]
        return np.where(wet[:, None], (1.0 - mirrored) * seen + surface, dry)


def sunlit(plain: StagedScene, sun: SunOnWaves) -> StagedScene:
    """The scene of one photograph under the sun on its waves."""
    return replace(plain, renderer=SunlitRenderer(**vars(plain.renderer), sun=sun))


def suns_of(
    cameras: Sequence[PinholeCamera],
    plane: FlatWater,
    light: Light,
    *,
    seed: int,
    glint_share: float,
) -> tuple[SunOnWaves, ...]:
    """The sun on the waves of each photograph, which differ from one to the next; without caustics.

    The reflected sun alone saturates `glint_share` of the pixels of all photographs; its brightness is set to reach
    that.
    """
    found, slope_std = [], _SLOPE_STD + _SLOPE_PER_SHARE * glint_share
    for index in range(len(cameras)):
        slopes = slope_std * _tile(np.random.default_rng([seed, 31, index]))
        found.append(SunOnWaves(plane, light, slopes, _RIPPLES * slope_std, slopes[:0], 0.0, 0.0))
    if glint_share <= 0.0:
        return tuple(found)
    across, down = _PROBES
    probed = []
    for sun, camera in zip(found, cameras, strict=True):
        u, v = np.linspace(0.5, camera.width - 0.5, across), np.linspace(0.5, camera.height - 0.5, down)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        probed.append(sun._mirrored(camera.centres(pixels) + np.zeros((len(pixels), 3)), camera.directions(pixels)))
    seen = np.concatenate(probed)
    bright = float(np.quantile(seen, 1.0 - glint_share))
    if bright * _BRIGHTEST < 1.0:
        raise SurveyError(
            f"glint_share is {glint_share:g}, but the waves do not mirror the sun into so many pixels of this flight; "
            "give a smaller share, or more tilted views"
        )
    return tuple(replace(sun, glint=1.0 / bright) for sun in found)


def _tile(rng: np.random.Generator) -> np.ndarray:
    """Slopes (2, cells, cells), of unit variance, of a random surface that repeats; waves run mostly one way."""
    number = 2.0 * np.pi * np.fft.fftfreq(_CELLS, _CELL_M)
    kx, ky = np.meshgrid(number, number)
    k = np.hypot(kx, ky)
    inside = (k > 2.0 * np.pi / _WAVES_M[1]) & (k < 2.0 * np.pi / _WAVES_M[0])
    toward = rng.uniform(0.0, 2.0 * np.pi)
    along = np.cos(np.arctan2(ky, kx) - toward)
    # The variance of slopes in an octave, k^2 h^2 k dk, is the same for all.
    height = np.where(inside, (0.2 + along**2) / np.where(inside, k, 1.0) ** 2, 0.0)
    waves = height * np.fft.fft2(rng.standard_normal((_CELLS, _CELLS)))
    slopes = np.stack([np.fft.ifft2(1j * each * waves).real for each in (kx, ky)])
    return slopes / np.sqrt(np.mean(slopes**2))


def _caustics(slopes: np.ndarray, n: float, deepest_m: float, depth_m: float, contrast: float) -> np.ndarray:
    """Caustics (layers, cells, cells): light over its mean, at depths from 0 to the deepest."""
    depths = np.append(np.linspace(0.0, deepest_m, _LAYERS), depth_m)
    at = (np.arange(_CELLS * _RAYS) + 0.5) / _RAYS - 0.5
    rows, columns = np.meshgrid(at, at, indexing="ij")
    sx, sy = (map_coordinates(each, [rows, columns], order=1, mode="grid-wrap") for each in slopes)
    found = []
    for depth in depths:
        shift = (1.0 - 1.0 / n) * depth / _CELL_M
        landed = [np.round(place - shift * slope).astype(int) % _CELLS for place, slope in ((rows, sy), (columns, sx))]
        count = np.bincount((landed[0] * _CELLS + landed[1]).ravel(), minlength=_CELLS**2).reshape(_CELLS, _CELLS)
        disc = max(0.5 * 0.0093 / n * depth / _CELL_M, 0.5)
        found.append(gaussian_filter(count / _RAYS**2, disc, mode="wrap"))
    caustics = np.array(found)
    scale = contrast / caustics[-1].std()
    return np.maximum(1.0 + scale * (caustics[:-1] - 1.0), _LEAST_LIGHT).astype(np.float32)


def _on_tile(tile: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values (N,) of a tile at places (N, 2) [m], local."""
    return map_coordinates(tile, places.T[::-1] / _CELL_M, order=1, mode="grid-wrap")
