"""Points of pixels carried into other photographs, on the device of the sweep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fields.device import Device
from fields.sweep.kernels.arrays import constant, floats, host
from fields.sweep.kernels.rays import point_at, project, refracted_rays
from fields.sweep.kernels.stack import CameraTerms, PlaneFrame, camera_table
from refract import FlatWater, PinholeCamera

# Of the search for the crossing; docs/optics.md.
_STEPS = 2


class Projection:
    """Cameras and water, ready for the kernels that find where a photograph shows a point.

    Dr.Jit is not meant for several threads: only one may use it, the one that made it.

    Parameters
    ----------
    device : Device
    cameras : by number
    water : FlatWater or None
    """

    def __init__(self, device: Device, cameras: Mapping[int, PinholeCamera], water: FlatWater | None):
        self.device, self._cameras = device, cameras
        self._frame, self._n_water = PlaneFrame.of(water), None if water is None else water.n_water
        self._beyond = CameraTerms.of(list(cameras.values()))
        table = camera_table(list(cameras.values()), self._beyond, self._frame)
        self._rows = {view: [constant(device, c) for c in row] for view, row in zip(cameras, table, strict=True)}

    def points(self, view: int, pixels: np.ndarray, heights: np.ndarray) -> tuple[Any, ...]:
        """The points of pixels (P, 2) [px] of a photograph at heights (P,) [m], for `seen`."""
        beyond = CameraTerms.of([self._cameras[view]])
        camera = [constant(self.device, c) for c in camera_table([self._cameras[view]], beyond, self._frame)[0]]
        u, v, z = (floats(self.device, each) for each in (pixels[:, 0], pixels[:, 1], heights))
        points = point_at(refracted_rays(camera, u, v, self._n_water or 1.0, beyond), z)
        _compute(self.device, *points)
        return points

    def seen(self, view: int, points: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Where a photograph shows points, (2, P) float32 [px], and whether inside it, (P,) bool."""
        u, v, inside = project(self._rows[view], points, self._n_water, self._beyond, _STEPS)
        _compute(self.device, u, v, inside)
        return np.stack([host(self.device, u), host(self.device, v)]), host(self.device, inside)


def _compute(device: Device, *arrays) -> None:
    """Let Dr.Jit compute what it has only noted down so far."""
    if device.module is not None:
        import drjit

        drjit.eval(*arrays)
