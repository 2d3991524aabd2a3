"""Rotations as other programs give them: omega, phi, kappa; quaternions; yaw, pitch and roll."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

# Camera axes of photogrammetry (x right, y up, z back) to ours (x right, y down, z forward).
CAM_FROM_OPK_CAM = np.diag([1.0, -1.0, -1.0])


def grid_from_opk(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Rotation (3, 3) from photogrammetry's camera axes (x right, y up, z back) to the grid axes.

    ``Rx(omega) Ry(phi) Rz(kappa)``, angles in radians.
    """
    return Rotation.from_euler("XYZ", (omega, phi, kappa)).as_matrix()


def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rotation (3, 3) of a quaternion of any length but zero (Hamilton's convention, as COLMAP has it)."""
    return Rotation.from_quat((x, y, z, w)).as_matrix()


def enu_from_yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Rotation (3, 3) from cam to true east, north and up, angles in radians.

    At 0, 0, 0 the camera looks straight down with the top of its image to the north. Yaw turns it clockwise, seen from
    above; pitch lifts the view forward, to the horizon at 90 degrees; roll lowers the right side.
    """
    # Aircraft axes: forward, right, down, in north, east, down.
    east_north_up = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    aircraft_from_cam = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return east_north_up @ Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_matrix() @ aircraft_from_cam


def is_rotation(matrix: np.ndarray, tolerance: float) -> bool:
    """Whether a matrix (3, 3) is a rotation but for rounding; one of numbers that overflow is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= tolerance and np.linalg.det(matrix) > 0.0)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a rotation with rounding errors (by singular values)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
