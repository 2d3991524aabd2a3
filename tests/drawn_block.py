"""Random blocks of photographs over wet and dry ground as exact tie points with noise; no image is drawn.

What an adjustment gets, and what it should find: poses, lens and water differ from what is stated about them by random
errors of the stated standard deviations.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater, PinholeCamera
from refract.lens import Lens, distorted
from survey.photos.poses import TiePoints

# Of what is stated: level [m], slopes [-] (known to be zero where the true ones are), index [-].
LEVEL_STD_M, INDEX_STD = 0.04, 0.001
CONTROL_STD_M = 0.01
# Of a start, not of a prior.
START_POINT_STD_M, START_ROTATION_STD = 0.2, math.radians(0.1)


@dataclass(frozen=True)
class Truth:
    """What is true of a block, local."""

    points: np.ndarray  # (M, 3) [m]
    cameras: tuple[PinholeCamera, ...]  # V, with the true focal length and principal point
    lens: Lens
    water: np.ndarray  # level at the origin [m], slopes along x and y, index
    velocities: np.ndarray  # (V, 3) [m/s], of the cameras


@dataclass(frozen=True)
class DrawnBlock(Truth):
    """A block and its truth, local; V views, M points, N observations, K control points."""

    start: np.ndarray  # (M, 3) [m], where the points are about
    # (N,), (N,), (N, 2) [px]: observations, sorted by point, in the distorted photographs; three at least of a point.
    point: np.ndarray
    view: np.ndarray
    pixel: np.ndarray
    start_cameras: tuple[PinholeCamera, ...]  # poses to start from, with the stated lens
    positions: np.ndarray  # (V, 3) [m], from GPS
    position_std: np.ndarray
    # (K,), (K, 3) [m]: which points are surveyed marks, and where they were measured.
    control: np.ndarray
    control_points: np.ndarray
    control_std: np.ndarray
    stated_lens: Lens  # a data sheet without distortion
    stated_water: np.ndarray  # as `water`
    water_std: np.ndarray
    readout: float  # of the rolling shutter from the first to the last row [s]
    pixel_std: float
    seed: int

    @property
    def plane(self) -> FlatWater:
        """The true water."""
        return water_plane(self.water)


def water_plane(water: np.ndarray) -> FlatWater:
    """Water of level at the origin, slopes along x and y, and index."""
    level, slope_x, slope_y, index = (float(v) for v in water)
    return FlatWater((0.0, 0.0, level), n_water=index, slope_x=slope_x, slope_y=slope_y)


@dataclass(frozen=True)
class Wanted:
    """What a block should be like; None is drawn."""

    num_points: int = 600
    num_views: int | None = None
    nadir_only: bool | None = None  # no views tilted by 12 to 38 degrees
    dry_share: float | None = None  # of the points, on a bank; control points lie there
    num_control: int | None = None
    pixel_std: float | None = None
    position_std: tuple[float, float, float] = (0.02, 0.02, 0.03)  # of GPS [m]
    wrong: float = 0.0  # share of the observations that are up to 15 px off
    # Standard deviation over `pixel_std` of errors that neighbours in a photograph share: waves bend their rays alike.
    shared: float = 0.0
    height: float | None = None  # of the cameras over the water [m]
    depth: float | None = None  # of the deepest water [m]
    strip: bool = False  # all strips lie on one line
    spacing: float | None = None  # from photograph to photograph, as a share of the width on the ground
    speed: float = 0.0  # of the cameras, each in a direction of its own [m/s]
    readout: float = 0.0  # of their rolling shutter [s]


def draw_block(seed: int, *, bed: Callable[..., np.ndarray] | None = None, **settings) -> DrawnBlock:
    """A random block; settings as `Wanted`. One seed draws the same block on every machine, up to rounding.

    ``bed`` draws the points in place of `_bed`, with its arguments.
    """
    wanted, rng = Wanted(**settings), np.random.default_rng([seed, 30])
    num_views = int(rng.integers(16, 41)) if wanted.num_views is None else wanted.num_views
    nadir_only = rng.random() < 0.25 if wanted.nadir_only is None else wanted.nadir_only
    dry_share = (
        (rng.uniform(0.15, 0.5) if rng.random() < 0.6 else 0.0) if wanted.dry_share is None else wanted.dry_share
    )
    num_control = int(rng.integers(5, 9)) if wanted.num_control is None else wanted.num_control
    pixel_std = rng.uniform(0.15, 0.5) if wanted.pixel_std is None else wanted.pixel_std

    stated_lens, lens = _lenses(rng)
    # Drawn even where they are wanted, so that all else stays.
    drawn = rng.uniform(15.0, 45.0)
    height = drawn if wanted.height is None else wanted.height
    drawn = rng.uniform(0.8, min(6.0, 0.2 * height))
    depth = drawn if wanted.depth is None else wanted.depth
    slopes = rng.normal(0.0, 0.002, 2) if rng.random() < 0.3 else np.zeros(2)
    water = np.array([rng.normal(0.0, 0.3), *slopes, rng.uniform(1.325, 1.345)])
    plane = water_plane(water)
    half = 0.5 * height / lens.focal[0] * np.array([lens.width, lens.height]) * rng.uniform(0.9, 1.4)
    if wanted.strip:
        half = height / lens.focal[0] * np.array([0.1 * lens.width * num_views, 0.45 * lens.height])
    if wanted.spacing is not None:
        half = 0.5 * height / lens.focal[0] * wanted.spacing * lens.width * np.sqrt([num_views, num_views])
    strips = half * [1.0, 0.0 if wanted.strip else 1.0]
    cameras = _fly(rng, lens, water[0], height, strips, num_views, nadir_only)
    points = (bed or _bed)(rng, plane, half, depth, wanted.num_points, dry_share)

    velocities = _velocities(np.random.default_rng([seed, 32]), len(cameras), wanted.speed)
    point, view, pixel = _seen(rng, lens, cameras, velocities * wanted.readout, points, plane)
    pixel = pixel + pixel_std * rng.standard_normal(pixel.shape)
    pixel = pixel + (rng.random((len(pixel), 1)) < wanted.wrong) * rng.uniform(-15.0, 15.0, pixel.shape)
    if wanted.shared > 0.0:
        waves = _waves(np.random.default_rng([seed, 31]), view, pixel, lens.width)
        pixel = pixel + wanted.shared * pixel_std * waves
    points, point, view, pixel = _of_three_views(points, point, view, pixel)
    truth = Truth(points, tuple(cameras), lens, water, velocities)
    observed = {"point": point, "view": view, "pixel": pixel, "pixel_std": float(pixel_std), "seed": seed}
    return DrawnBlock(**observed, **_stated(rng, truth, stated_lens, num_control, wanted), **vars(truth))


def _seen(rng, lens: Lens, cameras, path: np.ndarray, points: np.ndarray, plane: FlatWater):
    """Numbers of points and views and pixels of what the cameras, which fly a path (V, 3) [m] while they read, see."""
    seen = []
    for view, camera in enumerate(cameras):
        reached = np.flatnonzero(_is_reached(lens, camera, points))
        pixel = np.full((len(reached), 2), np.nan)
        ahead = camera.project(points[reached], plane)
        # Distortion is a polynomial: far outside the image it would fold points back into it.
        size = np.array([lens.width, lens.height])
        near = (np.abs(ahead - 0.5 * size) < 0.6 * size).all(axis=1)
        pixel[near] = distorted(lens, ahead[near])
        if path[view].any():
            flown = replace(lens.camera(camera.centre, camera.cam_from_local), motion=path[view] / (lens.height - 1))
            pixel[near] = flown.project(points[reached[near]], plane)
        within = ((pixel > 1.0) & (pixel < size - 1.0)).all(axis=1)
        inside, pixel = reached[within], pixel[within]
        # No matcher finds each point in each photograph.
        found = rng.random(len(inside)) < 0.8
        seen.append((inside[found], np.full(int(found.sum()), view), pixel[found]))
    return (np.concatenate(column) for column in zip(*seen, strict=True))


def _is_reached(lens: Lens, camera: PinholeCamera, points: np.ndarray) -> np.ndarray:
    """Which points (M, 3) a camera may see: water bends rays towards the vertical, so that straight ones go further."""
    widest = math.atan(0.7 * math.hypot(lens.width, lens.height) / lens.focal[0])
    steepest = min(widest + math.acos(min(-camera.cam_from_local[2, 2], 1.0)), 1.5)
    reach = math.tan(steepest) * (camera.centre[2] - points[:, 2].min())
    return np.hypot(*(points - camera.centre).T[:2]) < reach


def _of_three_views(points: np.ndarray, point: np.ndarray, view: np.ndarray, pixel: np.ndarray):
    """The points that three photographs see, and their observations, sorted by point."""
    order = np.argsort(point, kind="stable")
    point, view, pixel = point[order], view[order], pixel[order]
    enough = np.bincount(point, minlength=len(points)) >= 3
    keep = enough[point]
    number = np.cumsum(enough) - 1
    return points[enough], number[point[keep]].astype(np.int64), view[keep].astype(np.int64), pixel[keep]


def _stated(rng, truth: Truth, lens: Lens, num_control: int, wanted: Wanted) -> dict:
    """What a survey would state about a block, a lens among it, with the errors that it would have."""
    points, plane = truth.points, water_plane(truth.water)
    dry = np.flatnonzero(points[:, 2] > plane.height(*points.T[:2]) + 0.05)
    control = np.sort(rng.permutation(dry)[:num_control])
    control_points = points[control] + CONTROL_STD_M * rng.standard_normal((len(control), 3))
    water_std = np.array([LEVEL_STD_M, 0.0, 0.0, INDEX_STD])
    centres = np.array([camera.centre for camera in truth.cameras])
    positions = centres + rng.normal(0.0, wanted.position_std, centres.shape)
    start_cameras = tuple(
        lens.pinhole(place, _turned(camera.cam_from_local, START_ROTATION_STD * rng.standard_normal(3)))
        for camera, place in zip(truth.cameras, positions, strict=True)
    )
    return {
        "start": points + START_POINT_STD_M * rng.standard_normal(points.shape),
        "start_cameras": start_cameras,
        "positions": positions,
        "position_std": np.array(wanted.position_std),
        "control": control.astype(np.int64),
        "control_points": control_points,
        "control_std": np.full(3, CONTROL_STD_M),
        "stated_lens": lens,
        "stated_water": truth.water + water_std * rng.standard_normal(4),
        "water_std": water_std,
        "readout": wanted.readout,
    }


def _lenses(rng: np.random.Generator) -> tuple[Lens, Lens]:
    """That of a data sheet, without distortion, and the true one."""
    width, height = ((640, 480), (800, 600), (1024, 768))[rng.integers(3)]
    focal = width * rng.uniform(0.85, 1.6)
    true_focal = focal * (1.0 + rng.uniform(0.001, 0.01) * rng.choice([-1.0, 1.0]))
    off_axis, toward = rng.uniform(0.0, 8.0), rng.uniform(0.0, 2.0 * math.pi)
    cx, cy = 0.5 * width + off_axis * math.cos(toward), 0.5 * height + off_axis * math.sin(toward)
    k1 = rng.uniform(0.01, 0.08) * rng.choice([-1.0, 1.0])
    distortion = (k1, -k1 * rng.uniform(0.2, 0.8), *rng.normal(0.0, 0.0005, 2))
    stated = Lens("OPENCV", (focal, focal, 0.5 * width, 0.5 * height, 0.0, 0.0, 0.0, 0.0), width, height)
    return stated, Lens("OPENCV", (true_focal, true_focal, cx, cy, *distortion), width, height)


def _fly(rng, lens: Lens, level: float, height: float, half, num_views: int, nadir_only: bool) -> list[PinholeCamera]:
    """Strips that look down, to and fro, then views from all around."""
    num_oblique = 0 if nadir_only else round(num_views * rng.uniform(0.2, 0.45))
    num_nadir = num_views - num_oblique
    rows = max(round(math.sqrt(num_nadir * half[1] / half[0])), 2)
    poses = []
    for k in range(num_nadir):
        row, column = divmod(k, -(-num_nadir // rows))
        x = half[0] * (2.0 * column / max(-(-num_nadir // rows) - 1, 1) - 1.0)
        y = half[1] * (2.0 * row / (rows - 1) - 1.0)
        poses.append((x, y, 0.0, math.pi * (row % 2)))
    for k in range(num_oblique):
        tilt, toward = rng.uniform(0.2, 0.66), 2.4 * k
        target = rng.uniform(-0.3, 0.3, 2) * half
        x, y = target - height * math.tan(tilt) * np.array([math.sin(toward), math.cos(toward)])
        poses.append((x, y, tilt, toward))
    return [_camera(rng, lens, level + height, pose) for pose in poses]


def _camera(rng, lens: Lens, height: float, pose: tuple[float, float, float, float]) -> PinholeCamera:
    """A camera that is tilted toward a heading, shaken by wind."""
    x, y, tilt, heading = pose
    ahead = np.array([math.sin(heading), math.cos(heading)])
    forward = np.array([*(math.sin(tilt) * ahead), -math.cos(tilt)])
    top = np.array([*(math.cos(tilt) * ahead), math.sin(tilt)])
    axes = np.stack([np.cross(forward, top), -top, forward])
    centre = np.array([x, y, height]) + rng.normal(0.0, (0.2, 0.2, 0.012 * height))
    return lens.pinhole(centre, _turned(axes, rng.normal(0.0, 0.015, 3)))


def _velocities(rng: np.random.Generator, count: int, speed: float) -> np.ndarray:
    """Level velocities (count, 3) of one speed in all directions."""
    toward = rng.uniform(0.0, 2.0 * math.pi, count)
    return speed * np.column_stack([np.sin(toward), np.cos(toward), np.zeros(count)])


def _bed(rng, plane: FlatWater, half, depth: float, num_points: int, dry_share: float) -> np.ndarray:
    """Points (num_points, 3): a bed that rises to one side, to a bank where a share of it is dry."""
    places = rng.uniform(-half, half, (num_points, 2))
    toward, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    along = places @ [math.sin(toward), math.cos(toward)]
    rank = np.argsort(np.argsort(along)) / num_points
    relief = 0.12 * depth * np.sin(places @ rng.normal(0.0, 4.0, 2) / half.mean() + phase)
    # Where all is dry, the foot of the bank lies beside the block.
    low, shore = -depth, 1.0 - dry_share if dry_share < 1.0 else -0.01
    rise = 0.8 if dry_share == 0.0 else 1.0
    wet = np.minimum((low + relief) * (1.0 - rise * rank / shore), -0.02)
    bank = 0.02 + 1.2 * np.maximum(rank - shore, 0.0) + 0.05 * rng.random(num_points)
    above = np.where(rank > shore, bank, wet)
    return np.column_stack([places, plane.height(*places.T) + above])


def _waves(rng: np.random.Generator, view: np.ndarray, pixel: np.ndarray, width: int) -> np.ndarray:
    """Errors (N, 2) of unit standard deviation: in each photograph waves 0.08 to 0.3 of its width long."""
    out = np.empty_like(pixel)
    for number in np.unique(view):
        mine = view == number
        for axis in range(2):
            length, toward = rng.uniform(0.08, 0.3, 12) * width, rng.uniform(0.0, 2.0 * math.pi, 12)
            waves = 2.0 * math.pi / length * np.stack([np.sin(toward), np.cos(toward)])
            phases = pixel[mine] @ waves + rng.uniform(0.0, 2.0 * math.pi, 12)
            out[mine, axis] = math.sqrt(2.0 / 12) * np.cos(phases).sum(axis=1)
    return out


def _turned(axes: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A rotation matrix turned by a rotation vector [rad]."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * across @ across) @ axes


# A block of photographs over known water: the oracle of the self-calibration.
TRUTH = np.array([0.3, 0.002, -0.001, 1.335])
SIZE, FOCAL, HEIGHT = (1024, 768), 1750.0, 40.0


def looking_at_origin(centre, turn: float) -> PinholeCamera:
    """A camera whose axis meets the origin, turned about it."""
    forward = -np.asarray(centre) / np.linalg.norm(centre)
    right = np.cross(forward, [np.sin(turn), np.cos(turn), 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return PinholeCamera(np.asarray(centre), rotation, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)


def convergent() -> list[PinholeCamera]:
    """Five views from above and two rings of eight, 25 and 45 degrees off nadir."""
    cameras = nadir()[:5]
    for off in np.radians([25.0, 45.0]):
        for azimuth in 2.0 * np.pi * np.arange(8) / 8:
            side = HEIGHT * np.tan(off)
            centre = (side * np.cos(azimuth), side * np.sin(azimuth), HEIGHT)
            cameras.append(looking_at_origin(centre, azimuth))
    return cameras


def nadir() -> list[PinholeCamera]:
    """Nine views straight down, 5 m apart."""
    rotation = np.diag([1.0, -1.0, -1.0])
    places = [(0, 0), (5, 0), (-5, 0), (0, 5), (0, -5), (5, 5), (-5, 5), (5, -5), (-5, -5)]
    return [
        PinholeCamera(np.array([x, y, HEIGHT]), rotation, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
        for x, y in places
    ]


def meeting_of_straight_rays(cameras, ties: TiePoints) -> np.ndarray:
    """Points (M, 3) nearest to their lines of sight, as if there were no water."""
    normal, right = np.zeros((len(ties), 3, 3)), np.zeros((len(ties), 3))
    for view, camera in enumerate(cameras):
        mine = ties.view == view
        ray = (ties.pixel[mine] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        ray = np.column_stack([ray, np.ones(len(ray))]) @ camera.cam_from_local
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        np.add.at(normal, ties.point[mine], across)
        np.add.at(right, ties.point[mine], across @ camera.centre)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def tie_points(cameras, rng, *, count=300, std_px=0.1, low=-5.0, high=-0.5, wrong=0.0) -> TiePoints:
    """Points of a bed between two heights [m], seen by every camera that has them in its image.

    ``wrong`` is the share of measurements that are up to 20 px off.
    """
    points = np.column_stack([rng.uniform(-9.0, 9.0, (count, 2)), rng.uniform(low, high, count)])
    rows = []
    for view, camera in enumerate(cameras):
        pixels = camera.project(points, water_plane(TRUTH))
        seen = np.flatnonzero((pixels > 0.0).all(axis=1) & (pixels < SIZE).all(axis=1))
        noise = std_px * rng.normal(size=(len(seen), 2))
        noise += (rng.random((len(seen), 1)) < wrong) * rng.uniform(-20.0, 20.0, (len(seen), 2))
        rows.append((seen, np.full(len(seen), view), pixels[seen] + noise))
    point, view, pixel = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(point, kind="stable")
    start = points + rng.normal(0.0, 0.2, points.shape)
    ties = TiePoints(start, point[order], view[order], pixel[order])
    return ties.only(np.ones(len(ties.view), dtype=bool))
