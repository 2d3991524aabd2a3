"""Poses, rotations, tie points and names of photographs as files of other programs have them.

Names may differ from those of the photographs in case, slashes, folder and suffix.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path, PurePosixPath

import numpy as np
from pyproj import CRS
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from refract.lens import Lens
from survey.errors import ImageError, PosesError

# Two photographs may agree by chance on a false point; a third rarely does.
MIN_TRACK = 3
# Behind the name of a photograph, before its suffix, in the name of its mask.
MASK_ENDING = "_mask"
# Camera axes of photogrammetry (x right, y up, z back) to ours (x right, y down, z forward).
CAM_FROM_OPK_CAM = np.diag([1.0, -1.0, -1.0])


class DuplicatePose(PosesError):
    """A file has two poses under one name, ``name_in_file``."""

    def __init__(self, name_in_file: str, where: str):
        super().__init__(
            f"{where}: image {name_in_file} has a second pose; keep one of the two, or, if they are of two "
            "photographs, rename these, or write their folders before the name"
        )
        self.name_in_file = name_in_file


class PoseFrame(Enum):
    """Frame of the positions and rotations of a poses file.

    | frame | positions | rotations, from |
    |---|---|---|
    | GRID | in crs | the grid axes at the camera: easting, northing, height |
    | ENU | in crs | true east, true north and up at the camera |
    | GEOCENTRIC | x, y, z [m] from the centre of the Earth | the same axes |
    | LOCAL | [m] in the topocentric frame of [local] | its axes |
    """

    GRID = "grid"
    ENU = "enu"
    GEOCENTRIC = "geocentric"
    LOCAL = "local"


@dataclass(frozen=True, eq=False)
class GivenPosition:
    """Position of a camera before any adjustment, by GPS, as a file has it."""

    place: np.ndarray  # (3,) float64: easting or longitude, northing or latitude and height in the crs of its file
    std: np.ndarray  # (3,) float64 [m]: East, north, up


@dataclass(frozen=True, eq=False)
class Pose:
    name: str  # Of the image, as the file has it
    centre: np.ndarray  # (3,) float64: of the camera, in the frame of the file
    # (3, 3) float64: rotation into cam (x right, y down, z forward), from the axes of the frame of the file
    cam_from_world: np.ndarray
    lens: Lens | None = None  # None if the file has no lens
    given: GivenPosition | None = None  # None where the file does not say how well the position was known beforehand
    where: str = ""  # The file and line, for messages; empty: the file alone


@dataclass(frozen=True)
class PoseFile:
    poses: tuple[Pose, ...]  # Of different names
    frame: PoseFrame
    # Of GRID and ENU: that of the positions; of GEOCENTRIC: the one on whose datum they are. None: the crs of the
    # survey, or WGS 84 for GEOCENTRIC.
    crs: CRS | None = None
    # The program that adjusted the poses, which knows straight rays only; None where the format does not tell
    tool: str | None = None
    masks: Path | None = None  # Folder of the masks that the program used
    # notes, warnings sentences: what was assumed of the file, and what it has that is not used
    notes: tuple[str, ...] = field(default=(), compare=False)
    warnings: tuple[str, ...] = field(default=(), compare=False)
    # height_unit_m, plan_unit_m: Units of heights, and of eastings and northings [m], where the file tells them beside
    # ``crs``
    height_unit_m: float | None = None
    plan_unit_m: float | None = None
    is_camera_path: bool = False  # Of pictures to be made, in the frame in which the cameras of a run are exported


@dataclass(frozen=True, eq=False)
class FileTies:
    """Tie points of the program that made the poses."""

    points: np.ndarray  # (N, 3) float64: in the frame of the poses file
    num_views: np.ndarray  # (N,) int64: how many photographs see each
    names: tuple[str, ...] = ()  # Of photographs, as the file has them
    # point, image (M,) int64: which point is seen in which photograph, a number into `names`
    point: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    image: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    pixel: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))  # (M, 2) float64 [px], img


def least_track(num_views: int) -> int:
    """Observations that a point has at least in a block of so many photographs: of two, two."""
    return min(MIN_TRACK, num_views)


@dataclass(frozen=True)
class TiePoints:
    """Points of the ground measured in several photographs; observations are sorted by point."""

    start: np.ndarray  # (M, 3) float64 [m], local: where the points are about
    point: np.ndarray  # (N,) int64, ascending: which point an observation is of; every point has one at least
    view: np.ndarray  # (N,) int64
    pixel: np.ndarray  # (N, 2) float64 [px], img
    least: int = MIN_TRACK  # Observations that a point is to have; see `least_track`

    def __len__(self) -> int:
        return len(self.start)

    @classmethod
    def together(cls, parts: Sequence[TiePoints]) -> TiePoints:
        """The points of several parts, one after the other; views are numbered alike in all."""
        first = np.cumsum([0, *(len(part) for part in parts)])
        return cls(
            np.concatenate([part.start for part in parts]),
            np.concatenate([part.point + shift for shift, part in zip(first, parts, strict=False)]),
            np.concatenate([part.view for part in parts]),
            np.concatenate([part.pixel for part in parts]),
            min((part.least for part in parts), default=MIN_TRACK),
        )

    def only(self, keep: np.ndarray) -> TiePoints:
        """The points that have at least `least` observations left among those to keep, (N,) bool."""
        enough = np.bincount(self.point[keep], minlength=len(self)) >= self.least
        keep = keep & enough[self.point]
        number = np.cumsum(enough) - 1
        kept = (self.start[enough], number[self.point[keep]], self.view[keep], self.pixel[keep])
        return TiePoints(*kept, self.least)


def connected_parts(num_views: int, point: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Connected component (num_views,) int64 of each view, by shared points.

    Observations (N,) are of points and of views. Parts are numbered from the largest, that with most views, on; of
    equal ones the one with the first view comes first. A view that sees nothing is in part -1.
    """
    num_points = int(point.max()) + 1 if len(point) else 0
    nodes = num_views + num_points
    seen = coo_array((np.ones(len(view), dtype=bool), (view, num_views + point)), shape=(nodes, nodes))
    label = connected_components(seen, directed=False)[1][:num_views]
    is_seen = np.bincount(view, minlength=num_views) > 0
    of_seen, first, size = np.unique(label[is_seen], return_index=True, return_counts=True)
    part = np.full(num_views, -1, dtype=np.int64)
    for number, k in enumerate(np.lexsort([first, -size])):
        part[is_seen & (label == of_seen[k])] = number
    return part


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


