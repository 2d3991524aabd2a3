"""Surfaces of the bed: vertices where points are, holes where none are, and files that other libraries read."""

from dataclasses import replace

import numpy as np
import pytest
from small_survey import small_survey
from stored_run import plane_stored, run_of, stored_points

from evaluation.c2m import distance_to_mesh
from geo.reading import read_reference
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.meshes import bed_surface, oriented_normals
from survey.export.registry import ExportOptions
from survey.folder.survey import load_survey
from survey.run.flight import save_flight

SPACING_M = 0.1


def wavy(rng, *, half_m: float = 3.0, hole_m: float = 0.0) -> np.ndarray:
    """Points of a wavy bed, about one in each cell of the spacing, none within a distance of the middle."""
    along = np.arange(-half_m, half_m, SPACING_M)
    plan = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2) + rng.uniform(0.0, 0.05, (len(along) ** 2, 2))
    plan = plan[np.linalg.norm(plan, axis=1) > hole_m]
    return np.column_stack([plan, 0.3 * np.sin(2.0 * plan[:, 0])])


def surface(points, std=0.01, **options):
    options = {"spacing_m": SPACING_M, "method": "delaunay", "path": "bed.ply", **options}
    return bed_surface(replace(stored_points(points, None, std_m=std).bed, xyz=points), **options)


def up(mesh) -> np.ndarray:
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    return normal[:, 2] / np.linalg.norm(normal, axis=1)


def test_a_delaunay_surface_goes_through_points_and_faces_up(rng):
    points = wavy(rng)
    mesh = surface(points)
    assert {tuple(v) for v in mesh.vertices} <= {tuple(p) for p in points}
    assert len(mesh.vertices) > 0.9 * len(points)
    assert (up(mesh) > 0.0).all()
    assert (mesh.rgb == 100).all()


def test_of_a_cell_the_surest_point_stays(rng):
    points = wavy(rng)
    wrong = points + np.array([0.0, 0.0, 0.5])
    both, std = np.concatenate([points, wrong]), np.repeat([0.01, 0.2], len(points))
    std[-3:] = np.nan
    mesh = surface(both, std)
    assert {tuple(v) for v in mesh.vertices} <= {tuple(p) for p in points}


def test_a_hole_of_the_cloud_is_one_of_the_surface_unless_it_is_narrow(rng):
    wide, narrow = surface(wavy(rng, hole_m=1.0)), surface(wavy(rng, hole_m=0.15))
    middle = np.zeros((1, 3))
    assert np.linalg.norm(wide.vertices[wide.faces].mean(axis=1)[:, :2], axis=1).min() > 0.8
    assert abs(distance_to_mesh(middle, narrow.vertices, narrow.faces).signed[0]) < 0.05


@pytest.mark.parametrize("hole_m", [0.0, 1.0])
def test_a_watertight_mesh_is_a_body_of_the_right_volume(rng, hole_m):
    trimesh = pytest.importorskip("trimesh")
    points = wavy(rng, hole_m=hole_m)
    mesh = surface(points, watertight=True)
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert body.is_watertight
    assert body.is_winding_consistent
    top = surface(points)
    a, b, c = top.vertices[top.faces].swapaxes(0, 1)
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    floor = top.vertices[:, 2].min() - SPACING_M
    assert body.volume == pytest.approx(float((area * ((a + b + c)[:, 2] / 3.0 - floor)).sum()), rel=1e-9)


def test_parts_that_meet_in_one_vertex_are_closed_each_for_itself():
    trimesh = pytest.importorskip("trimesh")
    from survey.export.meshes import solid_of

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    vertices, faces, above = solid_of(corners, np.array([[0, 1, 2], [0, 3, 4]]), 0.5)
    body = trimesh.Trimesh(vertices, faces, process=False)
    assert body.is_watertight
    assert body.volume == pytest.approx(2 * 0.5 * 0.5)
    assert len(vertices) == 2 * 6
    np.testing.assert_array_equal(vertices[:, :2], corners[above, :2])


