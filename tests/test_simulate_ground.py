"""The ground of a simulated scene: shapes, meshes, clouds and objects, and rays that meet them."""

import dataclasses

import numpy as np
import pytest
from PIL import Image
from scene_files import SCENE, scene_file, staged, write_mesh
from scipy.spatial import ConvexHull

from geo import write_cloud
from geo.crs import parse_crs
from geo.errors import GeoError
from refract import FlatWater
from survey.errors import SurveyError
from survey.simulate.conditions import Light, WaterOptics
from survey.simulate.direct import DirectRenderer
from survey.simulate.ground import NOTHING, Ground, Material, shade_of_normals
from survey.simulate.scene_file import read_scene
from survey.simulate.shapes import BedGrid, Solid, TriangleMesh
from survey.simulate.simulate import plan_scene
from survey.simulate.textures import VertexTexture
from survey.simulate.writing import depth_map


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


def one_triangle(corners) -> Ground:
    """A white triangle for a bed."""
    mesh = TriangleMesh(np.array(corners), np.array([[0, 1, 2]]))
    white = VertexTexture(np.ones((3, 3)), mesh.vertices, mesh.faces)
    return Ground(mesh, (), (Material(white, shade_of_normals(mesh.normals, Light())),))


def test_a_ray_beside_a_bed_of_limited_extent_meets_nothing_and_is_black():
    ground = one_triangle([[0.0, 0, -1], [1, 0, -1], [0, 1, -1]])
    for water in (None, FlatWater((0.0, 0.0, 0.0))):
        renderer = DirectRenderer(ground, water, WaterOptics(veil=(0.0, 0.0, 0.0), sky=0.0))
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


@pytest.mark.parametrize("num", [2, 5])
def test_a_cloud_on_one_line_is_refused(tmp_path, num):
    write_mesh(tmp_path / "points.ply", np.arange(3.0 * num).reshape(num, 3), [])
    with pytest.raises(SurveyError, match=rf"points\.ply has {num} points, expected a cloud .* not on one line"):
        staged(scene_file(tmp_path, kind='kind = "cloud"\nfile = "points.ply"\nframe = "local"'))


