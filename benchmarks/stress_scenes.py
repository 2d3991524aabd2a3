"""What the stress campaign draws: a small survey, and harder ones of the same kind."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter

from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater
from survey.simulate.drawn import DrawnScene
from survey.simulate.ground.ground import Ground, Material, shade_of_map
from survey.simulate.ground.shapes import BedGrid
from survey.simulate.ground.textures import TILE, ImageTexture, light_of_bed, periodic, sand
from survey.simulate.light import Light
from survey.simulate.output.sidecars import StagedScene

# Photographs of a quarter of the usual pixels: a run takes some ten seconds.
BASE = DrawnScene(
    size_m=(5.5, 5.0), depth_m=2.0, num_views=16, image_px=(320, 240), focal_px=560.0, flying_m=14.0, noise=1.0, seed=7
)
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_GRAVITY = 9.81
# Lengths of the waves [m], and the time between two photographs [s].
_WAVES_M, _BETWEEN_S = (0.9, 1.6, 2.7, 4.5), 2.3
# Spacings of the noise of a repeated tile, in its 512 texels, and its standard deviation.
_SPACINGS, _SPECKLE = (32, 64, 128), 0.2
# Of a bed on which nothing lies [m].
_SMOOTH_M = 0.2

Staging = Callable[[StagedScene, float], StagedScene]


def deep(scene: DrawnScene, depth: float) -> DrawnScene:
    """Where the flying height is too low for a depth, everything grows with it."""
    return replace(_grown(scene, max(1.0, 2.5 * depth / scene.flying_m)), depth_m=depth)


def _grown(scene: DrawnScene, factor: float) -> DrawnScene:
    width, height = scene.size_m
    return replace(
        scene,
        size_m=(factor * width, factor * height),
        flying_m=factor * scene.flying_m,
        cell_m=factor * scene.cell_m,
        texel_m=factor * scene.texel_m,
    )


def far_away(scene: DrawnScene, northing: float) -> DrawnScene:
    """The same survey, far from the equator."""
    return replace(scene, crs="EPSG:32733+3855", origin=(500_000.0, northing))


def many(scene: DrawnScene, number: float) -> DrawnScene:
    """A quarter of the pixels in each of many photographs, at the same number of them to the square metre."""
    grown = math.sqrt(number / scene.num_views)
    width, height = scene.image_px
    return replace(
        scene,
        num_views=int(number),
        image_px=(width // 2, height // 2),
        focal_px=0.5 * scene.focal_px,
        size_m=(grown * scene.size_m[0], grown * scene.size_m[1]),
        cell_m=2.0 * scene.cell_m,
        texel_m=2.0 * scene.texel_m,
    )


@dataclass(frozen=True)
class SidewaysScene(DrawnScene):
    """All cameras look in from around, so that no ray is steeper in the middle of an image.

    Attributes
    ----------
    incidence_deg : [deg]
        Greatest, at the middle of the upper edge of an image.
    """

    incidence_deg: float = 40.0

    def cameras(self) -> list[PinholeCamera]:
        """A ring of views about the middle."""
        rng = np.random.default_rng([self.seed, 1])
        tilt = math.radians(self.incidence_deg) - math.atan(0.5 * self.image_px[1] / self.focal_px)
        return [self._look_in(tilt, _GOLDEN_ANGLE * number, rng) for number in range(self.num_views)]


def sideways(scene: DrawnScene, incidence_deg: float) -> DrawnScene:
    """The ground that is seen far away needs no finer grid than its pixels."""
    coarse = 1.0 if incidence_deg < 55.0 else 2.0
    fields = {name: getattr(scene, name) for name in scene.__dataclass_fields__}
    fields |= {"cell_m": coarse * scene.cell_m, "texel_m": coarse * scene.texel_m, "nadir_share": 0.0}
    return SidewaysScene(**fields, incidence_deg=incidence_deg)


@dataclass(frozen=True)
class WavyScene(StagedScene):
    """A scene whose waves move from photograph to photograph; its truth is that of still water.

    Attributes
    ----------
    waves : WavyWater
        At the time zero.
    """

    waves: WavyWater | None = None

    @cached_property
    def _times(self) -> np.ndarray:
        return np.cumsum(np.random.default_rng([self.seed, 31]).uniform(0.8, 1.2, len(self.cameras))) * _BETWEEN_S

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera through the waves of its moment."""
        assert self.waves is not None
        moved = replace(self.renderer, water=self.waves.at(float(self._times[index])))
        return self.sensor.photograph(moved.radiance_of_rays, self.cameras[index], self.lens, (self.seed, index))


