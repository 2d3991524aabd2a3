"""Bias and spread of the parts of a cloud: wet and dry, by depth, by incidence, by number of views."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from evaluation.bootstrap import Blocks
from evaluation.summary import distance_statistics

DEPTH_EDGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, math.inf)
INCIDENCE_EDGES_DEG = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 60.0, 90.0)
VIEWS_EDGES = (1, 2, 3, 4, 6, 8, 12, 16, 24, math.inf)
SHORELINE_MARGIN_M = 0.05


def by_depth(distances: np.ndarray, depth_m: np.ndarray, blocks: Blocks | None = None) -> dict:
    """Statistics of the wet and the dry part, and of bands of depth.

    Parameters
    ----------
    distances : (N,) [m]
    depth_m : (N,) [m]
        Of the bed, positive below the water; points with NaN are in no part.
    blocks : Blocks of the N points, optional
        As `distance_statistics`.

    Returns
    -------
    dict
        ``wet`` and ``dry``: `distance_statistics` of the points more than 5 cm below and above the water,
        where the split is beyond doubt (left out if there is none). ``depth_bands``: a list of those of the
        wet points between ``from_m`` (included) and ``to_m``, empty bands left out; ``to_m`` of the last is
        None.
    """
    parts = {"wet": depth_m > SHORELINE_MARGIN_M, "dry": depth_m < -SHORELINE_MARGIN_M}
    split = {name: _statistics(distances, part, blocks) for name, part in parts.items() if part.any()}
    return {**split, "depth_bands": by_band(distances, depth_m, DEPTH_EDGES_M, "m", blocks)}


def by_band(
    distances: np.ndarray, values: np.ndarray, edges: tuple[float, ...], unit: str, blocks: Blocks | None = None
) -> list[dict]:
    """Statistics of distances in bands of another value.

    Parameters
    ----------
    distances : (N,) [m]
    values : (N,)
        Points with NaN are in no band.
    edges : ascending
    unit : str
        Last part of the names of the limits, e.g. ``from_deg``.
    blocks : Blocks of the N points, optional
        As `distance_statistics`.

    Returns
    -------
    list of dict
        ``from_<unit>`` (included), ``to_<unit>`` (None where it is infinite) and `distance_statistics`; bands
        without a point are left out.
    """
    bands = []
    for low, high in pairwise(edges):
        part = (values >= low) & (values < high)
        if part.any():
            limits = {f"from_{unit}": low, f"to_{unit}": None if math.isinf(high) else high}
            bands.append(limits | _statistics(distances, part, blocks))
    return bands


def _statistics(distances: np.ndarray, part: np.ndarray, blocks: Blocks | None) -> dict:
    return distance_statistics(distances[part], None if blocks is None else blocks.among(part))
