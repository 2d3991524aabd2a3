"""Photographs with their cameras in the local frame: spatial intersection, and rotations and models of other programs.

Intersection determines a point from its marks in several photographs, by least squares of pixels. Residuals are those
of the collinearity equations; under water rays are bent, see `PinholeCamera.project`. COLMAP models are written as
text, and also in binary where names have spaces, since readers of the text split names there.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.files import write_whole
from refract import FlatWater, PinholeCamera
from refract.lens import MODELS, Lens
from survey.photos.poses import TiePoints

# Camera axes of photogrammetry (x right, y up, z back) to ours (x right, y down, z forward).
CAM_FROM_OPK_CAM = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class View:
    """Photograph with its camera.

    Attributes
    ----------
    name : str
        Path of the image below the image folder, with forward slashes.
    path : Path
    camera : PinholeCamera
        Of the photograph as it was taken, lens distortion included; local frame, at full size.
    lens : Lens
        Interior orientation, as the poses file or survey.toml gives it.
    mask_path : Path or None
        Image of the stored size; black is left out.
    """

    name: str
    path: Path
    camera: PinholeCamera
    lens: Lens
    mask_path: Path | None = None


def metres_per_px(views: Sequence[View], water: FlatWater | None) -> float | None:
    """Ground sampling distance [m/px] on the water under the cameras, median; None for a dry survey."""
    if water is None:
        return None
    return float(np.median([-float(water.depth(view.camera.centre)) / view.lens.focal[1] for view in views]))


def grid_from_opk(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Rotation (3, 3) from photogrammetry's camera axes (x right, y up, z back) to the grid axes.

    ``Rx(omega) Ry(phi) Rz(kappa)``, angles in radians.
    """
    co, so, cp, sp, ck, sk = (f(a) for a in (omega, phi, kappa) for f in (math.cos, math.sin))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return about_x @ about_y @ about_z


