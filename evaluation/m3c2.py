"""M3C2: distance between two clouds along their local normals, by py4dgeo (the extra ``m3c2``)."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class M3C2Distances:
    """M3C2 distances along the normals of the reference, positive where the cloud lies above it."""

    signed: np.ndarray  # (K,) [m]: at the core points; NaN where a cylinder holds no points of either cloud
    # (K,) [m]: level of detection at 95 %: smaller distances are not significant. NaN where there are too few points.
    detection_m: np.ndarray


def m3c2_distances(
    reference: np.ndarray, cloud: np.ndarray, core_points: np.ndarray, *, radius_m: float, reach_m: float
) -> M3C2Distances:
    """Multiscale model to model cloud comparison.

    Parameters
    ----------
    reference, cloud : (N, 3), (M, 3) [m]
        In one Cartesian frame near its origin, z up.
    core_points : (K, 3) [m]
        Where distances are computed, usually a subset of the reference.
    radius_m : float [m]
        Of the cylinders along the normals, and of the spheres in which normals are found.
    reach_m : float [m]
        Half the length of the cylinders.

    Notes
    -----
    D. Lague, N. Brodu, J. Leroux, Accurate 3D comparison of complex topography with terrestrial laser scanner, ISPRS
    Journal 82 (2013); normals point up.
    """
    import py4dgeo

    # py4dgeo logs to standard output, which belongs to the command line, and to a file in the working folder.
    logging.getLogger("py4dgeo").handlers = [logging.NullHandler()]
    epochs = tuple(py4dgeo.Epoch(np.ascontiguousarray(points, dtype=np.float64)) for points in (reference, cloud))
    algorithm = py4dgeo.M3C2(
        epochs=epochs,
        corepoints=np.ascontiguousarray(core_points, dtype=np.float64),
        cyl_radius=radius_m,
        normal_radii=[radius_m],
        max_distance=reach_m,
    )
    signed, uncertainty = algorithm.run()
    return M3C2Distances(np.asarray(signed), np.asarray(uncertainty["lodetection"]))
