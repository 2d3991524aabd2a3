"""Statistical outliers of a cloud; `bathynerf compare` keeps them unless an option removes them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def is_outlier(points: np.ndarray, *, neighbours: int, num_std: float) -> np.ndarray:
    """Statistical outliers (N,): points whose mean distance to their neighbours is far above the average.

    Parameters
    ----------
    points : (N, 3) [m]
    neighbours : int
        Number of nearest neighbours.
    num_std : float
        A point is an outlier where its mean distance exceeds the mean of all mean distances by more than this many
        of their standard deviations (of a population), as the filter "SOR" of CloudCompare has it.

    Notes
    -----
    R. B. Rusu et al., Towards 3D point cloud based object maps for household environments, Robotics and Autonomous
    Systems 56 (2008), section 4.1.
    """
    if len(points) < 2:
        return np.zeros(len(points), dtype=bool)
    count = min(neighbours, len(points) - 1)
    # The nearest of all is the point itself.
    distances, _ = cKDTree(points, balanced_tree=False, compact_nodes=False).query(points, k=count + 1, workers=-1)
    mean = distances[:, 1:].mean(axis=1)
    return mean > mean.mean() + num_std * mean.std()
