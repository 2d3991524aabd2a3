"""Completeness: how much of a reference a cloud reaches; statistical outliers of a cloud."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from evaluation.c2m import area_vectors, distinct

NUM_SAMPLES = 1_000_000
SEED = 20_060_617  # any number, but always the same: two comparisons of one cloud give one result
# Relative margin of the search, so that its rounding drops nothing that the strict test below would keep.
_MARGIN = 1e-9


def sample_mesh(
    vertices: np.ndarray, faces: np.ndarray, num_samples: int = NUM_SAMPLES, *, seed: int = SEED
) -> np.ndarray:
    """Points (num_samples, 3) [m] spread independently and uniformly by area over a mesh, in the order of its faces.

    Vertices (V, 3) [m] are in a Cartesian frame: in a map grid areas would be distorted.
    """
    areas = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    cumulative = np.cumsum(areas)
    if not len(areas) or not cumulative[-1] > 0.0:
        raise ValueError(f"the {len(areas)} triangles have no area to sample, expected a surface")
    rng = np.random.default_rng(seed)
    at = np.sort(rng.random(num_samples)) * cumulative[-1]
    face = np.searchsorted(cumulative, at, side="right").clip(max=np.flatnonzero(areas)[-1])
    # Uniform in a triangle: the square root makes the density along the first coordinate that of its width.
    root, along = np.sqrt(rng.random(num_samples)), rng.random(num_samples)
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    return np.einsum("nk,nkd->nd", weights, vertices[faces[face]])


def distance_to_cloud(
    points: np.ndarray, cloud: np.ndarray, *, within_m: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) [m] from points (N, 3) to the nearest point of a cloud (M, 3), and its number (N,).

    Beyond ``within_m`` the search is not finished: there, and where the cloud is empty, the distance is
    infinite and the number -1. NaN and -1 for points that are not finite.
    """
    distances = np.where(np.isfinite(points).all(axis=1), np.inf, np.nan)
    numbers = np.full(len(points), -1, dtype=np.int64)
    # Many equal points would form a leaf that cannot be split and slows every query near it.
    first, _ = distinct(cloud)
    first = first[np.isfinite(cloud[first]).all(axis=1)]
    rows = np.flatnonzero(distances == np.inf)
    if not len(first) or not len(rows):
        return distances, numbers
    tree = cKDTree(cloud[first], balanced_tree=False, compact_nodes=False)
    found, at = tree.query(points[rows], distance_upper_bound=within_m * (1.0 + _MARGIN), workers=-1)
    is_found = at < len(first)
    distances[rows[is_found]] = found[is_found]
    numbers[rows[is_found]] = first[at[is_found]]
    return distances, numbers


def is_reached(samples: np.ndarray, cloud: np.ndarray, *, tolerance_m: float) -> np.ndarray:
    """Whether each sample (N,) of a reference is strictly closer to the cloud than the tolerance.

    The mean is the completeness of S. Seitz et al., A comparison and evaluation of multi-view stereo
    reconstruction algorithms, CVPR 2006.
    """
    distances, _ = distance_to_cloud(samples, cloud, within_m=tolerance_m)
    return distances < tolerance_m


def f_score(accuracy_share: float, completeness: float) -> float:
    """Harmonic mean of the share of the cloud near the reference and that of the reference near the cloud."""
    total = accuracy_share + completeness
    return 2.0 * accuracy_share * completeness / total if total > 0.0 else 0.0


def is_outlier(points: np.ndarray, *, neighbours: int, num_std: float) -> np.ndarray:
    """Statistical outliers (N,) of points (N, 3) [m]: far above the average from so many nearest neighbours.

    A point is one where its mean distance to them exceeds the mean of all by more than ``num_std`` of their standard
    deviations (of a population), as the filter "SOR" of CloudCompare has it (R. B. Rusu et al., Towards 3D point cloud
    based object maps for household environments, Robotics and Autonomous Systems 56, 2008, section 4.1).
    """
    if len(points) < 2:
        return np.zeros(len(points), dtype=bool)
    count = min(neighbours, len(points) - 1)
    # The nearest of all is the point itself.
    distances, _ = cKDTree(points, balanced_tree=False, compact_nodes=False).query(points, k=count + 1, workers=-1)
    mean = distances[:, 1:].mean(axis=1)
    return mean > mean.mean() + num_std * mean.std()
