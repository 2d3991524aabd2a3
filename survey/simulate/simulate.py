"""`bathynerf simulate`: a survey folder rendered from a scene file, or the plan of its flight.

`stage_scene` builds the planned scene: bed, bodies, water and light.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo import write_whole
from geo.crs import height_unit_m, parse_crs
from geo.frames import LocalFrame
from geo.sun import Sun, sun_at
from refract import PinholeCamera
from refract.lens import MODELS, Lens, LensError, coefficients_of
from refract.surfaces import WaterSurface
from survey.errors import ConfigError, OutputError, SurveyError
from survey.files.paths import ReadFiles, require_folder
from survey.folder.heights import place_of
from survey.folder.local_frame import poses_in_local, water_plane
from survey.machine import require_memory
from survey.pose_files import read_poses
from survey.progress import current
from survey.settings.config import WaterConfig
from survey.simulate.conditions import Light, Sensor, WaterOptics, measured_surface, with_waves
from survey.simulate.direct import DirectRenderer
from survey.simulate.drawn import DrawnScene, build_ground
from survey.simulate.flight import Site, plan_flight, views_of_bed
from survey.simulate.ground import (
    Ground,
    Material,
    bed_from_file,
    place_object,
    plane,
    require_texels,
    seen_area,
    shade_of_normals,
    texture_of_bed,
)
from survey.simulate.mitsuba_scene import load_mitsuba, solid_scene, water_scene
from survey.simulate.scene_file import CameraSettings, LightSettings, SceneSettings, read_scene
from survey.simulate.shapes import BedGrid, TriangleMesh
from survey.simulate.sidecars import StagedScene, cameras_csv
from survey.simulate.writing import write_survey

if TYPE_CHECKING:
    from survey.simulate.path_tracer import PathTracer

# What --flight-only writes.
_FLIGHT = "cameras.csv"
# Rays per pixel of the mode without noise: a regular grid of 2 x 2.
_DIRECT_SAMPLES = 4
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
    paths = {name: folder / name for name in files_of(settings)}
    if missing := next((path for path in paths.values() if not path.is_file()), None):
        raise SurveyError(f"{missing} is named in the scene file but does not exist; correct the path")
    hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in paths.items()}
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
    focal, (cx, cy) = camera.known_focal_px, camera.principal_point_px or (0.5 * width, 0.5 * height)
    if camera.model not in MODELS:
        raise ConfigError(f'camera.model is "{camera.model}", expected one of {", ".join(MODELS)}')
    coefficients = coefficients_of(camera.model)
    if len(camera.distortion) != len(coefficients):
        raise ConfigError(
            f"camera.distortion has {len(camera.distortion)} numbers, expected {len(coefficients)} for "
            f"{camera.model}{': ' + ', '.join(coefficients) if coefficients else ''}"
        )
    values = {"f": focal, "fx": focal, "fy": focal, "cx": cx, "cy": cy}
    values |= dict(zip(coefficients, camera.distortion, strict=True))
    try:
        return Lens(camera.model, tuple(values[name] for name in MODELS[camera.model][1]), width, height)
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


def simulate(
    path: str | Path, output: str | Path, *, mode: str | None = None, preview: bool = False, again: bool = False
) -> None:
    """Photograph the scene of a file into a survey folder.

    Parameters
    ----------
    path : Path
        Scene file; names of files in it are relative to its folder.
    output : Path
        See `survey.simulate.writing.write_survey`.
    mode : "direct" or "physical", optional
        Instead of that of the scene file.
    preview : bool
        One ray per pixel, which is noisy.
    again : bool
        Start again even if the same survey, or a part of it, is there.
    """
    require_memory()
    path, output = Path(path), Path(output)
    settings = read_scene(path)
    samples = 1 if preview else settings.render.samples
    render = dataclasses.replace(settings.render, mode=mode or settings.render.mode, samples=samples)
    settings = dataclasses.replace(settings, render=render)
    plan = _planned(path, output, settings, is_flight=False)
    inputs = inputs_of(settings, path.parent)
    write_survey(output, inputs, lambda: stage_scene(plan), again=again, progress=current())


def simulate_flight(path: str | Path, output: str | Path) -> None:
    """Write the flight of a scene file, cameras.csv, and say what it sees of the bed."""
    output, settings = Path(output), read_scene(Path(path))
    plan = _planned(Path(path), output, settings)
    output.mkdir(parents=True, exist_ok=True)
    names = [f"{k:04d}.jpg" for k in range(len(plan.cameras))]
    with write_whole(output / _FLIGHT) as stream:
        stream.write(cameras_csv(names, plan.cameras, plan.frame).encode("utf-8"))


def _planned(path: Path, output: Path, settings: SceneSettings, *, is_flight: bool = True) -> ScenePlan:
    """The plan of a scene, which is reported with its coverage; raises where the output cannot be written."""
    require_folder("-o", output, ReadFiles.of(path, *(path.parent / name for name in files_of(settings))))
    # A table of cameras that is there may be of a survey.
    there = sorted(entry.name for entry in output.iterdir() if entry.name[0] != ".") if output.is_dir() else []
    if is_flight and there:
        raise OutputError(f"-o names {output}, which has {there[0]}; name a new or empty folder")
    plan = plan_scene(settings, path.parent)
    num_views = views_of_bed(plan.cameras, plan.site)
    height = sum(float(camera.centre[2]) - plan.site.level for camera in plan.cameras) / len(plan.cameras)
    gsd_cm = 100.0 * (height + plan.site.apparent_depth) / plan.lens.focal[0]
    current().note(
        f"{len(plan.cameras)} photographs from {height:.1f} m, GSD {gsd_cm:.1f} cm on the bed, each point of it in "
        f"{num_views.min()} to {num_views.max()} of them"
    )
    if unseen := float((num_views < 3).mean()):
        current().warn(
            f"{100.0 * unseen:.0f} % of the area is seen by fewer than three photographs; give more "
            "overlap, or a smaller area"
        )
    return plan


def stage_scene(plan: ScenePlan) -> StagedScene:
    """Build the planned scene, ready to be photographed."""
    settings, given, still = plan.settings, plan.settings.water, plan.site.water
    light, direct = light_of(settings.light, plan.frame), settings.render.mode == "direct"
    # Flight planning approximates the surface of the water by a plane.
    surface: WaterSurface | None = still
    if given is not None and given.heights is not None:
        surface = measured_surface(plan.folder / given.heights, plan.frame, given.refractive_index)
    elif given is not None and given.waves and still is not None:
        surface = with_waves(still, given.waves)
    colour = WaterOptics() if given is None else WaterOptics(given.absorption, given.scattering, given.asymmetry)
    renderer = DirectRenderer(_ground(plan, light), surface, colour)
    (e, n), (wide, deep) = settings.origin[:2], settings.area.size_m
    return StagedScene(
        name=settings.name,
        crs=settings.crs,
        frame=plan.frame,
        cameras=tuple(plan.cameras),
        lens=plan.lens,
        level=plan.level,
        renderer=renderer,
        sensor=Sensor(
            **vars(settings.sensor) | {"blur_m": settings.blur_m, "shutter_s": None},
            samples=_DIRECT_SAMPLES if direct else settings.render.samples,
            is_jittered=not direct,
        ),
        bounds=(e - 0.5 * wide, n - 0.5 * deep, e + 0.5 * wide, n + 0.5 * deep),
        seed=settings.seed,
        position_std_m=settings.flight.position_std_m,
        radiance_of=None if direct else _path_tracer(plan, renderer, light),
    )


def _path_tracer(plan: ScenePlan, renderer: DirectRenderer, light: Light) -> PathTracer:
    mi = load_mitsuba()
    # Only now: it takes Mitsuba's Dr.Jit to be there.
    from survey.simulate.path_tracer import PathTracer, Sunlight

    water, mean = renderer.water, plan.site.water
    plane = None if mean is None else (np.array(mean.point), np.array(mean.up), float(mean.n_water))
    surface = None if water is None else water_scene(mi, water, renderer.ground)
    pixel = 1.0 / plan.lens.focal[0]
    sun = Sunlight(mi, solid_scene(mi, renderer.ground), plane, colour=renderer.colour, light=light, pixel=pixel)
    return PathTracer(surface, sun, max_bounces=plan.settings.render.max_bounces)


def light_of(light: LightSettings, frame: LocalFrame) -> Light:
    """The light of [light] at the origin of a frame; errors as those of `sun_of`."""
    east, north, up = sun_of(light, frame).direction.tolist()
    sun_radius = math.radians(0.5 * light.sun_diameter_deg)
    return Light((east, north, up), light.sun_share, sun_radius, light.sky == "overcast")


def _ground(plan: ScenePlan, light: Light) -> Ground:
    ground = _drawn(plan, light) if plan.settings.bed.kind == "drawn" else _bed(plan, light)
    bodies = [place_object(given, plan.folder, ground.bed, light) for given in plan.settings.objects]
    solids, materials = [body for body, _ in bodies], [material for _, material in bodies]
    return Ground(ground.bed, (*ground.solids, *solids), (*ground.materials, *materials))


def _drawn(plan: ScenePlan, light: Light) -> Ground:
    """A drawn bed with its bodies, in the requested texture."""
    settings, bed, texture = plan.settings, plan.settings.bed, plan.settings.texture
    area = seen_area(plan.cameras, settings.area.size_m, -1.5 * bed.depth_m)
    require_texels("texture.texel_m", texture.texel_m, area)
    require_texels("bed.cell_m", bed.cell_m, area, "cells")
    drawn = DrawnScene(
        size_m=settings.area.size_m,
        depth_m=bed.depth_m,
        shore=bed.shore,
        objects=bed.bodies,
        seed=settings.seed,
        # The cameras are those of the plan; a drawn scene needs a height of its own that fits its depth.
        flying_m=2.0 * bed.depth_m,
        cell_m=bed.cell_m,
        texel_m=texture.texel_m,
    )
    ground = build_ground(drawn, plan.cameras, light)
    if texture.kind == "sand":
        return ground
    draped = texture_of_bed(texture, plan.folder, ground.bed, None, area, settings.seed)
    return Ground(ground.bed, ground.solids, (Material(draped, ground.materials[0].shade), *ground.materials[1:]))


def _bed(plan: ScenePlan, light: Light) -> Ground:
    """A bed that is a plane, or comes from a file."""
    settings = plan.settings
    shape: BedGrid | TriangleMesh
    if plan.bed is None:
        area = seen_area(plan.cameras, settings.area.size_m, -1.5 * settings.bed.depth_m)
        shape, rgb, normals = plane(area, -settings.bed.depth_m), None, np.array([[0.0, 0.0, 1.0]])
    else:
        mesh, rgb = plan.bed
        shape, normals = mesh, mesh.normals
        (west, south, _), (east, north, _) = mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()
        area = (west, south, east, north)
    texture = texture_of_bed(settings.texture, plan.folder, shape, rgb, area, settings.seed)
    return Ground(shape, (), (Material(texture, shade_of_normals(normals, light)),))
