"""Where a point under water appears to a camera: the way back up through the surface."""

from __future__ import annotations

from refract import kernels
from refract._array import common, components, stack
from refract.surfaces import FlatWater

# Newton reaches the last bits of float64 within 14 steps over index 1 to 1.6, camera heights 1e-3 to 1e4 m,
# depths to 1e3 m and incidence to 89.9 deg; drone geometry takes 4 (docs/optics.md).
EXACT_STEPS = 16


def crossing_point(points, camera, water: FlatWater | None, *, steps: int = EXACT_STEPS):
    """Point of the water surface through which the camera sees a point of the bed.

    Solves Fermat's condition (least optical path) by Newton steps on the share of the way that lies in air,
    to better than 1e-9 m in float64.

    Parameters
    ----------
    points : (..., 3) [m], local, numpy or torch
    camera : (3,) or (..., 3) [m], local
        Camera centre.
    water : FlatWater or None
    steps : int
        Newton steps; fewer are faster and, in float32 and drone geometry, as good (docs/optics.md).

    Returns
    -------
    (..., 3) [m], local
        The point itself where the ray to it is straight: above the water, without water, or with the camera
        on or below the surface. In each case the camera sees the point in the direction of the returned one.

    Raises
    ------
    ValueError
        If the last axis of `points` or `camera` is not 3, or their shapes do not broadcast.
    """
    points, camera = common(points=points, camera=camera)
    point, centre = components(points), components(camera)
    if water is None:
        return stack(*(p + c * 0.0 for p, c in zip(point, centre, strict=True)))
    crossing, _ = kernels.crossing_of_point(centre, point, water.point, water.up, water.n_water, steps)
    return stack(*crossing)