def test_normals_point_up_and_on_walls_to_the_side_that_is_open(rng):
    """A step of 1 m between two level parts: on its wall the normal points away from the upper part."""
    level = rng.uniform([-1.0, -1.0], [0.0, 1.0], (4000, 2))
    high = np.column_stack([level, np.full(4000, 1.0)])
    low = np.column_stack([level + np.array([1.0, 0.0]), np.zeros(4000)])
    wall = np.column_stack([np.zeros(4000), rng.uniform([-1.0, 0.0], [1.0, 1.0], (4000, 2))])
    normals = oriented_normals(np.concatenate([high, low, wall]) + rng.normal(0.0, 1e-3, (12000, 3)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (normals[:8000, 2] > 0.0).mean() > 0.999
    assert (normals[8000:, 0] > 0.0).mean() > 0.97


def test_points_that_lie_too_far_apart_are_refused(rng):
    line = np.column_stack([0.1 * np.arange(50.0), np.zeros(50), np.zeros(50)])
    for points in (wavy(rng)[:2], 100.0 * wavy(rng)[:50], line, line[:, ::-1]):
        with pytest.raises(SurveyError, match=r"make no surface at --resolution 0\.1"):
            surface(points)


def test_a_poisson_surface_is_near_the_points_and_trimmed_at_holes(rng):
    pytest.importorskip("open3d", reason="open3d is not installed: pip install 'bathynerf[mesh]'")
    points = wavy(rng, hole_m=1.0)
    mesh = surface(points, method="poisson")
    assert (up(mesh) > 0.0).mean() > 0.99
    assert np.abs(distance_to_mesh(points, mesh.vertices, mesh.faces).signed).max() < 0.05
    assert np.linalg.norm(mesh.vertices[:, :2], axis=1).min() > 0.75
    assert np.abs(mesh.vertices[:, :2]).max() < 3.0 + 2.0 * SPACING_M


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a cloud and its flight, and the cloud."""
    folder = tmp_path_factory.mktemp("mesh")
    stored = plane_stored(folder / "small")
    path = run_of(stored, folder / "run")
    save_flight(path, load_survey(small_survey(folder / "small")))
    return path, stored


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_an_exported_mesh_is_read_by_another_library_and_by_ours(run, tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    path, stored = run
    file = tmp_path / f"bed.{suffix}"
    options = ExportOptions(resolution_m=0.2)
    export(path, options=options, mesh=file)
    (theirs,) = trimesh.load_scene(file, process=False).geometry.values()
    ours = read_reference(file)
    assert len(theirs.faces) == len(ours.faces) > 5000
    colours = theirs.visual.vertex_attributes["color"] if suffix == "glb" else theirs.visual.vertex_colors
    assert np.ptp(colours[:, 0]) > 100
    # Of a GLB with the origin that its extras name.
    vertices = ours.vertices
    # OBJ has four decimals, GLB single precision 7 m from its origin.
    index = np.argmin(np.linalg.norm(stored.points_crs[:, None, :2] - vertices[None, ::500, :2], axis=2), axis=0)
    np.testing.assert_allclose(vertices[::500], stored.points_crs[index], atol=6e-5)
    before = file.read_bytes()
    export(path, options=replace(options, watertight=True), mesh=file)
    assert len(file.read_bytes()) > len(before), "an earlier mesh is replaced"


def test_a_mesh_in_another_crs_has_its_vertices_there(run, tmp_path):
    path, stored = run
    export(path, options=ExportOptions(crs="EPSG:4326", resolution_m=0.5), mesh=tmp_path / "bed.ply")
    mesh = read_reference(tmp_path / "bed.ply")
    assert b"comment crs EPSG:4326+5778\n" in (tmp_path / "bed.ply").read_bytes()[:200]
    assert abs(mesh.vertices[:, 0].mean() - 10.168) < 0.01
    np.testing.assert_allclose(np.ptp(mesh.vertices[:, 2]), np.ptp(stored.points_crs[:, 2]), atol=0.05)


def test_a_run_without_its_cameras_says_how_to_get_them(tmp_path):
    path = run_of(plane_stored(tmp_path / "small"), tmp_path / "run")
    with pytest.raises(SurveyError, match=r"was made before runs kept their cameras; run the same `bathynerf process`"):
        export(path, mesh=tmp_path / "bed.ply")
