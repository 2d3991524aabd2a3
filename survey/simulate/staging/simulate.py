"""`bathynerf simulate`: a survey folder rendered from a scene file, or the plan of its flight.

`stage_scene` builds the planned scene: bed, bodies, water and light.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo import write_whole
from geo.frames import LocalFrame
from refract.surfaces import WaterSurface
from survey.errors import OutputError
from survey.files.outputs import ReadFiles, require_folder
from survey.progress import current
from survey.simulate.drawn.ground import build_ground
from survey.simulate.drawn.settings import DrawnScene
from survey.simulate.flight.coverage import BedCoverage, coverage, draw_flight
from survey.simulate.ground.ground import (
    Ground,
    Material,
    place_object,
    plane,
    require_texels,
    seen_area,
    shade_of_normals,
    texture_of_bed,
)
from survey.simulate.ground.shapes import BedGrid, TriangleMesh
from survey.simulate.light import Light
from survey.simulate.output.sidecars import StagedScene, cameras_csv
from survey.simulate.output.writing import write_survey
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.render.mitsuba_scene import load_mitsuba, solid_scene, water_scene
from survey.simulate.scene_file import LightSettings, SceneSettings, read_scene
from survey.simulate.sensor import Sensor
from survey.simulate.staging.planning import ScenePlan, files_of, inputs_of, plan_scene, sun_of
from survey.simulate.water import WaterOptics, measured_surface, with_waves

if TYPE_CHECKING:
    from survey.simulate.render.path_tracer import PathTracer

# What --flight-only writes.
_FLIGHT = ("cameras.csv", "flight.png")
# Rays per pixel of the mode without noise: a regular grid of 2 x 2.
_DIRECT_SAMPLES = 4


def simulate(
    path: str | Path, output: str | Path, *, mode: str | None = None, preview: bool = False, again: bool = False
) -> None:
    """Photograph the scene of a file into a survey folder.

    Parameters
    ----------
    path : Path
        Scene file; names of files in it are relative to its folder.
    output : Path
        See `survey.simulate.output.writing.write_survey`.
    mode : "direct" or "physical", optional
        Instead of that of the scene file.
    preview : bool
        One ray per pixel, which is noisy.
    again : bool
        Start again even if the same survey, or a part of it, is there.
    """
    path, output = Path(path), Path(output)
    settings = read_scene(path)
    samples = 1 if preview else settings.render.samples
    render = dataclasses.replace(settings.render, mode=mode or settings.render.mode, samples=samples)
    settings = dataclasses.replace(settings, render=render)
    _require_output(output, path, settings)
    plan = plan_scene(settings, path.parent)
    _say_of(plan, coverage(plan.cameras, plan.site))
    inputs = inputs_of(settings, path.parent)
    write_survey(output, inputs, lambda: stage_scene(plan), again=again, progress=current())


def simulate_flight(path: str | Path, output: str | Path) -> None:
    """Write the flight of a scene file: cameras.csv, and flight.png with what it sees of the bed."""
    path, output = Path(path), Path(output)
    settings = read_scene(path)
    _require_output(output, path, settings)
    # A folder may have an earlier flight, and e.g. not the cameras.csv of a survey.
    there = {entry.name for entry in output.iterdir() if entry.name[0] != "."} if output.is_dir() else set()
    if there and there != set(_FLIGHT):
        other = min(there - set(_FLIGHT), default=min(there))
        raise OutputError(
            f"-o names {output}, which has {other} and is not a flight of --flight-only; name a new or empty folder"
        )
    plan = plan_scene(settings, path.parent)
    cover = coverage(plan.cameras, plan.site)
    _say_of(plan, cover)
    output.mkdir(parents=True, exist_ok=True)
    names = [f"{k:04d}.jpg" for k in range(len(plan.cameras))]
    table, drawing = (output / name for name in _FLIGHT)
    with write_whole(table) as stream:
        stream.write(cameras_csv(names, plan.cameras, plan.frame).encode("utf-8"))
    draw_flight(drawing, plan.cameras, cover, plan.site)


def _require_output(output: Path, path: Path, settings: SceneSettings) -> None:
    named = (path.parent / name for name in files_of(settings))
    require_folder("-o", output, ReadFiles.of(path, *named))


def _say_of(plan: ScenePlan, cover: BedCoverage) -> None:
    """Report GSD, number of views, and warnings."""
    heights = [float(camera.centre[2]) - plan.site.level for camera in plan.cameras]
    height, focal = sum(heights) / len(heights), plan.lens.focal[0]
    gsd_cm = 100.0 * (height + plan.site.apparent_depth) / focal
    progress = current()
    progress.note(
        f"{len(plan.cameras)} photographs from {height:.1f} m, GSD {gsd_cm:.1f} cm on the bed, each point of it in "
        f"{cover.num_views.min()} to {cover.num_views.max()} of them"
    )
    if cover.unseen_share > 0.0:
        progress.warn(
            f"{100.0 * cover.unseen_share:.0f} % of the area is seen by fewer than three photographs; give more "
            "overlap, or a smaller area"
        )


def stage_scene(plan: ScenePlan) -> StagedScene:
    """Build the planned scene, ready to be photographed."""
    settings = plan.settings
    light = light_of(settings.light, plan.frame)
    ground = _ground(plan, light)
    direct = settings.render.mode == "direct"
    colour = WaterOptics()
    if settings.water is not None:
        colour = WaterOptics(settings.water.absorption, settings.water.scattering, settings.water.asymmetry)
    e, n = settings.origin[:2]
    wide, deep = settings.area.size_m
    renderer = DirectRenderer(ground, _surface(plan), colour)
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


def _surface(plan: ScenePlan) -> WaterSurface | None:
    """The surface of the water, which flight planning approximates by a plane."""
    water, plane = plan.settings.water, plan.site.water
    if water is None or plane is None:
        return None
    if water.heights is not None:
        return measured_surface(plan.folder / water.heights, plan.frame, water.refractive_index)
    return with_waves(plane, water.waves) if water.waves else plane


def _path_tracer(plan: ScenePlan, renderer: DirectRenderer, light: Light) -> PathTracer:
    mi = load_mitsuba()
    # Only now: it takes Mitsuba's Dr.Jit to be there.
    from survey.simulate.render.path_tracer import PathTracer, Sunlight

    water, mean = renderer.water, plan.site.water
    plane = None if mean is None else (np.array(mean.point), np.array(mean.up), float(mean.n_water))
    surface = None if water is None else water_scene(mi, water, renderer.ground)
    pixel = 1.0 / plan.lens.focal[0]
    sun = Sunlight(mi, solid_scene(mi, renderer.ground), plane, colour=renderer.colour, light=light, pixel=pixel)
    return PathTracer(surface, sun, max_bounces=plan.settings.render.max_bounces)


def light_of(light: LightSettings, frame: LocalFrame) -> Light:
    """The light of [light] at the origin of a frame; errors as those of `sun_of`."""
    sun = sun_of(light, frame)
    east, north, up = sun.direction.tolist()
    to_sun = (east, north, up)
    return Light(to_sun, light.sun_share, math.radians(0.5 * light.sun_diameter_deg), light.sky == "overcast")


def _ground(plan: ScenePlan, light: Light) -> Ground:
    settings = plan.settings
    if settings.bed.kind == "drawn":
        ground = _drawn(plan, light)
        shape, solids, materials = ground.bed, list(ground.solids), list(ground.materials)
    else:
        shape, material = _bed(plan, light)
        solids, materials = [], [material]
    for given in settings.objects:
        body, material = place_object(given, plan.folder, shape, light)
        solids.append(body)
        materials.append(material)
    return Ground(shape, tuple(solids), tuple(materials))


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


def _bed(plan: ScenePlan, light: Light) -> tuple[BedGrid | TriangleMesh, Material]:
    """A bed that is a plane, or comes from a file."""
    settings = plan.settings
    shape: BedGrid | TriangleMesh
    if plan.bed is None:
        area = seen_area(plan.cameras, settings.area.size_m, -1.5 * settings.bed.depth_m)
        shape, rgb, normals = plane(area, -settings.bed.depth_m), None, np.array([[0.0, 0.0, 1.0]])
    else:
        mesh, rgb = plan.bed
        shape, normals = mesh, mesh.normals
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        area = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    texture = texture_of_bed(settings.texture, plan.folder, shape, rgb, area, settings.seed)
    return shape, Material(texture, shade_of_normals(normals, light))
