"""The colours of the bed with the effect of the water removed."""

from __future__ import annotations

import numpy as np
import torch

from fields.gamma import GAMMA
from fields.sweep.bed import BedPoints
from fields.water_column import WaterColumn
from refract import FlatWater, fresnel_coefficients


def true_colours(bed: BedPoints, water: FlatWater, column: WaterColumn) -> tuple[np.ndarray, float]:
    """Colours (N, 3) uint8 of points as photographs would store them without water, and the share too bright for that.

    Dry points keep theirs. Fully absorbed channels are black.
    """
    depth = torch.as_tensor(np.where(bed.wet, bed.depth, 0.0))
    cos_wet = np.sqrt(1.0 - (np.sin(bed.incidence) / water.n_water) ** 2)
    mirrored = fresnel_coefficients(np.cos(bed.incidence), n_from=1.0, n_to=water.n_water).reflectance
    seen = torch.as_tensor((bed.rgb / 255.0) ** GAMMA)
    with torch.no_grad():
        way = column.way(depth, depth / torch.as_tensor(cos_wet))
        dry = column.bed_of(seen, way, torch.as_tensor(mirrored)).numpy()
    stored = np.round(255.0 * np.clip(dry, 0.0, 1.0) ** (1.0 / GAMMA)).astype(np.uint8)
    too_bright = bed.wet & (dry > 1.0).any(axis=1)
    return np.where(bed.wet[:, None], stored, bed.rgb), float(too_bright.mean())
