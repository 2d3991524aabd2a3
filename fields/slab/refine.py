"""Heights of the field for the pixels that become points."""

from __future__ import annotations

import numpy as np

from fields.device import half_the_threads
from fields.slab.rays import slab_rays
from fields.slab.tensor_field import TensorField
from fields.sweep.maps import HeightMap
from refract import FlatWater, PinholeCamera

CHUNK = 65536


@half_the_threads()
def refine(
    field: TensorField,
    camera: PinholeCamera,
    height_map: HeightMap,
    image: np.ndarray,
    water: FlatWater | None,
    keep: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Heights of a map with those of the kept pixels taken from the field: the median of the weights along each ray.

    A pixel whose own height lies outside the slab (another surface passes there) or that the field would move out of
    it keeps the sweep's height.

    Returns
    -------
    height : (height, width) float32 [m] over the water plane
    moved : int
        Number of pixels that took the field's height.
    """
    height = height_map.height.copy()
    rows, columns = np.nonzero(keep)
    moved = 0
    for first in range(0, len(rows), CHUNK):
        r, c = rows[first : first + CHUNK], columns[first : first + CHUNK]
        rays, held = slab_rays(camera, height_map, image, water, field.slab, (r, c))
        if len(rays) == 0:
            continue
        heights, _ = field.heights(rays)
        found = heights.numpy()
        inside = np.abs(found - height[r[held], c[held]]) < field.slab.half
        height[r[held][inside], c[held][inside]] = found[inside]
        moved += int(inside.sum())
    return height, moved
