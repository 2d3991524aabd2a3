"""A block of six photographs with exact tie points, for independent writers of the formats of other programs.

Written for these tests (licence of the repository). Nothing of `geo` or `refract` is in it: the Earth is PROJ's, with
its own geocentric and topocentric steps and its meridian convergence; the lens is written out by hand.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pyproj import Proj, Transformer
from scipy.spatial.transform import Rotation
from small_survey import write_image

from survey.folder.survey import Survey, load_survey

# 1.2 degrees east of the central meridian of zone 32, where grid north is 0.8 degrees east of north.
LAT, LON, HEIGHT = 46.9, 10.17, 2105.0
SIZE = (640, 480)
UTM, VERTICAL = "EPSG:25832", "EPSG:5778"
# The polar axis of GRS 80, under UTM in ETRS89, is 0.1 mm longer than that of WGS 84: 0.003 px from 25 m. Files have
# 1e-9 degrees and 1e-6 m.
CLOSE_PX = 5e-3

_TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
_TO_UTM = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
_ENU = Transformer.from_pipeline(
    f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lon_0={LON} +lat_0={LAT} "
    f"+h_0={HEIGHT}"
)


@dataclass(frozen=True)
class ForeignLens:
    """Brown's lens in OpenCV's order, with the affine term and the r^8 of Metashape."""

    fx: float = 520.0
    fy: float = 523.0
    cx: float = 325.5
    cy: float = 238.25
    k: tuple[float, float, float, float] = (-0.08, 0.03, -0.01, 0.0)
    p1: float = 0.004
    p2: float = -0.002
    skew: float = 0.0

    def project(self, seen: np.ndarray) -> np.ndarray:
        """Pixels (N, 2), the centre of the first at 0.5, 0.5, of points (N, 3) in cam."""
        x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
        r2 = x * x + y * y
        radial = 1.0 + sum(k * r2 ** (i + 1) for i, k in enumerate(self.k))
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        yd = y * radial + 2.0 * self.p2 * x * y + self.p1 * (r2 + 2.0 * y * y)
        return np.column_stack([self.cx + self.fx * xd + self.skew * yd, self.cy + self.fy * yd])


@dataclass(frozen=True)
class ForeignBlock:
    """Photographs and points east, north and up of a place on the ellipsoid.

    Attributes
    ----------
    names : of the images
    centres : (V, 3) [m]
    cams : (V, 3, 3)
        From east, north, up at the place into x right, y down, z forward.
    points : (N, 3) [m]
    lens : ForeignLens
    """

    names: tuple[str, ...]
    centres: np.ndarray
    cams: np.ndarray
    points: np.ndarray
    lens: ForeignLens = field(default_factory=ForeignLens)

    def with_lens(self, **numbers) -> ForeignBlock:
        return replace(self, lens=replace(self.lens, **numbers))

    def pixels(self, view: int) -> np.ndarray:
        """Where a view shows the points, (N, 2)."""
        return self.lens.project((self.points - self.centres[view]) @ self.cams[view].T)

    def seen(self, view: int) -> np.ndarray:
        """Numbers of the points in an image."""
        pixels = self.pixels(view)
        return np.flatnonzero(((pixels > 0.0) & (pixels < SIZE)).all(axis=1))


def draw_block() -> ForeignBlock:
    """Nadir and oblique views from 25 m, turned by all angles, over points up to 3 m high."""
    rng = np.random.default_rng(11)
    names = tuple(f"{i:04d}.jpg" for i in range(6))
    centres = np.array([[5.0 * (i % 3) - 5.0, 6.0 * (i // 3) - 3.0, 25.0 + 0.7 * i] for i in range(6)])
    down = np.diag([1.0, -1.0, -1.0])
    turns = [
        (4.0, -7.0, 15.0),
        (-9.0, 3.0, 100.0),
        (12.0, 8.0, -160.0),
        (0.0, 0.0, 0.0),
        (-14.0, -5.0, 61.0),
        (7.0, 2.0, -80.0),
    ]
    cams = np.array([down @ Rotation.from_euler("XYZ", three, degrees=True).as_matrix().T for three in turns])
    points = rng.uniform((-12.0, -10.0, 0.0), (12.0, 10.0, 3.0), (60, 3))
    return ForeignBlock(names, centres, cams, points)


def lon_lat_height(enu: np.ndarray) -> np.ndarray:
    """Longitudes, latitudes [deg] and ellipsoidal heights [m], (N, 3)."""
    return np.column_stack(_ENU.transform(*enu.T, radians=False, direction="INVERSE"))


def in_ecef(enu: np.ndarray) -> np.ndarray:
    """Geocentric coordinates (N, 3) [m]."""
    return np.column_stack(_TO_ECEF.transform(*lon_lat_height(enu).T))


def in_utm(enu: np.ndarray) -> np.ndarray:
    """Easting, northing and ellipsoidal height (N, 3)."""
    lon, lat, height = lon_lat_height(enu).T
    return np.column_stack([*_TO_UTM.transform(lon, lat), height])


def ecef_from_enu() -> np.ndarray:
    """Rotation (3, 3) from east, north and up at the place, column by column from places along its axes."""
    step = 100.0
    ends = in_ecef(np.vstack([step * np.eye(3), np.zeros((1, 3))]))
    return ((ends[:3] - ends[3]) / step).T


def level_at(enu: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from true east, north and up at a point (3,) to those at the place."""
    lon, lat, height = lon_lat_height(enu[None])[0].tolist()
    there = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} "
        f"+lat_0={lat!r} +h_0={height!r}"
    )
    step = 100.0
    local = np.vstack([step * np.eye(3), np.zeros((1, 3))])
    ends = np.column_stack(_ENU.transform(*there.transform(*local.T, direction="INVERSE")))
    return ((ends[:3] - ends[3]) / step).T


