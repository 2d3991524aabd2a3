"""A drawn scene made ready to be photographed."""

from __future__ import annotations

from dataclasses import replace

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera, channel_indices, water_index
from refract.lens import Lens
from survey.simulate.drawn.ground import build_ground
from survey.simulate.drawn.settings import DrawnScene
from survey.simulate.light import Light
from survey.simulate.output.staged_scene import StagedScene
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.render.sun_on_waves import SunOnWaves, suns_of
from survey.simulate.sensor import Sensor
from survey.simulate.water import WaterColour, WaterLevel

# Handbooks state the index of water in the light of sodium.
_STATED_NM = 589.3
# Toward the sun where it glints: 72 degrees over the horizon, so that level views meet its mirror image too.
_HIGH_SUN = (0.27, 0.18, 1.0)
# From the first photograph to the last, where the water moves meanwhile [s].
FLIGHT_S = 3600.0


def stage_drawing(scene: DrawnScene) -> StagedScene:
    """Build the ground of a drawn scene; the origin of its frame lies on the water surface, in the middle."""
    frame = LocalFrame(parse_crs(scene.crs), (*scene.origin, scene.level_m))
    level, water, indices = None, None, None
    if scene.water:
        stated, indices = _indices(scene)
        level = WaterLevel(scene.level_m, scene.origin, scene.slope_east, scene.slope_north, stated)
        water = level.plane(frame) if indices is None else replace(level.plane(frame), n_water=indices[1])
    cameras = tuple(scene.cameras())
    light = Light() if scene.glint_share == 0.0 else Light(to_sun=_HIGH_SUN)
    ground = build_ground(scene, cameras, light)
    width, height = scene.image_px
    (e, n), (wide, deep) = scene.origin, scene.size_m
    return StagedScene(
        name="drawn",
        crs=scene.crs,
        frame=frame,
        cameras=cameras,
        lens=Lens("PINHOLE", (scene.focal_px, scene.focal_px, width / 2, height / 2), width, height),
        level=level,
        renderer=DirectRenderer(ground, water, WaterColour(), indices),
        sensor=Sensor(noise=scene.noise),
        bounds=(e - 0.5 * wide, n - 0.5 * deep, e + 0.5 * wide, n + 0.5 * deep),
        seed=scene.seed,
        velocities=scene.velocities() if scene.speed_m_s > 0.0 else None,
        readout_s=scene.readout_s,
        suns=_suns(scene, cameras, water, light),
        index_wavelength_nm=None if indices is None else _STATED_NM,
        duration_s=FLIGHT_S if scene.rise_m != 0.0 and scene.water else 0.0,
    )


def _indices(scene: DrawnScene) -> tuple[float, tuple[float, float, float] | None]:
    """The index that survey.toml states, and those of red, green and blue; None where all have the stated one."""
    if scene.temperature_c is None:
        return scene.n_water, None
    red, green, blue = (float(n) for n in channel_indices(scene.temperature_c, 0.0))
    return round(float(water_index(_STATED_NM, scene.temperature_c, 0.0)), 6), (red, green, blue)


def _suns(
    scene: DrawnScene, cameras: tuple[PinholeCamera, ...], water: FlatWater | None, light: Light
) -> tuple[SunOnWaves, ...]:
    if water is None or scene.glint_share == scene.caustic_contrast == 0.0:
        return ()
    return suns_of(
        cameras,
        water,
        light,
        seed=scene.seed,
        depth_m=scene.depth_m,
        glint_share=scene.glint_share,
        contrast=scene.caustic_contrast,
    )
