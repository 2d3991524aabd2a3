"""The sun on waves in drawn surveys: as strong as asked for, other waves in each photograph, the truth as it was."""

import numpy as np
import pytest
from condition_scenes import caustics, glitter
from sun_on_waves import HIGH_SUN, SunOnWaves, suns_of

from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.simulate.conditions import Light
from survey.simulate.drawn import DrawnScene, stage_drawing

PLANE = FlatWater((0.0, 0.0, 0.0), n_water=1.33)
DEPTH, CONTRAST, SHARE = 1.2, 0.3, 0.1


def _suns() -> list[SunOnWaves]:
    down = np.diag([1.0, -1.0, -1.0])
    cameras = [PinholeCamera(np.array([x, 0.0, 10.0]), down, 300.0, 300.0, 80.0, 60.0, 160, 120) for x in (0.0, 1.0)]
    suns = suns_of(cameras, PLANE, Light(to_sun=(0.1, 0.0, 1.0)), seed=3, glint_share=0.0)
    return [sun.with_caustics(DEPTH, CONTRAST) for sun in suns]


def _light_on_bed(sun: SunOnWaves, depth: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.0, 7.68, 0.03), np.arange(0.0, 7.68, 0.03))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -depth)], axis=-1)
    return sun.on_bed(points, np.full(x.size, depth))


def test_waves_focus_light_on_the_bed_with_the_asked_contrast_and_take_none_away():
    sun = _suns()[0]
    light = _light_on_bed(sun, DEPTH)
    assert light.mean() == pytest.approx(1.0, abs=0.01)
    # Between two layers the pattern is weaker; the darkest light is the sky's.
    assert light.std() == pytest.approx(CONTRAST, rel=0.1)
    assert _light_on_bed(sun, 0.05).std() < 0.5 * CONTRAST


def test_each_photograph_has_a_net_of_its_own():
    first, second = (_light_on_bed(sun, DEPTH) for sun in _suns())
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.1


def test_the_glint_of_ripples_has_the_flux_of_a_mirror():
    # All ways to a camera that ripples of 0.02 mirror the sun into, weighted by their solid angle.
    still, ripples = np.zeros((2, 8, 8)), 0.02
    light = Light(to_sun=(0.3, 0.0, 1.0))
    sun = SunOnWaves(PLANE, light, still, ripples, still[:0], 1.0, 1.0)
    step = 0.002
    mirror = light.sun * (-1.0, -1.0, 1.0)
    x, y = np.meshgrid(np.arange(-0.3, 0.3, step) + mirror[0], np.arange(-0.3, 0.3, step) + mirror[1])
    z = np.sqrt(1.0 - x**2 - y**2)
    to_camera = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    radiance = sun.reflected(10.0 * to_camera, -to_camera)
    # cos(view) d(solid angle) is the area in the plane of x and y.
    flux = radiance.sum() * step**2
    cosine = light.sun[2]
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / 1.33**2)
    across, along = (
        (cosine - 1.33 * inside) / (cosine + 1.33 * inside),
        (1.33 * cosine - inside) / (1.33 * cosine + inside),
    )
    mirrored = 0.5 * (across**2 + along**2)
    assert flux == pytest.approx(mirrored * light.sun_irradiance * cosine, rel=0.01)


def test_a_sun_that_waves_cannot_mirror_into_the_photographs_is_refused():
    down = PinholeCamera(np.array([0.0, 0.0, 10.0]), np.diag([1.0, -1.0, -1.0]), 3e3, 3e3, 80.0, 60.0, 160, 120)
    low = Light(to_sun=(1.0, 0.0, 0.1))
    with pytest.raises(SurveyError, match="give a smaller share"):
        suns_of([down], PLANE, low, seed=1, glint_share=0.1)


def test_a_scene_with_glint_saturates_the_asked_share_and_one_with_caustics_keeps_its_light():
    scene = stage_drawing(DrawnScene.tiny(to_sun=HIGH_SUN))
    lit = glitter(scene, SHARE)
    photographs = [lit.photograph(index) for index in range(len(scene.cameras))]
    # The sun alone is asked to saturate; with the light of the bed under it more does.
    assert SHARE < np.mean([(image.min(axis=2) == 255).mean() for image in photographs]) < 1.5 * SHARE
    still, focused = (each.photograph(3).astype(float) for each in (scene, caustics(scene, CONTRAST)))
    assert (still != focused).any(axis=2).mean() > 0.9
    assert focused.mean() == pytest.approx(still.mean(), rel=0.05)


def test_blue_is_drawn_with_the_rays_of_blue_and_the_truth_with_those_of_green(rng):
    scene = stage_drawing(DrawnScene.tiny(temperature_c=15.0))
    eye, camera = scene.renderer, scene.cameras[5]
    pixels = rng.uniform(5.0, 115.0, (300, 2))
    seen = eye.radiance(camera, pixels)
    of_blue = stage_drawing(DrawnScene.tiny(n_water=eye.indices[2])).renderer
    np.testing.assert_array_equal(seen[:, 2], of_blue.radiance(camera, pixels)[:, 2])
    assert not np.allclose(seen[:, 2], of_blue.radiance(camera, pixels)[:, 1])
    assert eye.water.n_water == eye.indices[1]
    assert scene.index_wavelength_nm == 589.3
    # The sodium line in water of 15 degrees (CRC Handbook of Chemistry and Physics).
    assert scene.level.refractive_index == pytest.approx(1.33339, abs=1e-5)
