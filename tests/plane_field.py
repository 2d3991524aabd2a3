"""Fields over the analytic plane of `plane_survey`: photographs in colour, height maps that are right or displaced."""

import numpy as np
from plane_survey import PlaneBed, texture

from fields.image_store import GAMMA
from fields.sweep.maps import HeightMap, Sources
from fields.volume.layer import Layer
from fields.volume.sampling import Cells
from refract import FlatWater, PinholeCamera
from survey.run.trained_field import RestoredField, VolumeRecipe

ABSORPTION = np.array([0.3, 0.07, 0.05])  # 1/m


def plane_sources(
    bed: PlaneBed, cameras: list[PinholeCamera], *, shift: float = 0.0, noise: float = 0.0, seed: int = 0
) -> Sources:
    """Colour photographs of a bed through absorbing water, with maps of its true heights plus a shift and noise [m]."""
    rng = np.random.default_rng(seed)
    maps, images = [], []
    for view, camera in enumerate(cameras):
        path = camera.paths(camera.pixel_centres(), bed.water)
        height = bed.true_height(camera)
        points = path.at_height(height, bed.water)
        paint = np.stack([texture(points[..., 0], points[..., 1], seed=s) for s in (3, 4, 5)], axis=-1)
        light = np.clip(0.35 + 0.25 * paint / 128.0, 0.02, 1.0)
        if bed.water is not None:
            falls = -(path.water_direction @ np.array(bed.water.up))
            light = light * np.exp(-(np.clip(-height, 0.0, None) / falls)[..., None] * ABSORPTION)
        images.append(np.clip(np.round(255.0 * light ** (1.0 / GAMMA)), 0, 255).astype(np.uint8))
        ones = np.ones(height.shape, dtype=np.float32)
        found = (height + shift + noise * rng.standard_normal(height.shape)).astype(np.float32)
        maps.append(HeightMap(view, found, ones, np.full(height.shape, 3, dtype=np.uint8), 0.005 * ones))
    return Sources(cameras, maps, images, bed.water)


def level_layer(height: float, *, half: float = 0.1, slope_x: float = 0.0) -> Layer:
    """A layer about z = height + slope_x x [m]: 80 x 80 cells of 0.1 m about the origin."""
    x = 0.1 * (np.arange(80) - 39.5)
    raster = np.tile((height + slope_x * x).astype(np.float32), (80, 1))
    low, high = np.array([-4.0, -4.0, raster.min() - half]), np.array([4.0, 4.0, raster.max() + half])
    return Layer(low, high, raster, np.ones(raster.shape, dtype=bool), half)


def field_over(
    layer: Layer, water: FlatWater | None, *, model: str = "mdw", device: str = "torch", **settings
) -> RestoredField:
    """An untrained field in a layer."""
    recipe = VolumeRecipe(model, 1, steps=10, seed=0, samples=8, **settings)
    return RestoredField(recipe.renderer(layer, water, 1, device), Cells.everywhere(layer, 1), recipe, water, 10)
