"""Baselines without refraction: intersection of straight rays, and corrections of the resulting apparent depth.

Each view sees a point of the bed in the direction in which its light left the water. A reconstruction without
refraction extends these directions as straight lines; they meet in the apparent point.

Symbols: N points, V views; arrays over both are padded, ``is_seen`` marks valid entries.
"""

import numpy as np

# Reciprocal condition of the normal equations below which rays are parallel.
_PARALLEL = 1e-9


def apparent_points(centres: np.ndarray, directions: np.ndarray, is_seen: np.ndarray) -> np.ndarray:
    """Least-squares intersections (N, 3) [m] of straight rays; NaN of fewer than two views, or parallel rays.

    ``centres`` (N, V, 3) [m] are points on the rays, ``directions`` (N, V, 3) unit vectors in air.
    """
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    across = np.where(is_seen[..., None, None], across, 0.0)
    # Relative to one of the centres, so that a distance of 1e2 m costs no digits.
    first = np.take_along_axis(centres, np.argmax(is_seen, axis=1)[:, None, None], axis=1)
    offsets = np.where(is_seen[..., None], centres - first, 0.0)
    normal = across.sum(axis=1)
    right = np.einsum("nvij,nvj->ni", across, offsets)
    eigenvalues = np.linalg.eigvalsh(normal)
    sound = (is_seen.sum(axis=1) >= 2) & (eigenvalues[:, 0] > _PARALLEL * eigenvalues[:, 2])
    points = np.full((len(centres), 3), np.nan)
    points[sound] = np.linalg.solve(normal[sound], right[sound][..., None])[..., 0] + first[sound, 0]
    return points


def times_index(apparent_depth: np.ndarray, n_water: float) -> np.ndarray:
    """Depth (N,) [m] of points from their apparent depth [m] for small angles: apparent depth times index."""
    return n_water * apparent_depth


def per_camera(apparent_depth: np.ndarray, incidence: np.ndarray, is_seen: np.ndarray, n_water: float) -> np.ndarray:
    """Depth (N,) [m] of points, each corrected for refraction per camera and averaged.

    ``incidence`` (N, V) [rad] is the angle in air between the normal of the water and the line from the apparent point
    to the camera; ``apparent_depth`` (N,) [m] is positive below the water.

    Notes
    -----
    J. T. Dietrich, Bathymetric structure-from-motion: extracting shallow stream bathymetry from multi-view stereo
    photogrammetry, Earth Surface Processes and Landforms 42 (2017): each camera gives the depth
    ``h_a tan(r) / tan(i)`` with ``sin(r) = n sin(i)``, r the angle in air, and the mean of all is taken. The ratio is
    written here as ``sqrt(n^2 - sin(r)^2) / cos(r)``, which holds at nadir too.
    """
    factor = np.sqrt(n_water**2 - np.sin(incidence) ** 2) / np.cos(incidence)
    count = is_seen.sum(axis=1)
    total = np.where(is_seen, factor, 0.0).sum(axis=1)
    return apparent_depth * np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)