def with_waves(scene: StagedScene, amplitude_m: float) -> StagedScene:
    """Four trains of equal steepness that run roughly one way, as fast as on deep water.

    `amplitude_m` is the root of the sum of their squared amplitudes.
    """
    plane = scene.water
    assert isinstance(plane, FlatWater)
    rng, lengths = np.random.default_rng([scene.seed, 30]), np.array(_WAVES_M)
    toward = rng.uniform(0.0, 2.0 * math.pi) + rng.normal(0.0, 0.5, len(lengths))
    number = 2.0 * math.pi / lengths
    waves = WavyWater(
        plane.point,
        (amplitude_m * lengths / np.linalg.norm(lengths)).tolist(),
        np.stack([number * np.sin(toward), number * np.cos(toward)], axis=-1).tolist(),
        rng.uniform(0.0, 2.0 * math.pi, len(lengths)).tolist(),
        frequencies=np.sqrt(_GRAVITY * number).tolist(),
        n_water=plane.n_water,
    )
    return WavyScene(**{name: getattr(scene, name) for name in scene.__dataclass_fields__}, waves=waves)


def repeated(scene: StagedScene, period_m: float) -> StagedScene:
    """A smooth bed painted with a tile that is repeated, square by square."""
    rng, scale = np.random.default_rng([scene.seed, 32]), TILE / period_m
    bright = np.exp(sum(_SPECKLE * periodic(rng, spacing) for spacing in _SPACINGS))
    return _smooth(
        scene,
        ImageTexture(
            image=(0.5 * bright[..., None] * np.array([0.66, 0.57, 0.42])).astype(np.float32),
            texel_from_point=np.array([[[scale, 0.0, 0.0, 0.0], [0.0, scale, 0.0, 0.0]]]),
            map_of_face=np.zeros(1, dtype=np.int64),
            repeats=True,
        ),
    )


def bare_sand(scene: StagedScene, share: float) -> StagedScene:
    """A smooth bed of sand without stones or bodies, whose paint keeps a share of its contrast."""
    bed, texture = scene.renderer.ground.bed, scene.renderer.ground.materials[0].texture
    assert isinstance(bed, BedGrid)
    assert isinstance(texture, ImageTexture)
    texel_m = float(1.0 / texture.texel_from_point[0, 0, 0])
    paint = sand(texture.image.shape[:2], texel_m, np.random.default_rng([scene.seed, 33]))
    middle = paint.mean(axis=(0, 1))
    return _smooth(scene, replace(texture, image=(middle + share * (paint - middle)).astype(np.float32)))


def _smooth(scene: StagedScene, texture: ImageTexture) -> StagedScene:
    """The same scene with nothing on its bed, and nothing in it that is smaller than `_SMOOTH_M`."""
    bed = scene.renderer.ground.bed
    assert isinstance(bed, BedGrid)
    bed = BedGrid(gaussian_filter(bed.heights, _SMOOTH_M / bed.cell), bed.west, bed.south, bed.cell)
    material = Material(texture, shade_of_map(bed, light_of_bed(bed, (), Light())))
    return replace(scene, renderer=replace(scene.renderer, ground=Ground(bed, (), (material,))))
