"""Photographs of a drawn survey: light, noise, shutter, tide, the headers of their files and where they are taken."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from drawn_shore import SHORE, STORED_PX
from PIL import Image

from refract import FlatWater
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.simulate.drawn import DrawnScene, draw_survey, stage_drawing

ROLLING = DrawnScene.tiny(speed_m_s=4.0, readout_s=0.035)


def test_a_pixel_is_the_mean_light_of_its_quarters(shore_drawing):
    camera = shore_drawing.cameras[6]
    image = shore_drawing.photograph(6)
    rows, columns = np.array([3, 50, 118, 77]), np.array([150, 20, 90, 1])
    quarters = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    pixels = np.stack([columns, rows], axis=-1)[:, None] + quarters
    light = shore_drawing.renderer.radiance(camera, pixels.reshape(-1, 2)).reshape(4, 4, 3).mean(axis=1)
    np.testing.assert_array_equal(image[rows, columns], np.round(255.0 * light ** (1.0 / 2.2)))


def test_a_rolling_shutter_takes_each_row_from_where_the_camera_is_then():
    scene = stage_drawing(ROLLING)
    camera = scene.cameras[6]
    image = scene.photograph(6)
    rows, columns = np.array([3, 50, 118, 77]), np.array([150, 20, 90, 1])
    quarters = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    pixels = (np.stack([columns, rows], axis=-1)[:, None] + quarters).reshape(-1, 2)
    # 4 m/s, 35 ms, 120 rows.
    late = (pixels[:, 1] - 60.0) * 0.035 / 119.0
    places = camera.centre + late[:, None] * scene.velocities[6]
    light = scene.renderer.radiance_of_rays(places, camera.directions(pixels)).reshape(4, 4, 3).mean(axis=1)
    np.testing.assert_allclose(image[rows, columns], np.round(255.0 * light ** (1.0 / 2.2)), atol=1)
    np.testing.assert_array_equal(scene.renderer.radiance(camera, pixels).reshape(4, 4, 3).mean(axis=1), light)
    assert np.linalg.norm(scene.velocities, axis=1) == pytest.approx(4.0)
    still = stage_drawing(dataclasses.replace(ROLLING, readout_s=0.0))
    assert np.abs(image.astype(float) - still.photograph(6)).mean() > 2.0


def test_a_survey_drawn_with_a_rolling_shutter_is_loaded_with_the_motion_that_it_was_drawn_with(tmp_path):
    draw_survey(tmp_path / "s", ROLLING)
    survey, scene = load_survey(tmp_path / "s"), stage_drawing(ROLLING)
    assert survey.findings.warnings == ()
    for view, camera in zip(survey.views, scene.cameras, strict=True):
        # XMP has 0.1 m/s, and axes of a frame with its origin a metre away.
        np.testing.assert_allclose(view.camera.motion, camera.motion, atol=0.06 * 0.035 / 119.0)
        points = np.column_stack([np.linspace(-1.0, 1.0, 9), np.linspace(1.0, -1.0, 9), np.full(9, -1.1)])
        here = survey.frame.local_from_crs(scene.frame.crs_from_local(points))
        apart = view.camera.project(here, survey.water) - camera.project(points, scene.water)
        assert np.abs(apart).max() < 0.06 * 0.035 / 2.0 * 280.0 / 7.0 + STORED_PX
    depth = np.asarray(Image.open(tmp_path / "s" / "truth" / "depth" / "0006.tif"))
    hits = scene.renderer.trace(scene.cameras[6], scene.cameras[6].pixel_centres().reshape(-1, 2))
    np.testing.assert_allclose(depth.ravel(), -hits.points[:, 2], atol=2e-3)


def test_a_survey_drawn_over_rising_water_is_loaded_with_the_levels_that_it_was_drawn_with(tmp_path):
    rising = DrawnScene.tiny(rise_m=0.2)
    draw_survey(tmp_path / "s", rising)
    survey, scene = load_survey(tmp_path / "s"), stage_drawing(rising)
    assert survey.config.water.level_m == pytest.approx(rising.level_m, abs=1e-9)
    points = np.column_stack([np.linspace(-1.0, 1.0, 9), np.linspace(1.0, -1.0, 9), np.full(9, -1.1)])
    for index, view in enumerate(survey.views):
        # Times in EXIF are those of a flight of an hour, to a microsecond; readings of the gauge have 0.1 mm.
        assert view.camera.tide == pytest.approx(0.2 * (index / 7.0 - 0.5), abs=1e-4)
        renderer, camera = scene.at(index)
        here = survey.frame.local_from_crs(scene.frame.crs_from_local(points))
        apart = view.camera.project(here, survey.water) - camera.project(points, renderer.water)
        assert np.abs(apart).max() < STORED_PX


def test_deep_ground_is_bluer_and_all_ground_is_textured(shore_drawing):
    camera = shore_drawing.cameras[0]
    hits = shore_drawing.renderer.trace(camera, camera.pixel_centres().reshape(-1, 2))
    image = shore_drawing.photograph(0).astype(float)
    blueness = (image[..., 2] / image[..., 0]).ravel()
    deep, shallow = hits.in_water > 0.5, hits.in_water < 0.1
    assert blueness[deep].mean() > 1.1 * blueness[shallow].mean()
    blocks = image[:, :, 1].reshape(12, 10, 16, 10).std(axis=(1, 3))
    assert blocks.min() > 3.0  # three times the noise of a photograph
    assert (image == 255.0).mean() < 0.01


def test_every_point_of_the_demos_area_lies_in_at_least_six_photographs():
    scene = DrawnScene()
    x, y = (c.ravel() for c in np.meshgrid(*(np.linspace(-0.5, 0.5, 21) * s for s in scene.size_m)))
    num_views = np.zeros(len(x), dtype=int)
    for camera in scene.cameras():
        points = np.stack([x, y, np.full(len(x), -scene.depth_m)], axis=-1)
        pixels = camera.project(points, FlatWater((0.0, 0.0, 0.0), n_water=scene.n_water))
        num_views += ((pixels > 0.0) & (pixels < scene.image_px)).all(axis=1)
    assert num_views.min() >= 6


def test_the_demos_views_are_convergent_from_10_to_35_degrees():
    axes = np.array([camera.cam_from_local[2] for camera in DrawnScene().cameras()])
    tilt = np.sort(np.degrees(np.arccos(-axes[:, 2])))
    assert len(tilt) == 20
    assert (tilt[:12] < 5.0).all()
    np.testing.assert_allclose(tilt[[12, -1]], [10.0, 35.0], atol=1e-6)


def test_exif_has_the_position_within_the_noise_of_a_good_receiver_and_the_focal_length(shore_drawing, shore_folder):
    from pyproj import Transformer

    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    centres = shore_drawing.frame.crs_from_local([camera.centre for camera in shore_drawing.cameras])
    for name, centre in zip(shore_drawing.names, centres, strict=True):
        head = read_exif(shore_folder / "images" / name)
        latitude, longitude, height = head.lat_lon_height
        found = np.array([*to_grid.transform(longitude, latitude), height])
        assert np.abs(found - centre).max() < 5 * 0.02
        assert head.focal_px == pytest.approx(SHORE.focal_px, rel=0.5 / 63.0)  # whole millimetres of 35 mm film


def test_noise_has_the_asked_strength_and_photographs_become_jpeg(tmp_path):
    scene = DrawnScene.tiny(noise=2.0, num_views=3)
    noisy, clean = stage_drawing(scene), stage_drawing(dataclasses.replace(scene, noise=0.0))
    difference = noisy.photograph(1).astype(float) - clean.photograph(1)
    # Two roundings add 1/12 each.
    assert difference.std() == pytest.approx(np.sqrt(4.0 + 2.0 / 12.0), rel=0.01)
    draw_survey(tmp_path / "noisy", scene)
    assert sorted(p.name for p in (tmp_path / "noisy" / "images").iterdir()) == noisy.names
    assert noisy.names[0] == "0000.jpg"
