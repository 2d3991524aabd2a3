"""Where the bed was found and where not, and the volume of the water over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CoverageFigures:
    """Water of a survey, in cells of ten ground sampling distances."""

    wet_m2: float  # [m^2]: water with a bed found under it
    # water_m3, water_std_m3 [m^3]: volume between bed and surface there, and its standard deviation by what all heights
    # share (None: unknown)
    water_m3: float
    water_std_m3: float | None
    # two_views_m2, one_view_m2 [m^2]: water without a bed that two photographs or more look at, and that one alone does
    two_views_m2: float
    one_view_m2: float


def coverage_of(
    depth: np.ndarray, has_point: np.ndarray, num_views: np.ndarray, cell_m: float, shared_std_m: float | None
) -> CoverageFigures:
    """The figures of cells (rows, columns) of the ground.

    Parameters
    ----------
    depth : [m]
        Below the water; where no point is, of the nearest cell with one. Negative or NaN: dry.
    has_point : bool
    num_views : int
        Photographs in whose frame a cell lies.
    cell_m : [m]
        Side of a cell.
    shared_std_m : [m] or None
        Of all heights together.
    """
    wet, cell_m2 = depth > 0.0, cell_m**2
    found, missing = wet & has_point, wet & ~has_point
    wet_m2 = cell_m2 * float(found.sum())
    return CoverageFigures(
        wet_m2=wet_m2,
        water_m3=cell_m2 * float(depth[found].sum()),
        water_std_m3=None if shared_std_m is None else wet_m2 * shared_std_m,
        two_views_m2=cell_m2 * float((missing & (num_views >= 2)).sum()),
        one_view_m2=cell_m2 * float((missing & (num_views == 1)).sum()),
    )