class ImageNames:
    """The photographs of a survey, looked up by the names in a file: by the longest common tail of the paths."""

    def __init__(self, names: Iterable[str]):
        self._names = frozenset(names)
        self._by_last: dict[str, list[tuple[str, tuple[str, ...]]]] = {}
        for name in sorted(self._names):
            parts = _parts(name)
            for last in {parts[-1], PurePosixPath(parts[-1]).stem}:
                self._by_last.setdefault(last, []).append((name, parts))
        self._name_in_file: dict[str, str] = {}

    def find(self, name_in_file: str, where: str) -> str | None:
        """The photograph that a file means by a name; None where there is none.

        Case, slashes and the encoding of accents do not count; the suffix may be missing. One of the two paths may
        begin further up than the other, but their folders must not contradict each other. ``where`` is the file, and
        the line, for errors.
        """
        image = name_in_file if name_in_file in self._names else self._longest_tail(name_in_file, where)
        if image is None:
            return None
        # Of two names of one photograph the longer one is kept, since it has more folders to contradict.
        before = self._name_in_file.setdefault(image, name_in_file)
        if not _agree(_parts(before)[:-1], _parts(name_in_file)[:-1]):
            raise ImageError(
                f"{where}: {name_in_file} and {before} are two photographs, and both names fit {image} "
                "alone; keep the photographs in the folders that the file has, or remove the lines of the other one"
            )
        self._name_in_file[image] = max(before, name_in_file, key=lambda name: len(_parts(name)))
        return image

    def _longest_tail(self, name_in_file: str, where: str) -> str | None:
        parts = _parts(name_in_file)
        if not parts:
            return None
        ranks = {
            name: (min(len(own), len(parts)), len(own) == len(parts), own[-1] == parts[-1])
            for name, own in self._by_last.get(parts[-1], ())
            if _agree(own[:-1], parts[:-1])
        }
        best = [name for name, rank in ranks.items() if rank == max(ranks.values())]
        if len(best) > 1:
            raise ImageError(
                f"{where}: {name_in_file} fits {best[0]} and {best[1]}"
                f"{f' and {len(best) - 2} more' if len(best) > 2 else ''}, expected the name of one photograph; write "
                f'its folder and suffix too, e.g. "{best[0]}"'
            )
        return best[0] if best else None


def _parts(name: str) -> tuple[str, ...]:
    """Folders and file of a name, whatever its case, slashes and encoding of accents."""
    return PurePosixPath(unicodedata.normalize("NFC", name.strip().replace("\\", "/")).casefold()).parts


def _agree(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    """Whether the folders of two paths do not contradict each other: one path may begin further up."""
    shared = min(len(a), len(b))
    return a[len(a) - shared :] == b[len(b) - shared :]