def test_an_object_is_scaled_turned_heeled_and_stands_on_the_bed(tmp_path):
    corners = np.array([[x, y, z] for x in (0.0, 4.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]) + 100.0
    write_mesh(tmp_path / "box.ply", corners, ConvexHull(corners).simplices)
    text = SCENE + '[[objects]]\nfile = "box.ply"\nat = [0.3, -0.2]\nscale = 0.1\nyaw_deg = 90.0\nabove_bed_m = 0.05\n'
    (body,) = staged(scene_file(tmp_path, text)).renderer.ground.solids
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    np.testing.assert_allclose(low, [0.25, -0.4, -1.15], atol=1e-9)
    np.testing.assert_allclose(high, [0.35, 0.0, -1.05], atol=1e-9)
    (heeled,) = staged(scene_file(tmp_path, text + "heel_deg = 90.0\n")).renderer.ground.solids
    np.testing.assert_allclose(np.ptp(heeled.vertices, axis=0), [0.1, 0.4, 0.1], atol=1e-9)


def test_depth_is_nan_where_a_pixel_sees_nothing(tmp_path):
    scene = staged(scene_file(tmp_path))
    ground = one_triangle([[-0.3, -9.0, -1.0], [9.0, -9.0, -1.0], [-0.3, 9.0, -1.0]])
    renderer = dataclasses.replace(scene.renderer, ground=ground)
    depth, wet = depth_map(renderer, scene.cameras[1], scene.lens)
    assert 0.1 < np.isnan(depth).mean() < 0.9
    assert np.nanmax(np.abs(depth - 1.0)) < 0.03  # the slope of the water over the picture
    assert (wet == 255).all()


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
        (body,), material = scene.renderer.ground.solids, scene.renderer.ground.materials[1]
        np.testing.assert_allclose(np.ptp(body.vertices, axis=0), [0.1, 0.1, 0.3], atol=1e-6)
        albedo = material.texture.albedo(body.vertices[body.faces[:1, 0]], np.array([0]))[0]
        np.testing.assert_allclose(albedo, np.eye(3)[channel], atol=0.02)


def test_a_bed_in_another_crs_or_without_faces_is_refused(tmp_path):
    write_mesh(tmp_path / "points.ply", np.zeros((4, 3)), [])
    with pytest.raises(SurveyError, match='no faces; give kind = "cloud"'):
        staged(scene_file(tmp_path, kind='kind = "mesh"\nfile = "points.ply"\nframe = "local"'))
    points = np.array([[676110.0, 5311470.0, 583.0], [676130.0, 5311470.0, 583.0], [676120.0, 5311490.0, 583.0]])
    zero = np.zeros(3)
    others = {name: zero for name in ("depth_m", "std_m", "incidence_deg")}
    others |= {"num_views": zero.astype(int), "is_wet": zero > 0, "rgb": np.zeros((3, 3), np.uint8)}
    for name, crs in (("here", "EPSG:25832+7837"), ("there", "EPSG:25833+7837")):
        write_cloud(tmp_path / f"{name}.las", points, parse_crs(crs), **others)
    bed = staged(scene_file(tmp_path, kind='kind = "cloud"\nfile = "here.las"')).renderer.ground.bed
    # Heights of crs lie 1.2 m under the origin; millimetres are what LAS holds.
    assert bed.height(0.0, 0.0) == pytest.approx(-1.2, abs=1e-3)
    with pytest.raises(GeoError, match=r"the scene and .*there.las are in different.*UTM zone 33N"):
        staged(scene_file(tmp_path, kind='kind = "cloud"\nfile = "there.las"'))


def test_rays_over_a_slope_of_triangles_end_at_the_distance_in_closed_form(rng):
    x, y = 0.1 * np.arange(60), 0.1 * np.arange(40)[:, None]
    bed = BedGrid(0.3 * x - 0.2 * y - 1.0, 0.0, 0.0, 0.1)
    origin = rng.uniform((2.0, 1.5, 2.0), (4.0, 2.5, 3.0), (500, 3))
    direction = np.array([*rng.uniform(-0.3, 0.3, (2, 500)), np.full(500, -1.0)]).T
    direction[:20, :2] = 0.0  # plumb
    direction[20:40, 0] = 0.0  # along a line of the grid
    direction[40:60, 1] = -direction[40:60, 0]  # along the diagonals
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    expected = (origin @ (0.3, -0.2, -1.0) - 1.0) / (direction @ (-0.3, 0.2, 1.0))
    endless = np.full(500, np.inf)
    np.testing.assert_allclose(bed.hit(origin, direction, endless)[0], expected, atol=1e-12)
    assert np.isinf(bed.hit(origin, direction, expected - 1e-6)[0]).all()


def test_a_ray_stops_at_a_thin_wall_of_the_bed_that_hides_the_ground_behind():
    heights = np.zeros((9, 400))
    heights[:, 200] = 1.0
    bed = BedGrid(heights, 0.0, 0.0, 0.01)
    origin, direction = np.array([[0.4, 0.045, 2.0]]), np.array([[1.6, 0.0, -1.4]])
    direction /= np.linalg.norm(direction)
    # The west face of the wall is the plane z = 100 (x - 1.99).
    t = (100.0 * (0.4 - 1.99) - 2.0) / (direction[0, 2] - 100.0 * direction[0, 0])
    np.testing.assert_allclose(bed.hit(origin, direction, np.array([np.inf]))[0], t, atol=1e-12)


def test_a_box_is_entered_where_its_faces_are_and_missed_beside_them():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-2.0, 2.0], [0.0, 3.0]), axis=-1).reshape(-1, 3)
    box = Solid.around(corners)
    assert len(box.normals) == 6
    assert len(box.faces) == 12
    origin = np.array([[0.0, 0.0, 5.0], [1.1, 0.0, 5.0], [-4.0, 0.0, 5.0], [0.5, 2.5, 5.0]])
    direction = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0]])
    t, plane = box.hit(origin, direction, np.full(4, np.inf))
    np.testing.assert_allclose(t, [2.0, np.inf, 5.0, np.inf], atol=1e-12)
    np.testing.assert_allclose(box.normals[plane[[0, 2]]], [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], atol=1e-12)
    a, b, c = (box.vertices[box.faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(24.0)  # positive: all normals point outward
