"""Surveys of several flights over one bed, as structure from motion with straight rays hands them to the adjustment.

Each flight has its own camera, height, level of the water and accuracy of positions. No image is drawn: matches are
exact places with noise, and mapping ends in COLMAP's bundle adjustment of poses, lenses and points, which knows no
water.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from geo import LocalFrame, parse_crs
from refract import FlatWater, PinholeCamera
from refract.lens import Lens
from survey.folder.local_frame import water_plane
from survey.folder.observations import Observations
from survey.folder.pose_priors import BAROMETER_STD_M, PosePrior
from survey.folder.sfm_views import _heights_by_focals
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.settings.config import CamerasConfig, SurveyConfig, WaterConfig
from survey.sfm import block as sfm_block
from survey.sfm.absolute_orientation import place_by_gps
from survey.sfm.features import CameraBody, solver
from survey.sfm.gps import GpsPositions
from survey.sfm.gps_fit import is_contradicted
from survey.sfm.poses import SfmResult
from survey.sfm.solve import FreeBlocks, reset_focals
from tests.block_survey import CRS, ORIGIN

INDEX, PIXEL_STD = 1.34, 0.3
# Of positions without corrections: what a flight has in common, and single ones.
COMMON_STD_M, SINGLE_STD_M = (1.5, 1.5, 3.0), (0.3, 0.3, 0.5)
# Half the extent of the bed and of a flight over it.
HALF_BED_M, HALF_FLIGHT_M = (50.0, 40.0), (25.0, 20.0)


@dataclass(frozen=True)
class Flight:
    """A flight to and fro over the bed, looking down.

    Attributes
    ----------
    focal, size_px, k1 : [px], (width, height), [-]
        Of its camera.
    height_m, tide_m : [m]
        Of camera and water over the plane of the water.
    position_std_m : [m] or None
        Of its positions, in plan, and as stated; None without corrections, when none is.
    exif : [-]
        The focal length in EXIF over the true one.
    rows, columns : int
        Of its photographs.
    """

    focal: float = 900.0
    size_px: tuple[int, int] = (800, 600)
    k1: float = -0.02
    height_m: float = 45.0
    tide_m: float = 0.0
    position_std_m: float | None = 0.03
    exif: float = 1.0
    rows: int = 4
    columns: int = 6


@dataclass(frozen=True)
class DrawnFlights:
    """A survey of flights, and its truth.

    Attributes
    ----------
    survey : Survey
    flight : (V,) int64
        Of each view.
    centres, focals : (V, 3) [m], local, (V,) [px]
    bed : callable
        Heights [m], local, at x and y.
    """

    survey: Survey
    flight: np.ndarray
    centres: np.ndarray
    focals: np.ndarray
    bed: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class _Photograph:
    """One as it was taken: name, flight, camera, and numbers (N,) and pixels (N, 2) of the points that it shows."""

    name: str
    flight: int
    camera: PinholeCamera
    point: np.ndarray
    pixel: np.ndarray


def draw_flights(
    seed: int, flights: Sequence[Flight], *, num_points: int = 1200, datum_m: Sequence[float] = ()
) -> DrawnFlights:
    """Flights over a bed 2 to 4 m under water, after structure from motion.

    ``datum_m`` is added to the heights of the positions of each.
    """
    rng = np.random.default_rng([seed, 61])
    phase = rng.uniform(0.0, 6.0, 2)

    def bed(x, y):
        return -3.0 + 0.5 * np.sin(x / 9.0 + phase[0]) + 0.5 * np.cos(y / 7.0 + phase[1])

    places = rng.uniform(-np.array(HALF_BED_M), HALF_BED_M, (num_points, 2))
    points = np.column_stack([places, bed(*places.T)])
    photographs = [shot for number, flight in enumerate(flights) for shot in _fly(rng, number, flight, points)]
    frame, number = LocalFrame(parse_crs(CRS), ORIGIN), np.array([shot.flight for shot in photographs])
    sensors = [
        CameraBody(tuple(shot.name for shot in photographs if shot.flight == k), flight.size_px, each)
        for k, flight in enumerate(flights)
        for each in [flight.exif * flight.focal]
    ]
    centres = np.array([shot.camera.centre for shot in photographs])
    gps, std = _positions(rng, flights, number, centres)
    gps[:, 2] += np.array(datum_m or np.zeros(len(flights)))[number]
    block = _mapped(rng, photographs, sensors, points)
    reset_focals(block, {name: sensor.focal_px for sensor in sensors for name in sensor.names})
    positions = {shot.name: place for shot, place in zip(photographs, gps, strict=True)}
    placed = place_by_gps(FreeBlocks((block,), ()), GpsPositions(frame, positions, ()), sensors)
    down = np.array([0.0, 0.0, placed.frame.origin[2] - ORIGIN[2]])
    survey = _survey(placed.frame, placed.blocks[0], photographs, sensors, gps - down, std)
    focals = np.array([flights[k].focal for k in number])
    return DrawnFlights(survey, number, centres - down, focals, lambda x, y: bed(x, y) - down[2])


def _fly(rng: np.random.Generator, number: int, flight: Flight, points: np.ndarray) -> list[_Photograph]:
    """The photographs of a flight; those of all flights have the same names, in a folder of their own."""
    (width, height), water = flight.size_px, FlatWater((0.0, 0.0, 0.0), n_water=INDEX)
    lens = Lens("RADIAL", (flight.focal, 0.5 * width, 0.5 * height, flight.k1, -0.3 * flight.k1), width, height)
    photographs = []
    for row, y in enumerate(np.linspace(-HALF_FLIGHT_M[1], HALF_FLIGHT_M[1], flight.rows)):
        for x in np.linspace(-HALF_FLIGHT_M[0], HALF_FLIGHT_M[0], flight.columns):
            centre = np.array([x, y, flight.height_m]) + rng.normal(0.0, (0.5, 0.5, 0.3))
            angles = np.array([180.0, 0.0, 180.0 * (row % 2)]) + rng.normal(0.0, 1.0, 3)
            rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
            camera = replace(lens.camera(centre, rotation), tide=flight.tide_m)
            pixel = camera.project(points, water)
            inside = ((pixel > 1.0) & (pixel < np.array([width, height]) - 1.0)).all(axis=1)
            # No matcher finds each point in each photograph.
            found = np.flatnonzero(inside & (rng.random(len(points)) < 0.8))
            name = f"flight{number}/{len(photographs):04d}.jpg"
            noise = rng.normal(0.0, PIXEL_STD, (len(found), 2))
            photographs.append(_Photograph(name, number, camera, found, pixel[found] + noise))
    return photographs


def _positions(rng: np.random.Generator, flights: Sequence[Flight], number: np.ndarray, centres: np.ndarray):
    """Positions by GPS (V, 3) [m] and their stated standard deviations (V, 3) [m], NaN without."""
    gps, stds = centres.copy(), np.full(centres.shape, np.nan)
    for k, flight in enumerate(flights):
        own = number == k
        if flight.position_std_m is None:
            gps[own] += rng.normal(0.0, COMMON_STD_M) + rng.normal(0.0, SINGLE_STD_M, (own.sum(), 3))
        else:
            stds[own] = flight.position_std_m * np.array([1.0, 1.0, 1.5])
            gps[own] += rng.normal(0.0, stds[own])
    return gps, stds


def _mapped(
    rng: np.random.Generator, photographs: Sequence[_Photograph], sensors: Sequence[CameraBody], points: np.ndarray
) -> pycolmap.Reconstruction:
    """The block that mapping makes, from near the truth and the lenses of EXIF."""
    colmap, block = solver(), pycolmap.Reconstruction()
    for number, sensor in enumerate(sensors, start=1):
        width, height = sensor.size_px
        params = [sensor.focal_px, 0.5 * width, 0.5 * height, 0.0, 0.0]
        block.add_camera_with_trivial_rig(
            colmap.Camera(camera_id=number, model="RADIAL", width=width, height=height, params=params)
        )
    seen_in: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for number, shot in enumerate(photographs, start=1):
        rotation = shot.camera.cam_from_local
        centre = shot.camera.centre + rng.normal(0.0, 0.3, 3)
        image = colmap.Image(name=shot.name, keypoints=shot.pixel, camera_id=shot.flight + 1, image_id=number)
        block.add_image_with_trivial_frame(image, colmap.Rigid3d(colmap.Rotation3d(rotation), -rotation @ centre))
        for place, point in enumerate(shot.point):
            seen_in[point].append(colmap.TrackElement(number, place))
    for xyz, elements in zip(points, seen_in, strict=True):
        if len(elements) > 2:
            block.add_point3D(xyz + rng.normal(0.0, 0.2, 3), colmap.Track(elements))
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = False
    colmap.bundle_adjustment(block, options)
    block.update_point_3d_errors()
    return block


def _survey(
    frame: LocalFrame,
    block: pycolmap.Reconstruction,
    photographs: Sequence[_Photograph],
    sensors: Sequence[CameraBody],
    gps: np.ndarray,
    stds: np.ndarray,
) -> Survey:
    """The survey with positions (V, 3) [m] in its frame, those that the block contradicts left out."""
    poses, views = sfm_block.poses_of(block), []
    for shot in photographs:
        lens = sfm_block.lens_of(block, shot.name)
        camera = replace(lens.camera(*poses[shot.name]), tide=shot.camera.tide)
        views.append(View(shot.name, Path(shot.name), camera, lens))
    ties = sfm_block.tracks_of(block, [view.name for view in views])
    residuals = np.array([view.camera.centre for view in views]) - gps
    off = residuals - _heights_by_focals(SfmResult(frame, tuple(views), (), residuals, ties))
    rejected = {view.name for view, is_wrong in zip(views, is_contradicted(off), strict=True) if is_wrong}
    priors = {}
    for view, place, std in zip(views, gps, stds, strict=True):
        prior = PosePrior(place, std, None, "XMP RTK")
        if np.isnan(std).any():
            prior = PosePrior(place, None, None, "GPS EXIF", BAROMETER_STD_M)
        priors[view.name] = prior.without_position() if view.name in rejected else prior
    water = WaterConfig(level_m=ORIGIN[2], level_at=ORIGIN[:2], refractive_index=INDEX, index_std=0.0005)
    return Survey(
        name="flights",
        folder=Path("flights"),
        frame=frame,
        views=tuple(views),
        water=water_plane(frame, water),
        config=SurveyConfig(crs=CRS, water=water, cameras=CamerasConfig()),
        observations=Observations(
            points=ties.start,
            ties=ties,
            priors=priors,
            exif_focals={name: sensor.focal_px for sensor in sensors for name in sensor.names},
        ),
    )
