"""The colours of the bed with the effect of the water removed."""

from __future__ import annotations

import numpy as np
import torch

from fields.gamma import GAMMA
from fields.sweep.bed import BedPoints
from fields.water_column import WaterColumn
from refract import FlatWater, fresnel_coefficients


def true_colours(
    bed: BedPoints, water: FlatWater, column: WaterColumn, tide: np.ndarray | float = 0.0
) -> tuple[np.ndarray, float]:
    """Colours (N, 3) uint8 of points as photographs would store them without water, and the share too bright for that.

    Dry points keep theirs. Fully absorbed channels are black. ``tide`` (N,) [m] is that of the photographs which the
    colours come from.
    """
    depth = np.where(bed.wet, np.maximum(bed.depth + tide, 0.0), 0.0)
    dry = without_water(bed.rgb, depth, bed.incidence, water.n_water, column)
    stored = np.round(stored_colours(dry)).astype(np.uint8)
    too_bright = bed.wet & (dry > 1.0).any(axis=1)
    return np.where(bed.wet[:, None], stored, bed.rgb), float(too_bright.mean())


def without_water(
    rgb: np.ndarray, depth: np.ndarray, incidence: np.ndarray, n_water: float, column: WaterColumn
) -> np.ndarray:
    """Linear radiance (N, 3) of the bed, 1 for white, from what photographs stored of it.

    Parameters
    ----------
    rgb : (N, 3)
        0 to 255.
    depth : (N,) [m]
    incidence : (N,) [rad]
        In air.
    n_water : [-]
    column : WaterColumn
    """
    cos_wet = np.sqrt(1.0 - (np.sin(incidence) / n_water) ** 2)
    mirrored = fresnel_coefficients(np.cos(incidence), n_from=1.0, n_to=n_water).reflectance
    seen = torch.as_tensor((rgb / 255.0) ** GAMMA)
    with torch.no_grad():
        way = column.way(torch.as_tensor(depth), torch.as_tensor(depth) / torch.as_tensor(cos_wet))
        return column.bed_of(seen, way, torch.as_tensor(mirrored)).numpy()


def stored_colours(radiance: np.ndarray) -> np.ndarray:
    """Stored levels, 0 to 255 with fractions, of linear radiance; brighter than white is white."""
    return 255.0 * np.clip(radiance, 0.0, 1.0) ** (1.0 / GAMMA)
