"""A drawn scene made ready to be photographed."""

from __future__ import annotations

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract.lens import Lens
from survey.simulate.drawn.ground import build_ground
from survey.simulate.drawn.settings import DrawnScene
from survey.simulate.light import Light
from survey.simulate.output.staged_scene import StagedScene
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.sensor import Sensor
from survey.simulate.water import WaterLevel
from survey.simulate.watercolour import WaterColour

# From the first photograph to the last, where the water moves meanwhile [s].
FLIGHT_S = 3600.0


def stage_drawing(scene: DrawnScene) -> StagedScene:
    """Build the ground of a drawn scene; the origin of its frame lies on the water surface, in the middle."""
    frame = LocalFrame(parse_crs(scene.crs), (*scene.origin, scene.level_m))
    level = None
    if scene.water:
        level = WaterLevel(scene.level_m, scene.origin, scene.slope_east, scene.slope_north, scene.n_water)
    cameras = tuple(scene.cameras())
    ground = build_ground(scene, cameras, Light())
    width, height = scene.image_px
    (e, n), (wide, deep) = scene.origin, scene.size_m
    return StagedScene(
        name="drawn",
        crs=scene.crs,
        frame=frame,
        cameras=cameras,
        lens=Lens("PINHOLE", (scene.focal_px, scene.focal_px, width / 2, height / 2), width, height),
        level=level,
        renderer=DirectRenderer(ground, level.plane(frame) if level else None, WaterColour()),
        sensor=Sensor(noise=scene.noise),
        bounds=(e - 0.5 * wide, n - 0.5 * deep, e + 0.5 * wide, n + 0.5 * deep),
        seed=scene.seed,
        velocities=scene.velocities() if scene.speed_m_s > 0.0 else None,
        readout_s=scene.readout_s,
        duration_s=FLIGHT_S if scene.rise_m != 0.0 and scene.water else 0.0,
    )
