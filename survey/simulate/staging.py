"""From a scene file to a scene: cameras flown, bed and bodies set, water poured, light switched on."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from refract.surfaces import WaterSurface
from survey.cameras import MODELS, Lens
from survey.drawn.ground import build_ground
from survey.drawn.scene import DrawnScene
from survey.errors import ConfigError, PosesError, SurveyError
from survey.flight import plan_flight
from survey.flight.patterns import Site
from survey.simulate import bed as beds
from survey.simulate.extent import seen_area
from survey.simulate.ground import Ground, Look, shade_of_normals
from survey.simulate.light import Light
from survey.simulate.mitsuba_scene import load_mitsuba, solid_scene, water_scene
from survey.simulate.objects import place_object
from survey.simulate.render_direct import DirectRenderer
from survey.simulate.scene import Scene
from survey.simulate.scene_file import CameraSettings, LightSettings, SceneSettings
from survey.simulate.sensor import Sensor
from survey.simulate.texture import skin_of_bed
from survey.simulate.triangles import TriangleMesh
from survey.simulate.water import WaterLevel, measured, with_waves
from survey.simulate.watercolour import WaterColour

if TYPE_CHECKING:
    from survey.simulate.path_tracer import PathTracer

# Rays per pixel of the mode without noise: a regular grid of 2 x 2.
_DIRECT_SAMPLES = 4
# Along each side of the area, where the depth of a bed is taken.
_PROBES = 15


# A mesh, and colours (V, 3) uint8 of its vertices if it has any.
Bed = tuple[TriangleMesh, np.ndarray | None]


@dataclasses.dataclass(frozen=True)
class Plan:
    """A scene before anything is built: where it lies and how it is flown.

    Attributes
    ----------
    settings : SceneSettings
    folder : Path
        To which names of files are relative.
    frame : LocalFrame
    level : WaterLevel or None
    lens : Lens
    site : Site
    bed : Bed or None
        Where it comes from a file.
    cameras : list of PinholeCamera
    """

    settings: SceneSettings
    folder: Path
    frame: LocalFrame
    level: WaterLevel | None
    lens: Lens
    site: Site
    bed: Bed | None
    cameras: list[PinholeCamera]


def plan_scene(settings: SceneSettings, folder: Path) -> Plan:
    """Place a scene on Earth and fly over it.

    Raises
    ------
    SurveyError, GeoError
        If the crs has no heights, the lens is none, or no flight covers the area.
    """
    crs = parse_crs(settings.crs)
    frame = LocalFrame(crs, settings.origin)
    water = settings.water
    level = None
    if water is not None:
        height = settings.origin[2] if water.level_m is None else water.level_m
        level = WaterLevel(
            height, settings.origin[:2], water.slope_east, water.slope_north, refractive_index=water.refractive_index
        )
    lens = lens_of(settings.camera)
    surface = level.plane(frame) if level else None
    bed = beds.bed_from_file(settings.bed, folder, frame) if settings.bed.file else None
    site = Site(settings.area.size_m, _depth(settings, surface, bed), surface)
    cameras = plan_flight(settings.flight, lens, site, settings.seed)
    return Plan(settings, folder, frame, level, lens, site, bed, cameras)


def stage_scene(plan: Plan) -> Scene:
    """Build what was planned, ready to be photographed."""
    settings = plan.settings
    light = light_of(settings.light)
    ground = _ground(plan, light)
    direct = settings.render.mode == "direct"
    colour = WaterColour()
    if settings.water is not None:
        colour = WaterColour(settings.water.absorption, settings.water.scattering, settings.water.asymmetry)
    sensor = settings.sensor
    e, n = settings.origin[:2]
    wide, deep = settings.area.size_m
    renderer = DirectRenderer(ground, _surface(plan), colour)
    return Scene(
        name=settings.name,
        crs=settings.crs,
        frame=plan.frame,
        cameras=tuple(plan.cameras),
        lens=plan.lens,
        level=plan.level,
        renderer=renderer,
        sensor=Sensor(
            samples=_DIRECT_SAMPLES if direct else settings.render.samples,
            by_chance=not direct,
            noise=sensor.noise,
            photons_at_white=sensor.photons_at_white,
            exposure=sensor.exposure,
            drift=sensor.exposure_drift,
            blur_m=sensor.blur_m,
        ),
        bounds=(e - 0.5 * wide, n - 0.5 * deep, e + 0.5 * wide, n + 0.5 * deep),
        seed=settings.seed,
        eye=None if direct else _path_tracer(plan, renderer, light),
    )


def _surface(plan: Plan) -> WaterSurface | None:
    """The surface of the water, which the flight takes for a plane."""
    water, plane = plan.settings.water, plan.site.water
    if water is None:
        return None
    if water.heights is not None:
        return measured(plan.folder / water.heights, plan.frame, water.refractive_index)
    return with_waves(plane, water.waves) if water.waves else plane


def _path_tracer(plan: Plan, renderer: DirectRenderer, light: Light) -> PathTracer:
    mi = load_mitsuba()
    # Only now: it takes Mitsuba's Dr.Jit to be there.
    from survey.simulate.path_tracer import PathTracer

    water, mean = renderer.water, plan.site.water
    return PathTracer(
        mi,
        solid_scene(mi, renderer.ground),
        None if water is None else water_scene(mi, water, renderer.ground),
        None if mean is None else (np.array(mean.point), np.array(mean.up), float(mean.n_water)),
        colour=renderer.colour,
        light=light,
        max_bounces=plan.settings.render.max_bounces,
    )


def marks_of(settings: SceneSettings, folder: Path) -> dict:
    """All that a scene is made of, as JSON can hold it: its settings, and a hash of every file that they name."""
    files = [settings.bed.file, settings.texture.file, *(o.file for o in settings.objects)]
    if settings.water is not None:
        files.append(settings.water.heights)
    hashes = {}
    for name in filter(None, files):
        path = folder / name
        if not path.is_file():
            raise SurveyError(f"{path} is named in the scene file but does not exist; correct the path")
        hashes[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return dataclasses.asdict(settings) | {"files": hashes}


def lens_of(camera: CameraSettings) -> Lens:
    """The lens of [camera]."""
    width, height = camera.size_px
    focal = camera.focal_px or camera.focal_mm / camera.sensor_mm * width
    cx, cy = camera.principal_point_px or (0.5 * width, 0.5 * height)
    if camera.model not in MODELS:
        raise ConfigError(f'camera.model is "{camera.model}", expected one of {", ".join(MODELS)}')
    names = MODELS[camera.model][1]
    coefficients = [name for name in names if name[0] in "kp"]
    if len(camera.distortion) != len(coefficients):
        raise ConfigError(
            f"camera.distortion has {len(camera.distortion)} numbers, expected {len(coefficients)} for "
            f"{camera.model}{': ' + ', '.join(coefficients) if coefficients else ''}"
        )
    values = {"f": focal, "fx": focal, "fy": focal, "cx": cx, "cy": cy}
    values |= dict(zip(coefficients, camera.distortion, strict=True))
    try:
        return Lens(camera.model, tuple(values[name] for name in names), width, height)
    except PosesError as error:
        raise ConfigError(f"[camera]: {error}") from error


def light_of(light: LightSettings) -> Light:
    """The light of [light]."""
    elevation, azimuth = math.radians(light.sun_elevation_deg), math.radians(light.sun_azimuth_deg)
    level = math.cos(elevation)
    to_sun = (level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation))
    return Light(to_sun, light.sun_share, math.radians(0.5 * light.sun_diameter_deg), light.sky == "overcast")


def _depth(
    settings: SceneSettings, water: FlatWater | None, bed: tuple[TriangleMesh, np.ndarray | None] | None
) -> float:
    """Mean depth [m] of the bed in the area, for the flight; it counts from the origin where there is no water."""
    z = -settings.bed.depth_m
    if bed is not None:
        x, y = np.meshgrid(*(np.linspace(-0.5 * s, 0.5 * s, _PROBES) for s in settings.area.size_m))
        heights = bed[0].height(x, y)
        if not np.isfinite(heights).any():
            raise SurveyError(
                f"{settings.bed.file} has nothing in the area of {settings.area.size_m[0]:g} x "
                f"{settings.area.size_m[1]:g} m about the origin; correct origin, or bed.frame"
            )
        z = float(np.nanmean(heights))
    level = 0.0 if water is None else float(water.height(0.0, 0.0))
    return max(level - z, 0.0)


def _ground(plan: Plan, light: Light) -> Ground:
    settings, bed = plan.settings, plan.settings.bed
    if bed.kind == "drawn":
        drawn = DrawnScene(
            size_m=settings.area.size_m,
            depth_m=bed.depth_m,
            shore=bed.shore,
            objects=bed.bodies,
            seed=settings.seed,
            flying_m=max(2.0 * bed.depth_m, 1.0),
        )
        ground = build_ground(drawn, plan.cameras, light)
        shape, solids, looks = ground.bed, list(ground.solids), list(ground.looks)
        if settings.texture.kind != "sand":
            area = (shape.west, shape.south, *(shape.vertices()[-1, -1, :2]))
            skin = skin_of_bed(settings.texture, plan.folder, shape, None, area, settings.seed)
            looks[0] = Look(skin, looks[0].shade)
    else:
        shape, looks = _bed(plan, plan.cameras, light)
        solids = []
    for settings_of_one in settings.objects:
        body, look = place_object(settings_of_one, plan.folder, shape, light)
        solids.append(body)
        looks.append(look)
    return Ground(shape, tuple(solids), tuple(looks))


def _bed(plan: Plan, cameras: Sequence[PinholeCamera], light: Light):
    settings = plan.settings
    if settings.bed.kind == "plane":
        area = seen_area(cameras, settings.area.size_m, -1.5 * settings.bed.depth_m)
        shape, rgb = beds.plane(area, -settings.bed.depth_m), None
        normals = np.array([[0.0, 0.0, 1.0]])
    else:
        shape, rgb = plan.bed
        normals = shape.normals
        low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
        area = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    skin = skin_of_bed(settings.texture, plan.folder, shape, rgb, area, settings.seed)
    return shape, [Look(skin, shade_of_normals(normals, light))]