def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rotation (3, 3) of a quaternion of any length but zero (Hamilton's convention, as COLMAP has it)."""
    return Rotation.from_quat((x, y, z, w)).as_matrix()


def enu_from_yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Rotation (3, 3) from cam to true east, north and up, angles in radians.

    At 0, 0, 0 the camera looks straight down with the top of its image to the north. Yaw turns it clockwise, seen from
    above; pitch lifts the view forward, to the horizon at 90 degrees; roll lowers the right side.
    """
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    about_down = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_right = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_forward = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    # Aircraft axes: forward, right, down, in north, east, down.
    east_north_up = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    aircraft_from_cam = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return east_north_up @ about_down @ about_right @ about_forward @ aircraft_from_cam


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a rotation with rounding errors (by singular values)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


# Rays that intersect at a smaller angle [rad] than this do not determine a distance.
_LEAST_ANGLE = 0.02
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Intersection:
    """The place of a point by its marks."""

    place: np.ndarray  # (3,) [m], local
    covariance: np.ndarray  # (3, 3) [m^2]: Propagated from the standard deviations of the marks
    residuals: np.ndarray  # (N, 2) [px]: marks minus projections of the place


def intersect(
    cameras: Sequence[PinholeCamera], pixels: np.ndarray, stds_px: np.ndarray, water: FlatWater | None
) -> Intersection | None:
    """Intersection of the rays of marks; None where they do not meet, or are nearly parallel.

    Parameters
    ----------
    cameras : N of PinholeCamera
    pixels : (N, 2) [px]
    stds_px : (N,) [px]
        Of the marks.
    water : FlatWater or None
        None: all rays are straight.
    """
    if len(cameras) < 2:
        return None
    rays = np.array([camera.directions(pixel) for camera, pixel in zip(cameras, pixels, strict=True)])
    centres = np.array([camera.centre for camera in cameras])
    cosines = np.clip(rays @ rays.T, -1.0, 1.0)
    if not np.isfinite(rays).all() or np.arccos(cosines.min()) < _LEAST_ANGLE:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    place = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    std = np.repeat(np.asarray(stds_px, dtype=np.float64), 2)
    for _ in range(_ROUNDS):
        residual, jacobian = _residuals(cameras, pixels, place, water)
        if not np.isfinite(residual).all() or not np.isfinite(jacobian).all():
            return None
        step = np.linalg.lstsq(jacobian / std[:, None], -residual / std, rcond=None)[0]
        place = place + step
        if np.abs(step).max() < 1e-6:
            break
    residual, jacobian = _residuals(cameras, pixels, place, water)
    if not np.isfinite(residual).all() or not np.isfinite(jacobian).all():
        return None
    covariance = np.linalg.inv((jacobian / std[:, None]).T @ (jacobian / std[:, None]))
    return Intersection(place, covariance, -residual.reshape(-1, 2))


def projection_and_jacobian(
    camera: PinholeCamera, place: np.ndarray, water: FlatWater | None
) -> tuple[np.ndarray, np.ndarray]:
    """The pixel (2,) at which a place (3,) appears, and its derivative (2, 3) [px/m]; NaN behind the camera."""
    step = 1e-6 * np.linalg.norm(camera.centre - place)
    moved = camera.project(place + step * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]), water)
    return moved[0], (moved[1:4] - moved[4:]).T / (2.0 * step)


def _residuals(
    cameras: Sequence[PinholeCamera], pixels: np.ndarray, place: np.ndarray, water: FlatWater | None
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of a place at its marks (2 N,) [px], and their derivatives (2 N, 3)."""
    seen = [projection_and_jacobian(camera, place, water) for camera in cameras]
    residual = np.concatenate([at - pixel for (at, _), pixel in zip(seen, pixels, strict=True)])
    return residual, np.concatenate([jacobian for _, jacobian in seen])


_GREY = "128 128 128"
FILES = ("cameras.txt", "images.txt", "points3D.txt")


def _binary(name: str) -> str:
    return name.replace(".txt", ".bin")


def has_spaces(views: Sequence[View]) -> bool:
    """Whether a photograph has a space in its name, at which other readers of the text cut it."""
    return any(len(view.name.split()) != 1 for view in views)


def write_model(folder: Path, views: Sequence[View], *, head: str, points: str, ties: TiePoints | None = None) -> None:
    """Write a model in the local frame into a folder that exists: text, and binary too where a name has a space.

    COLMAP prefers binary files to text, so that those of an earlier model are removed. BROWN_AFFINE, which is none of
    its camera models, is written as text alone.

    Parameters
    ----------
    head : str
        Comment lines at the beginning of cameras.txt.
    points : str
        points3D.txt, or only its comment lines where there are ties.
    ties : TiePoints, optional
        Points for points3D.txt, in the places that straight rays give them, with their tracks.
    """
    texts = _texts(views, head, points, ties)
    files = {name: text.encode() for name, text in texts.items()}
    if has_spaces(views) and all(MODELS[view.lens.model][0] is not None for view in views):
        for name, packed in zip(FILES, (_cameras_bin, _images_bin, _points_bin), strict=True):
            files[_binary(name)] = packed(texts[name].split("\n")[:-1])
    for name, content in files.items():
        with write_whole(folder / name) as stream:
            stream.write(content)
    for name in map(_binary, FILES):
        if name not in files:
            (folder / name).unlink(missing_ok=True)


def _texts(views: Sequence[View], head: str, points: str, ties: TiePoints | None) -> dict[str, str]:
    lenses = tuple(dict.fromkeys(view.lens for view in views))
    cameras = head + "".join(_lens_line(number, lens) for number, lens in enumerate(lenses, start=1))
    seen = [""] * len(views)
    if ties is not None:
        points, seen = points + _point_lines(views, ties), _observation_lines(len(views), ties)
    return dict(zip(FILES, (cameras, "".join(_pose_lines(views, lenses, seen)), points), strict=True))


def _lens_line(number: int, lens: Lens) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {' '.join(repr(float(p)) for p in lens.params)}\n"


def _pose_lines(views: Sequence[View], lenses: tuple[Lens, ...], seen: Sequence[str]) -> list[str]:
    """Two lines for each photograph; the second has its points."""
    lines = []
    for number, view in enumerate(views, start=1):
        x, y, z, w = Rotation.from_matrix(view.camera.cam_from_local).as_quat()
        shift = -view.camera.cam_from_local @ view.camera.centre
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        lines.append(f"{number} {numbers} {lenses.index(view.lens) + 1} {view.name}\n{seen[number - 1]}\n")
    return lines


def _observation_lines(num_views: int, ties: TiePoints) -> list[str]:
    """Lines of each photograph: x, y and the number of the point of all observations in it, in their order."""
    return [
        " ".join(
            f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in zip(ties.pixel[mine], ties.point[mine], strict=True)
        )
        for mine in (np.flatnonzero(ties.view == number) for number in range(num_views))
    ]


def _point_lines(views: Sequence[View], ties: TiePoints) -> str:
    """Number, place, a colour that is not known, error [px] and track of each point."""
    residual, place = np.empty(len(ties.view)), np.empty(len(ties.view), dtype=np.int64)
    for number, view in enumerate(views):
        mine = np.flatnonzero(ties.view == number)
        away = view.camera.project(ties.start[ties.point[mine]], None) - ties.pixel[mine]
        residual[mine], place[mine] = np.linalg.norm(away, axis=1), np.arange(len(mine))
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    lines = []
    for number, (x, y, z) in enumerate(ties.start):
        rows = slice(first[number], first[number + 1])
        track = " ".join(f"{view + 1} {at}" for view, at in zip(ties.view[rows], place[rows], strict=True))
        lines.append(f"{number + 1} {x:.4f} {y:.4f} {z:.4f} {_GREY} {residual[rows].mean():.3f} {track}\n")
    return "".join(lines)


def _cameras_bin(lines: Sequence[str]) -> bytes:
    rows = [line.split() for line in lines if not line.startswith("#")]
    packed = [struct.pack("<Q", len(rows))]
    for number, model, width, height, *params in rows:
        packed.append(struct.pack("<IiQQ", int(number), MODELS[model][0], int(width), int(height)))
        packed.append(struct.pack(f"<{len(params)}d", *map(float, params)))
    return b"".join(packed)


def _images_bin(lines: Sequence[str]) -> bytes:
    packed = [struct.pack("<Q", len(lines) // 2)]
    for line, points in zip(lines[::2], lines[1::2], strict=True):
        number, *pose, camera, name = line.split(" ", 9)
        seen = points.split()
        packed.append(struct.pack("<I7dI", int(number), *map(float, pose), int(camera)) + name.encode() + b"\0")
        packed.append(struct.pack("<Q", len(seen) // 3))
        for x, y, point in zip(seen[::3], seen[1::3], seen[2::3], strict=True):
            packed.append(struct.pack("<ddQ", float(x), float(y), int(point)))
    return b"".join(packed)


def _points_bin(lines: Sequence[str]) -> bytes:
    rows = [line.split() for line in lines if not line.startswith("#")]
    packed = [struct.pack("<Q", len(rows))]
    for number, x, y, z, r, g, b, error, *track in rows:
        place, colour = map(float, (x, y, z)), map(int, (r, g, b))
        packed.append(struct.pack("<Q3d3BdQ", int(number), *place, *colour, float(error), len(track) // 2))
        packed.append(struct.pack(f"<{len(track)}I", *map(int, track)))
    return b"".join(packed)
