"""Scene files: keys are checked, examples can be flown, sun and water are where the file says."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scene_files import SCENE, scene_file, staged, write_mesh

from survey.errors import ConfigError, SurveyError
from survey.folder.local_frame import water_plane
from survey.simulate.conditions import Light
from survey.simulate.scene_file import read_scene
from survey.simulate.simulate import light_of, plan_scene

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.mark.parametrize(
    ("change", "named"),
    [({"depth_m": "dept_m = 1.2"}, r"unknown key dept_m in \[bed\]; the nearest known one is \[bed\] depth_m"),
     ({"kind": 'kind = "drawn"\n[[objects]]\nfil = "a.obj"'}, r"unknown key fil in \[objects\[0\]\]"),
     ({"origin": "origin = [1.0, 2.0]"}, "origin is .*expected a list of 3, each a finite number"),
     ({"crs": ""}, "crs is missing, expected a text in quotes"),
     ({"crs": 'crs = "EPSG:25832"'}, "no vertical part; add a vertical CRS"),
     ({"height_m": 'height_m = "high"'}, "flight.height_m is 'high', expected a finite number"),
     ({"kind": 'kind = "lava"'}, 'bed.kind is "lava", expected one of drawn, plane, mesh'),
     ({"kind": 'kind = "mesh"'}, 'give file = "..."'),
     ({"texel_m": "texel_m = 0.0"}, "texture.texel_m is 0, expected a number above 0"),
     ({"texel_m": "texel_m = 0.0001"}, r"texels for what the cameras see; give 0\.00\d or more"),
     ({"focal_px": "focal_mm = 24.0"}, "focal_px, or focal_mm and sensor_mm"),
     ({"focal_px": 'focal_px = 160.0\nmodel = "OPENCV"'}, "expected 4 for OPENCV: k1, k2, p1, p2"),
     ({"slope_north": "refractive_index = 2.4"}, "expected 1.0 to 1.6"),
     ({"texel_m": 'kind = "checker"\nsquare_m = 1e-6'}, r"texture.square_m is 1e-06, which takes .* squares .*; give"),
     ({"kind": 'kind = "drawn"\ncell_m = 1e-5'}, r"bed.cell_m is 1e-05, which takes .* cells .*; give 0\.00"),
     ({"slope_north": "level_m = 500.0"}, r"a camera is 7\d\.\d\d m under the bed; correct water.level_m"),
     ({"crs": 'crs = "EPSG:25832+7837"\nseed = -1'}, "seed is -1, expected a whole number from zero on"),
     ({"mode": 'mode = "fast"'}, "expected one of direct, physical"),
     ({"kind": 'kind = "plane"\nsmoothing = -1'}, "bed.smoothing is -1, expected a number of passes"),
     ({"noise": "noise = -1.0"}, "sensor.noise is -1, expected a number of at least 0"),
     ({"noise": "exposure = 0.0"}, "sensor.exposure is 0, expected a number above 0"),
     ({"[area]": "[area"}, "not valid TOML")],
)  # fmt: skip
def test_what_is_wrong_in_a_scene_file_is_named_with_the_mend(tmp_path, change, named):
    with pytest.raises(ValueError, match=named):
        staged(scene_file(tmp_path, **change))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_example_scenes_can_be_flown(path):
    plan = plan_scene(read_scene(path), path.parent)
    assert len(plan.cameras) >= 3


def test_the_sun_stands_where_the_scene_file_says(tmp_path):
    text = SCENE + "[light]\nsun_elevation_deg = 30.0\nsun_azimuth_deg = 90.0\n"
    plan = plan_scene(read_scene(scene_file(tmp_path, text)), tmp_path)
    light = light_of(plan.settings.light, plan.frame)
    np.testing.assert_allclose(light.sun, [math.cos(math.radians(30.0)), 0.0, 0.5], atol=1e-12)
    assert light.irradiance(np.array([0.0, 0.0, 1.0])) == pytest.approx(1.0)


def test_waves_run_where_the_scene_file_says_and_photographs_bend_with_them(tmp_path):
    waves = "[[water.waves]]\namplitude_m = 0.02\nlength_m = 0.8\ntoward_deg = 90.0\nphase_deg = 90.0"
    scene = staged(scene_file(tmp_path, slope_north=waves))
    x = np.array([0.0, 0.2, 0.4, 0.8])
    # A crest at the origin, and a train that runs east: nothing changes to the north.
    crest = 0.02 * np.cos(2.0 * math.pi * x / 0.8)
    np.testing.assert_allclose(scene.water.height(x, 0.0 * x), crest, atol=1e-9)
    np.testing.assert_allclose(scene.water.height(x, 0.0 * x + 2.0), crest, atol=1e-9)
    still = dataclasses.replace(scene.renderer, water=water_plane(scene.frame, scene.level))
    camera = scene.cameras[0]
    pixels = camera.pixel_centres()[::6, ::6].reshape(-1, 2)
    bent, straight = scene.renderer.trace(camera, pixels), still.trace(camera, pixels)
    moved = np.linalg.norm(bent.points - straight.points, axis=1)
    # A slope of up to a k = 0.157 moves a ray by (1 - 1/n) of it over 1.2 m of water, and more where it is oblique.
    assert 0.03 < moved.max() < 0.09
    back = camera.project(bent.points, scene.water)
    # Where several paths lead up, `project` takes the shortest, which need not be the one that was traced.
    assert np.mean(np.abs(back - pixels).max(axis=1) < 1e-6) > 0.9


def test_a_measured_surface_is_laid_through_its_points(tmp_path):
    x, y = (c.ravel() for c in np.meshgrid(np.linspace(-20, 20, 21), np.linspace(-20, 20, 21)))
    frame = plan_scene(read_scene(scene_file(tmp_path)), tmp_path).frame
    write_mesh(tmp_path / "surface.ply", frame.crs_from_local(np.stack([x, y, 0.1 + 0.002 * x], axis=-1)), [])
    scene = staged(scene_file(tmp_path, slope_north='heights = "surface.ply"'))
    np.testing.assert_allclose(scene.water.height(np.array([1.3]), np.array([-0.4])), 0.1026, atol=1e-6)
    hits = scene.renderer.trace(scene.cameras[0], np.array([[30.0, 30.0], [70.0, 20.0]]))
    np.testing.assert_allclose(
        scene.cameras[0].project(hits.points, scene.water), [[30.0, 30.0], [70.0, 20.0]], atol=1e-6
    )


def test_a_measured_surface_of_two_points_is_refused(tmp_path):
    frame = plan_scene(read_scene(scene_file(tmp_path)), tmp_path).frame
    write_mesh(tmp_path / "surface.ply", frame.crs_from_local([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), [])
    with pytest.raises(SurveyError, match=r"gives no water surface: expected three points or more, .* not on one line"):
        staged(scene_file(tmp_path, slope_north='heights = "surface.ply"'))


def test_a_direction_to_the_sun_has_a_length():
    with pytest.raises(ConfigError, match=r"to_sun is \[0.0, 0.0, 0.0\], expected a direction toward the sun"):
        Light(to_sun=(0.0, 0.0, 0.0))
