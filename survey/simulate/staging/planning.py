"""Plan of a scene file: its place on Earth, lens, flight and inputs."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from pathlib import Path

import numpy as np

from geo.crs import height_unit_m, parse_crs
from geo.frames import LocalFrame
from geo.sun import Sun, sun_at
from refract import PinholeCamera
from refract.lens import MODELS, Lens, LensError, coefficients_of
from survey.errors import ConfigError, SurveyError
from survey.folder.faults import place_of
from survey.folder.local_frame import water_plane
from survey.folder.pose_frames import poses_in_local
from survey.pose_files import read_poses
from survey.settings.config import WaterConfig
from survey.simulate.flight.patterns import Site, plan_flight
from survey.simulate.ground.ground import bed_from_file
from survey.simulate.ground.shapes import TriangleMesh
from survey.simulate.scene_file import CameraSettings, LightSettings, SceneSettings

# A mesh, and colours (V, 3) uint8 of its vertices if it has any.
Bed = tuple[TriangleMesh, np.ndarray | None]
# Height and azimuth of the sun where nothing is given.
_USUAL_SUN_DEG = 57.0, 56.0
# Along each side of the area, where the depth of a bed is taken.
_PROBES = 15


@dataclasses.dataclass(frozen=True)
class ScenePlan:
    """A scene before anything is built: where it lies and how it is flown."""

    settings: SceneSettings
    folder: Path  # To which names of files are relative
    frame: LocalFrame
    level: WaterConfig | None
    lens: Lens
    site: Site
    bed: Bed | None  # Where it comes from a file
    cameras: list[PinholeCamera]


def plan_scene(settings: SceneSettings, folder: Path) -> ScenePlan:
    """The plan of a scene: frame, water, lens, bed from a file, and cameras."""
    crs = parse_crs(settings.crs)
    frame = LocalFrame(crs, settings.origin)
    water = settings.water
    level = None
    if water is not None:
        level = WaterConfig(
            level_m=settings.origin[2] * height_unit_m(crs) if water.level_m is None else water.level_m,
            level_at=settings.origin[:2],
            slope_east=water.slope_east,
            slope_north=water.slope_north,
            refractive_index=water.refractive_index,
        )
    lens = lens_of(settings.camera)
    surface = None if level is None else water_plane(frame, level)
    bed = bed_from_file(folder / settings.bed.file, settings.bed, frame) if settings.bed.file else None
    height = _bed_height(settings, bed)
    level_at_origin = 0.0 if surface is None else float(surface.height(0.0, 0.0))
    site = Site(settings.area.size_m, max(level_at_origin - height, 0.0), surface)
    if settings.flight.poses is None:
        cameras = plan_flight(settings.flight, lens, site, settings.seed)
    else:
        path = folder / settings.flight.poses
        if not path.is_file():
            raise ConfigError(f"flight.poses names {path}, which does not exist; correct the path")
        poses = zip(*poses_in_local(read_poses(path), path, frame, "crs"), strict=True)
        cameras = [lens.pinhole(centre, rotation) for centre, rotation in poses]
    lowest = min(float(camera.centre[2]) for camera in cameras)
    if lowest <= height:
        raise ConfigError(
            f"a camera is {height - lowest:.2f} m under the bed; correct water.level_m or the heights of origin, "
            "bed and flight: they have one vertical datum"
        )
    return ScenePlan(settings, folder, frame, level, lens, site, bed, cameras)


def files_of(settings: SceneSettings) -> list[str]:
    """The files that a scene file names."""
    files = [settings.flight.poses, settings.bed.file, settings.texture.file, *(o.file for o in settings.objects)]
    if settings.water is not None:
        files.append(settings.water.heights)
    return [name for name in files if name]


def inputs_of(settings: SceneSettings, folder: Path) -> dict:
    """All inputs of a scene, as values for JSON: its settings, and a hash of every file that they name."""
    hashes = {}
    for name in files_of(settings):
        path = folder / name
        if not path.is_file():
            raise SurveyError(f"{path} is named in the scene file but does not exist; correct the path")
        hashes[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return dataclasses.asdict(settings) | {"files": hashes}


def sun_of(light: LightSettings, frame: LocalFrame) -> Sun:
    """The sun of [light], seen from the origin of a frame."""
    time = light.known_time
    if time is not None:
        sun = sun_at(time, *place_of(frame.crs, np.array(frame.origin)))
        if sun.elevation <= 0.0:
            raise ConfigError(f"light.time is {light.time}, when the sun is below the horizon here; give a time by day")
        return sun
    elevation = _USUAL_SUN_DEG[0] if light.sun_elevation_deg is None else light.sun_elevation_deg
    azimuth = _USUAL_SUN_DEG[1] if light.sun_azimuth_deg is None else light.sun_azimuth_deg
    return Sun(math.radians(azimuth), math.radians(elevation))


def lens_of(camera: CameraSettings) -> Lens:
    """The lens of [camera]."""
    width, height = camera.size_px
    focal = camera.known_focal_px
    cx, cy = camera.principal_point_px or (0.5 * width, 0.5 * height)
    if camera.model not in MODELS:
        raise ConfigError(f'camera.model is "{camera.model}", expected one of {", ".join(MODELS)}')
    names = MODELS[camera.model][1]
    coefficients = coefficients_of(camera.model)
    if len(camera.distortion) != len(coefficients):
        raise ConfigError(
            f"camera.distortion has {len(camera.distortion)} numbers, expected {len(coefficients)} for "
            f"{camera.model}{': ' + ', '.join(coefficients) if coefficients else ''}"
        )
    values = {"f": focal, "fx": focal, "fy": focal, "cx": cx, "cy": cy}
    values |= dict(zip(coefficients, camera.distortion, strict=True))
    try:
        return Lens(camera.model, tuple(values[name] for name in names), width, height)
    except LensError as error:
        raise ConfigError(f"[camera]: {error}") from error


def _bed_height(settings: SceneSettings, bed: Bed | None) -> float:
    """Mean height [m], local, of the bed in the area."""
    if bed is None:
        return -settings.bed.depth_m
    x, y = np.meshgrid(*(np.linspace(-0.5 * s, 0.5 * s, _PROBES) for s in settings.area.size_m))
    heights = bed[0].height(x, y)
    if not np.isfinite(heights).any():
        raise SurveyError(
            f"{settings.bed.file} has nothing in the area of {settings.area.size_m[0]:g} x "
            f"{settings.area.size_m[1]:g} m about the origin; correct origin, or bed.frame"
        )
    return float(np.nanmean(heights))
