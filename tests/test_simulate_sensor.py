"""Photographs of a scene: distortion of the lens, noise, exposure and blur of the sensor, light of the sky."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from scene_files import scene_file, staged

from survey.folder.survey import load_survey
from survey.photos.images import load_image
from survey.simulate.conditions import Light, Sensor
from survey.simulate.simulate import simulate


@pytest.mark.slow
def test_a_distorted_photograph_rectified_is_the_one_that_a_pinhole_takes(tmp_path):
    lens = "focal_px = 160.0\n" + 'model = "OPENCV"\ndistortion = [-0.3, 0.01, 1e-3, -1e-3]'
    smooth = {
        "texel_m": "texel_m = 0.08",
        "size_px": "size_px = [192, 144]",
        "forward_overlap": "forward_overlap = 0.3",
    }
    simulate(scene_file(tmp_path, focal_px=lens.replace("160", "320"), **smooth), tmp_path / "bent")
    simulate(scene_file(tmp_path, focal_px="focal_px = 320.0", **smooth), tmp_path / "straight")
    bent, straight = load_survey(tmp_path / "bent"), load_survey(tmp_path / "straight")
    assert bent.views[1].lens.model == "OPENCV"
    camera, pinhole = (survey.views[1].camera for survey in (bent, straight))
    points = pinhole.paths(pinhole.pixel_centres(), None).at_height(np.array(-1.0), None)
    u, v = (camera.project(points, None) - 0.5).astype(np.float32).transpose(2, 0, 1)
    raw, b = (load_image(survey.views[1]).astype(float) for survey in (bent, straight))
    a = cv2.remap(raw, u, v, cv2.INTER_LANCZOS4)
    a, b, raw = (image[12:-12, 12:-12] for image in (a, b, raw))
    # Resampling rounds grey levels; without rectifying, edges of the paint are pixels apart.
    assert np.abs(a - b).mean() < 1.0
    assert np.abs(raw - b).mean() > 3.0 * np.abs(a - b).mean()


def grey_eye(value):
    return lambda origin, direction, seed: np.full((len(direction), 3), value)


def test_noise_of_counting_grows_with_light_and_exposure_drifts_from_image_to_image(tmp_path):
    scene = staged(scene_file(tmp_path))
    camera, lens = scene.cameras[0], scene.lens
    counted = Sensor(photons_at_white=500.0)
    for value in (0.1, 0.5):
        image = counted.photograph(grey_eye(value), camera, lens, (1, 0)) / 255.0
        # Twice the counting error of a standard deviation over 20 736 values.
        assert (image**2.2).std() == pytest.approx(math.sqrt(value / 500.0), rel=0.03)
    drifting = Sensor(exposure_drift=0.05)
    means = [drifting.photograph(grey_eye(0.3), camera, lens, (1, k)).mean() for k in range(12)]
    steps = np.diff(2.2 * np.log(means))
    assert 0.02 < steps.std() < 0.1
    assert Sensor(exposure=2.0).light(grey_eye(0.2), camera, lens, (1, 0)).mean() == pytest.approx(0.2)


def test_a_moving_camera_smears_its_image_along_its_flight_and_not_across(tmp_path):
    checker = {"[texture]": '[texture]\nkind = "checker"\nsquare_m = 0.4'}
    scene = staged(scene_file(tmp_path, **checker))
    still, moving = (
        dataclasses.replace(scene.sensor, samples=64, blur_m=blur).light(
            scene.renderer.radiance_of_rays, scene.cameras[1], scene.lens, (1, 1)
        )
        for blur in (0.0, 0.15)
    )
    along, across = (
        np.abs(np.diff(moving, axis=axis)).max(axis=axis).mean()
        / np.abs(np.diff(still, axis=axis)).max(axis=axis).mean()
        for axis in (0, 1)
    )
    assert along < 0.6
    assert across > 0.9


def test_rays_of_chance_fill_pixels_and_time_evenly():
    sensor = Sensor(samples=64, is_jittered=True)
    turn = np.random.default_rng(1).random((20, 3))
    parts = [offsets for _, offsets in sensor._samples(turn)]
    offsets = np.concatenate(parts, axis=1)
    assert offsets.shape == (20, 64, 3)
    assert np.abs(offsets).max() <= 0.5
    # The means of 64 independent numbers would err by 0.036, the worst of 60 by 0.09; an even sequence does better.
    assert np.abs(offsets.mean(axis=1)).max() < 0.04


@pytest.mark.parametrize("overcast", [False, True])
def test_any_sky_lights_level_ground_alike(overcast):
    light = Light(sun_share=0.25, overcast=overcast)
    up = (np.arange(20000) + 0.5) / 20000
    assert np.mean(light.sky(up) * 2.0 * up) == pytest.approx(0.75, rel=1e-4)
    assert light.sun_irradiance * light.sun[2] / math.pi == pytest.approx(0.25)
