"""Scene files become surveys: keys are checked, what was asked for is built and photographed, and the truth fits."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geo import read_reference
from refract import FlatWater
from refract.lens import Lens, distorted, undistorted
from survey.commands.verbs import app
from survey.errors import OutputError, SurveyError
from survey.folder.config import read_config
from survey.folder.survey import load_image, load_survey
from survey.simulate.ground.ground import NOTHING, Ground, Look, shade_of_normals
from survey.simulate.ground.shapes import BedGrid
from survey.simulate.ground.skin import VertexSkin
from survey.simulate.ground.triangles import TriangleMesh
from survey.simulate.light import Light
from survey.simulate.output import writing
from survey.simulate.output.truth import depth_map
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.scene_file import read_scene
from survey.simulate.sensor import Sensor
from survey.simulate.staging.build import light_of, stage_scene
from survey.simulate.staging.planning import plan_scene
from survey.simulate.staging.simulate import simulate, simulate_flight
from survey.simulate.watercolour import WaterColour

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SCENE = """
crs = "EPSG:25832+7837"
origin = [676120.0, 5311480.0, 584.2]
[area]
size_m = [2.4, 2.0]
[bed]
kind = "plane"
depth_m = 1.2
[texture]
texel_m = 0.02
[water]
slope_north = 0.003
[camera]
size_px = [96, 72]
focal_px = 160.0
[flight]
height_m = 6.0
patterns = ["nadir"]
forward_overlap = 0.6
side_overlap = 0.5
[sensor]
noise = 0.0
[render]
mode = "direct"
"""


def scene_file(folder: Path, text: str = SCENE, **changes: str) -> Path:
    """A scene file; changes replace whole lines by what they begin with, or whole tables."""
    for start, line in changes.items():
        lines = text.splitlines()
        hit = [k for k, old in enumerate(lines) if old.startswith(start)]
        assert hit, start
        lines[hit[0]] = line
        text = "\n".join(lines)
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def staged(path: Path):
    return stage_scene(plan_scene(read_scene(path), path.parent))


def write_mesh(path: Path, vertices: np.ndarray, faces, colours=None) -> None:
    """ASCII PLY, as other programs write it."""
    rows = [f"{x} {y} {z}" for x, y, z in vertices]
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    if colours is not None:
        head += [f"property uchar {name}" for name in ("red", "green", "blue")]
        rows = [f"{row} {r} {g} {b}" for row, (r, g, b) in zip(rows, colours, strict=True)]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*head, *rows, *(f"3 {a} {b} {c}" for a, b, c in faces), ""]), encoding="ascii")


@pytest.fixture(scope="module")
def survey(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    simulate(scene_file(folder), folder / "survey")
    return folder / "survey"


@pytest.mark.parametrize(
    ("change", "named"),
    [({"depth_m": "dept_m = 1.2"}, r"unknown key dept_m in \[bed\]; the nearest known one is \[bed\] depth_m"),
     ({"origin": "origin = [1.0, 2.0]"}, "origin is .*expected a list of 3, each a finite number"),
     ({"crs": ""}, "crs is missing, expected a text in quotes"),
     ({"crs": 'crs = "EPSG:25832"'}, "no vertical part; add a vertical CRS"),
     ({"height_m": 'height_m = "high"'}, "flight.height_m is 'high', expected a finite number"),
     ({"kind": 'kind = "lava"'}, 'bed.kind is "lava", expected one of drawn, plane, mesh'),
     ({"kind": 'kind = "mesh"'}, 'give file = "..."'),
     ({"texel_m": "texel_m = 0.0"}, "texture.texel_m is 0, expected a number above zero"),
     ({"texel_m": "texel_m = 0.0001"}, r"texels for what the cameras see; give 0\.00\d or more"),
     ({"focal_px": "focal_mm = 24.0"}, "focal_px, or focal_mm and sensor_mm"),
     ({"focal_px": 'focal_px = 160.0\nmodel = "OPENCV"'}, "expected 4 for OPENCV: k1, k2, p1, p2"),
     ({"slope_north": "refractive_index = 2.4"}, "expected 1.0 to 1.6"),
     ({"mode": 'mode = "fast"'}, "expected one of direct, physical"),
     ({"[area]": "[area"}, "not valid TOML")],
)  # fmt: skip
def test_what_is_wrong_in_a_scene_file_is_named_with_the_mend(tmp_path, change, named):
    with pytest.raises(ValueError, match=named):
        staged(scene_file(tmp_path, **change))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_example_scenes_can_be_flown(path):
    plan = plan_scene(read_scene(path), path.parent)
    assert len(plan.cameras) >= 3


def test_a_simulated_survey_is_an_ordinary_one_and_projects_its_truth(survey):
    loaded = load_survey(survey)
    assert loaded.water.n_water == 1.333
    config = read_config(survey / "survey.toml")
    assert config.water.slope_north == 0.003
    cloud = loaded.frame.local_from_crs(read_reference(survey / "truth" / "visible.ply").points)
    assert len(cloud) > 2000
    for view in loaded.views[:3]:
        depth = np.asarray(Image.open(survey / "truth" / "depth" / f"{Path(view.name).stem}.tif"))
        pixels = view.camera.project(cloud, loaded.water)
        inside = ((pixels > 1.0) & (pixels < (95.0, 71.0))).all(axis=1)
        at = pixels[inside].astype(int)
        true = loaded.water.height(cloud[inside, 0], cloud[inside, 1]) - cloud[inside, 2]
        # Over a level bed depth changes by the slope of the water, 0.003 m per metre, within a pixel of 4 cm.
        np.testing.assert_allclose(depth[at[:, 1], at[:, 0]], true, atol=2e-4)
        assert (np.asarray(Image.open(survey / "truth" / "wet" / f"{Path(view.name).stem}.png")) == 255).all()


def test_simulating_again_changes_nothing_and_another_scene_replaces_it(survey, tmp_path):
    path = scene_file(tmp_path)
    simulate(path, tmp_path / "a")
    for name in ("survey.toml", "cameras.csv", "images/0002.png", "truth/visible.ply", "truth/depth/0001.tif"):
        assert (tmp_path / "a" / name).read_bytes() == (survey / name).read_bytes()
    before = (tmp_path / "a" / writing.MARKER).stat().st_mtime_ns
    simulate(path, tmp_path / "a")
    assert (tmp_path / "a" / writing.MARKER).stat().st_mtime_ns == before
    simulate(scene_file(tmp_path, depth_m="depth_m = 0.8"), tmp_path / "a")
    assert json.loads((tmp_path / "a" / writing.MARKER).read_text())["scene"]["bed"]["depth_m"] == 0.8


def test_the_verb_simulates_plans_and_refuses(tmp_path):
    path = scene_file(tmp_path)
    run = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "plan"), "--flight-only"])
    assert run.exit_code == 0
    assert sorted(p.name for p in (tmp_path / "plan").iterdir()) == ["cameras.csv", "flight.png"]
    assert "cannot observe the water level" in run.stderr
    run = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "plan")])
    assert run.exit_code == 2
    assert "not simulated here" in run.stderr


def test_a_flight_is_not_planned_over_the_cameras_of_a_survey(survey, tmp_path):
    path = scene_file(tmp_path)
    simulate_flight(path, tmp_path / "plan")
    simulate_flight(path, tmp_path / "plan")
    before = (survey / "cameras.csv").read_bytes()
    with pytest.raises(OutputError, match=r"has images and is not a flight of --flight-only; name a new or empty"):
        simulate_flight(path, survey)
    assert (survey / "cameras.csv").read_bytes() == before
    (tmp_path / "plan" / "flight.png").unlink()
    with pytest.raises(OutputError, match=r"has cameras\.csv and is not a flight"):
        simulate_flight(path, tmp_path / "plan")


@pytest.mark.parametrize("make", [simulate, simulate_flight])
def test_a_scene_does_not_replace_the_survey_that_its_bed_comes_from(survey, tmp_path, make):
    bed = survey / "truth" / "reference.ply"
    before = bed.read_bytes()
    path = scene_file(tmp_path, kind=f'kind = "mesh"\nfile = "{bed}"')
    with pytest.raises(OutputError, match=r"-o names .*survey, which holds the input .*reference\.ply; move that"):
        make(path, survey)
    assert bed.read_bytes() == before


def test_rays_meet_any_mesh_where_they_meet_the_same_bed_as_a_grid(rng):
    heights = rng.normal(-1.0, 0.1, (20, 30))
    grid = BedGrid(heights, -1.0, -1.0, 0.1)
    vertices, faces, _ = grid.mesh()
    mesh = TriangleMesh(vertices, faces)
    origin = rng.uniform((-0.5, -0.5, 4.0), (1.3, 0.5, 6.0), (3000, 3))
    direction = np.array([*rng.uniform(-0.05, 0.05, (2, 3000)), np.full(3000, -1.0)]).T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    endless = np.full(3000, np.inf)
    t, face = mesh.hit(origin, direction, endless)
    # Where float32 takes the neighbour across an edge the planes differ by its 1e-7 m times the slope.
    np.testing.assert_allclose(t, grid.hit(origin, direction, endless)[0], atol=1e-6)
    ends = origin + t[:, None] * direction
    corner = vertices[faces[face, 0]]
    assert np.abs(np.einsum("ij,ij->i", ends - corner, mesh.normals[face])).max() < 1e-12
    assert np.isinf(mesh.hit(origin, direction, t - 1e-4)[0]).all()
    np.testing.assert_allclose(mesh.height(0.31, 0.22), grid.height(0.31, 0.22), atol=1e-6)


def test_a_ray_beside_a_bed_of_limited_extent_meets_nothing_and_is_black():
    mesh = TriangleMesh(np.array([[0.0, 0, -1], [1, 0, -1], [0, 1, -1]]), np.array([[0, 1, 2]]))
    look = Look(VertexSkin(np.ones((3, 3)), mesh.vertices, mesh.faces), shade_of_normals(mesh.normals, Light()))
    for water in (None, FlatWater((0.0, 0.0, 0.0))):
        renderer = DirectRenderer(Ground(mesh, (), (look,)), water, WaterColour(veil=(0.0, 0.0, 0.0), sky=0.0))
        origin = np.array([[0.2, 0.2, 3.0], [5.0, 5.0, 3.0]])
        down = np.tile([0.0, 0.0, -1.0], (2, 1))
        hits = renderer.trace_rays(origin, down)
        assert hits.body.tolist() == [-1, NOTHING]
        assert np.isnan(hits.points[1]).all()
        light = renderer.radiance_of_rays(origin, down)
        assert light[0].min() > 0.2
        assert (light[1] == 0.0).all()


def test_a_bed_from_a_mesh_in_crs_lies_where_its_file_says_with_its_colours(tmp_path):
    local = np.array([[-9.0, -9.0, -1.0], [9.0, -9.0, -1.0], [9.0, 9.0, -1.3], [-9.0, 9.0, -1.3]])
    frame = plan_scene(read_scene(scene_file(tmp_path)), tmp_path).frame
    path = scene_file(tmp_path, kind='kind = "mesh"\nfile = "bed.ply"', **{"[texture]": '[texture]\nkind = "vertex"'})
    write_mesh(tmp_path / "bed.ply", frame.crs_from_local(local), [(0, 1, 2), (0, 2, 3)], [(255, 0, 0)] * 4)
    scene = staged(path)
    hits = scene.renderer.trace(scene.cameras[0], np.array([[48.0, 36.0]]))
    _, y, z = hits.points[0]
    assert z == pytest.approx(-1.15 - 0.15 * y / 9.0, abs=1e-6)
    colour = scene.renderer.ground.colour(hits.points, hits.body, hits.face)[0]
    assert colour[0] > 0.5
    np.testing.assert_allclose(colour[1:], 0.0, atol=1e-12)


def test_a_cloud_becomes_a_bed_by_triangles_thinned_and_smoothed(tmp_path, rng):
    x, y = (c.ravel() for c in np.meshgrid(np.linspace(-6, 6, 61), np.linspace(-6, 6, 61)))
    heights = -1.0 - 0.05 * x + rng.normal(0.0, 0.02, x.size)
    write_mesh(tmp_path / "cloud.ply", np.stack([x, y, heights], axis=-1), [])
    cloud = 'kind = "cloud"\nfile = "cloud.ply"\nframe = "local"\n'
    rough = staged(scene_file(tmp_path, kind=cloud)).renderer.ground.bed
    smooth = staged(scene_file(tmp_path, kind=cloud + "smoothing = 4")).renderer.ground.bed
    thin = staged(scene_file(tmp_path, kind=cloud + "spacing_m = 0.4")).renderer.ground.bed
    at = rng.uniform(-3.0, 3.0, (2, 400))
    error = [np.std(bed.height(*at) + 1.0 + 0.05 * at[0]) for bed in (rough, smooth, thin)]
    assert error[1] < 0.3 * error[0]
    assert error[2] < 0.7 * error[0]
    assert len(thin.vertices) < 0.3 * len(rough.vertices)
    assert (rough.normals[:, 2] > 0.0).all()


def test_an_object_is_scaled_turned_heeled_and_stands_on_the_bed(tmp_path):
    corners = np.array([[x, y, z] for x in (0.0, 4.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]) + 100.0
    from scipy.spatial import ConvexHull

    write_mesh(tmp_path / "box.ply", corners, ConvexHull(corners).simplices)
    text = SCENE + '[[objects]]\nfile = "box.ply"\nat = [0.3, -0.2]\nscale = 0.1\nyaw_deg = 90.0\nabove_bed_m = 0.05\n'
    (body,) = staged(scene_file(tmp_path, text)).renderer.ground.solids
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    np.testing.assert_allclose(low, [0.25, -0.4, -1.15], atol=1e-9)
    np.testing.assert_allclose(high, [0.35, 0.0, -1.05], atol=1e-9)
    (heeled,) = staged(scene_file(tmp_path, text + "heel_deg = 90.0\n")).renderer.ground.solids
    np.testing.assert_allclose(np.ptp(heeled.vertices, axis=0), [0.1, 0.4, 0.1], atol=1e-9)


LENSES = [
    Lens("OPENCV", (160.0, 160.0, 47.0, 37.0, -0.12, 0.03, 1e-3, -2e-3), 96, 72),
    Lens("OPENCV_FISHEYE", (160.0, 160.0, 48.0, 36.0, 0.01, -0.02, 0.0, 0.0), 96, 72),
]


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_distortion_is_undone_by_its_inverse(lens, rng):
    pixels = rng.uniform((0.0, 0.0), (96.0, 72.0), (500, 2))
    fx, fy = lens.focal
    ideal = undistorted(lens, pixels) * (fx, fy) + (lens["cx"], lens["cy"])
    np.testing.assert_allclose(distorted(lens, ideal), pixels, atol=1e-6)
    assert np.abs(ideal - pixels).max() > 0.5


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
    drifting = Sensor(drift=0.05)
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
    sensor = Sensor(samples=64, by_chance=True)
    turn = np.random.default_rng(1).random((20, 3))
    parts = [offsets for _, offsets in sensor._samples(turn)]
    offsets = np.concatenate(parts, axis=1)
    assert offsets.shape == (20, 64, 3)
    assert np.abs(offsets).max() <= 0.5
    # The means of 64 independent numbers would err by 0.036, the worst of 60 by 0.09; an even sequence does better.
    assert np.abs(offsets.mean(axis=1)).max() < 0.04


def test_the_sun_stands_where_the_scene_file_says(tmp_path):
    text = SCENE + "[light]\nsun_elevation_deg = 30.0\nsun_azimuth_deg = 90.0\n"
    plan = plan_scene(read_scene(scene_file(tmp_path, text)), tmp_path)
    light = light_of(plan.settings.light, plan.frame)
    np.testing.assert_allclose(light.sun, [math.cos(math.radians(30.0)), 0.0, 0.5], atol=1e-12)
    assert light.on(np.array([0.0, 0.0, 1.0])) == pytest.approx(1.0)


@pytest.mark.parametrize("overcast", [False, True])
def test_any_sky_lights_level_ground_alike(overcast):
    light = Light(sun_share=0.25, overcast=overcast)
    up = (np.arange(20000) + 0.5) / 20000
    assert np.mean(light.sky(up) * 2.0 * up) == pytest.approx(0.75, rel=1e-4)
    assert light.sun_irradiance * light.sun[2] / math.pi == pytest.approx(0.25)


def test_depth_is_nan_where_a_pixel_sees_nothing(tmp_path):
    scene = staged(scene_file(tmp_path))
    triangle = TriangleMesh(np.array([[-0.3, -9.0, -1.0], [9.0, -9.0, -1.0], [-0.3, 9.0, -1.0]]), np.array([[0, 1, 2]]))
    look = Look(
        VertexSkin(np.ones((3, 3)), triangle.vertices, triangle.faces), shade_of_normals(triangle.normals, Light())
    )
    renderer = dataclasses.replace(scene.renderer, ground=Ground(triangle, (), (look,)))
    depth, wet = depth_map(renderer, scene.cameras[1], scene.lens)
    assert 0.1 < np.isnan(depth).mean() < 0.9
    assert np.nanmax(np.abs(depth - 1.0)) < 0.03  # the slope of the water over the picture
    assert (wet == 255).all()


def test_waves_run_where_the_scene_file_says_and_photographs_bend_with_them(tmp_path):
    waves = "[[water.waves]]\namplitude_m = 0.02\nlength_m = 0.8\ntoward_deg = 90.0\nphase_deg = 90.0"
    scene = staged(scene_file(tmp_path, slope_north=waves))
    x = np.array([0.0, 0.2, 0.4, 0.8])
    # A crest at the origin, and a train that runs east: nothing changes to the north.
    crest = 0.02 * np.cos(2.0 * math.pi * x / 0.8)
    np.testing.assert_allclose(scene.water.height(x, 0.0 * x), crest, atol=1e-9)
    np.testing.assert_allclose(scene.water.height(x, 0.0 * x + 2.0), crest, atol=1e-9)
    still = dataclasses.replace(scene.renderer, water=scene.level.plane(scene.frame))
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


def test_an_object_of_glb_stands_upright_with_the_colours_of_its_vertices_or_its_image(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="GLB needs the extra [gltf]")
    # A tower 3 m tall along y, which points up in glTF.
    tower = trimesh.creation.box(extents=(1.0, 3.0, 1.0))
    tower.visual.vertex_colors = [0, 255, 0, 255]
    tower.export(tmp_path / "coloured.glb")
    image = Image.new("RGB", (4, 4), (255, 0, 0))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    tower.visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
    tower.export(tmp_path / "textured.glb")
    for name, channel in (("coloured", 1), ("textured", 0)):
        text = SCENE + f'[[objects]]\nfile = "{name}.glb"\nat = [0.0, 0.0]\nscale = 0.1\n'
        scene = staged(scene_file(tmp_path, text))
        (body,), look = scene.renderer.ground.solids, scene.renderer.ground.looks[1]
        np.testing.assert_allclose(np.ptp(body.vertices, axis=0), [0.1, 0.1, 0.3], atol=1e-6)
        albedo = look.skin.albedo(body.vertices[body.faces[:1, 0]], np.array([0]))[0]
        np.testing.assert_allclose(albedo, np.eye(3)[channel], atol=0.02)


def test_a_bed_in_another_crs_or_without_faces_is_refused(tmp_path):
    write_mesh(tmp_path / "points.ply", np.zeros((4, 3)), [])
    with pytest.raises(SurveyError, match='no faces; give kind = "cloud"'):
        staged(scene_file(tmp_path, kind='kind = "mesh"\nfile = "points.ply"\nframe = "local"'))
    from geo import write_cloud
    from geo.crs import parse_crs

    points = np.array([[676110.0, 5311470.0, 583.0], [676130.0, 5311470.0, 583.0], [676120.0, 5311490.0, 583.0]])
    for name, crs in (("here", "EPSG:25832+7837"), ("there", "EPSG:25833+7837")):
        zero = np.zeros(3)
        others = {
            "depth_m": zero,
            "std_m": zero,
            "num_views": zero.astype(int),
            "incidence_deg": zero,
            "is_wet": zero > 0,
        }
        write_cloud(tmp_path / f"{name}.las", points, parse_crs(crs), rgb=np.zeros((3, 3), np.uint8), **others)
    bed = staged(scene_file(tmp_path, kind='kind = "cloud"\nfile = "here.las"')).renderer.ground.bed
    # Heights of crs lie 1.2 m under the origin; millimetres are what LAS holds.
    assert bed.height(0.0, 0.0) == pytest.approx(-1.2, abs=1e-3)
    with pytest.raises(SurveyError, match=r"another crs than the scene.*UTM zone 33N"):
        staged(scene_file(tmp_path, kind='kind = "cloud"\nfile = "there.las"'))