def grid_at(enu: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from the grid axes at a point (3,) to east, north and up at the place."""
    lon, lat, _ = lon_lat_height(enu[None])[0]
    turn = Proj(UTM).get_factors(lon, lat).meridian_convergence
    # Grid north lies east of true north by the convergence: grid axes are turned clockwise, seen from above.
    return level_at(enu) @ Rotation.from_euler("z", -turn, degrees=True).as_matrix()


def opk_deg(block: ForeignBlock, view: int) -> np.ndarray:
    """Omega, phi and kappa (3,) [deg] of a view about the grid axes at its camera."""
    cam_from_grid = block.cams[view] @ grid_at(block.centres[view])
    photo = np.diag([1.0, -1.0, -1.0])  # x right, y up, z back
    return Rotation.from_matrix((photo @ cam_from_grid).T).as_euler("XYZ", degrees=True)


def write_images(folder: Path, names: tuple[str, ...]) -> None:
    """Images of the size of the block, all with the same pixels."""
    first = folder / "images" / names[0]
    write_image(first, size=SIZE)
    for name in names[1:]:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "images" / name).write_bytes(first.read_bytes() + name.encode())


def load(
    folder: Path, block: ForeignBlock, poses: str, more: str = "", cameras: str = "", crs: str | None = None
) -> Survey:
    """The block as a survey with a poses file that lies in a folder already."""
    write_images(folder, block.names)
    crs = crs or f"{UTM}+{VERTICAL.removeprefix('EPSG:')}"
    (folder / "survey.toml").write_text(f'crs = "{crs}"\n[cameras]\nposes = "{poses}"\n{cameras}\n{more}\n')
    return load_survey(folder)


def most_missed_px(survey: Survey, block: ForeignBlock) -> float:
    """Greatest distance between where the cameras of a survey put points of the block and where it shows them."""
    points = survey.frame.local_from_crs(in_utm(block.points))
    most = 0.0
    assert len(survey.views) == len(block.names)
    for view in survey.views:
        number = [name.rpartition("/")[2] for name in block.names].index(view.name.rpartition("/")[2])
        mine = block.seen(number)
        assert len(mine) > 10
        missed = view.camera.project(points[mine], None) - block.pixels(number)[mine]
        most = max(most, float(np.nan_to_num(np.linalg.norm(missed, axis=1), nan=np.inf).max()))
    return most
