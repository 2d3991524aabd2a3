"""The drawn survey: its renderer is exact, and its truth is what it drew."""

from __future__ import annotations

import numpy as np
from drawn_shore import EXACT_M, EXACT_PX, STORED_PX

from geo import read_reference
from survey.folder.survey import load_survey
from survey.settings.config import read_config
from survey.simulate.drawn import DrawnScene, stage_drawing


def hits_of_all(drawing, rng, count=400):
    """Camera, pixels and hits for some pixels of every camera."""
    for camera in drawing.cameras:
        pixels = rng.uniform((0.0, 0.0), (camera.width, camera.height), (count, 2))
        yield camera, pixels, drawing.renderer.trace(camera, pixels)


def stands_before(drawing, start, end, steps=1000):
    """Whether anything solid covers the straight way from start to end (N, 3), by looking at many points of it."""
    share = np.linspace(0.0, 0.999, steps)[:, None, None]
    points = start + share * (end - start)
    ground = drawing.renderer.ground
    covered = points[..., 2] < ground.bed.height(points[..., 0], points[..., 1]) - 1e-6
    for solid in ground.solids:
        near = np.linalg.norm(points - solid.centre, axis=-1) < solid.radius
        covered[near] |= (points[near] @ solid.normals.T < solid.offsets - 1e-6).all(axis=-1)
    return covered.any(axis=0)


def crossing_by_snell(camera, points, water):
    """Where rays cross a level or tilted plane through the origin, by bisection on Snell's law: a slow reference."""
    normal = np.array(water.up)
    H, depth = camera.centre @ normal, -(points @ normal)
    foot_c, foot_p = camera.centre - H * normal, points + depth[:, None] * normal
    way = foot_c - foot_p
    D = np.linalg.norm(way, axis=1)
    low, high = np.zeros(len(points)), D.copy()
    for _ in range(60):
        x = 0.5 * (low + high)
        too_near = water.n_water * x / np.hypot(x, depth) < (D - x) / np.hypot(D - x, H)
        low, high = np.where(too_near, x, low), np.where(too_near, high, x)
    return np.where((depth > 0.0)[:, None], foot_p + (x / D)[:, None] * way, points)


def test_points_seen_by_the_renderer_are_projected_back_onto_their_pixels_by_refract(shore_drawing, rng):
    for camera, pixels, hits in hits_of_all(shore_drawing, rng):
        back = camera.project(hits.points, shore_drawing.water)
        assert np.abs(back - pixels).max() < EXACT_PX


def test_a_survey_read_from_its_folder_projects_the_drawn_points_onto_their_pixels(shore_drawing, shore_folder, rng):
    survey = load_survey(shore_folder)
    assert [view.name for view in survey.views] == shore_drawing.names
    for view, (_, pixels, hits) in zip(survey.views, hits_of_all(shore_drawing, rng, 50), strict=True):
        points = survey.frame.local_from_crs(shore_drawing.frame.crs_from_local(hits.points))
        assert np.abs(view.camera.project(points, survey.water) - pixels).max() < STORED_PX


def test_wet_and_dry_pixels_both_occur_at_a_shore(shore_drawing, rng):
    wet = np.concatenate([hits.in_water > 0.0 for _, _, hits in hits_of_all(shore_drawing, rng)])
    assert 0.2 < wet.mean() < 0.9


def test_paths_obey_snells_law_at_the_water_surface(shore_drawing, rng):
    normal = np.array(shore_drawing.water.up)
    for camera, pixels, hits in hits_of_all(shore_drawing, rng):
        wet = hits.in_water > 0.0
        ray, points = camera.directions(pixels)[wet], hits.points[wet]
        crossing = camera.centre + (camera.centre @ normal / -(ray @ normal))[:, None] * ray
        leg = points - crossing
        np.testing.assert_allclose(np.linalg.norm(leg, axis=1), hits.in_water[wet], atol=1e-12)
        bent = leg / hits.in_water[wet, None]
        # Beside the shoreline the leg is short, and its direction as uncertain as rounding over its length.
        tolerance = 1e-12 + 1e-14 / hits.in_water[wet].min()
        np.testing.assert_allclose(np.cross(ray, normal), 1.333 * np.cross(bent, normal), atol=tolerance)


def test_without_a_step_in_index_rays_are_straight(rng):
    drawing = stage_drawing(DrawnScene.tiny(n_water=1.0))
    dry = stage_drawing(DrawnScene.tiny(water=False))
    for (camera, pixels, hits), bare in zip(hits_of_all(drawing, rng, 100), dry.cameras, strict=True):
        straight = np.cross(hits.points - camera.centre, camera.directions(pixels))
        assert np.abs(straight).max() < 1e-12
        np.testing.assert_allclose(dry.renderer.trace(bare, pixels).points, hits.points, atol=1e-12)


def test_hits_lie_on_the_ground_and_nothing_stands_before_them(shore_drawing, rng):
    for camera, _, hits in hits_of_all(shore_drawing, rng, 60):
        ground = shore_drawing.renderer.ground
        on_bed = hits.body < 0
        over = hits.points[:, 2] - ground.bed.height(hits.points[:, 0], hits.points[:, 1])
        assert np.abs(over[on_bed]).max() < 1e-9
        for index, solid in enumerate(ground.solids):
            beyond = hits.points[hits.body == index] @ solid.normals.T - solid.offsets
            np.testing.assert_allclose(beyond.max(axis=1, initial=0.0), 0.0, atol=1e-9)
        crossing = crossing_by_snell(camera, hits.points, shore_drawing.water)
        top = camera.centre + 0.9 * (crossing - camera.centre)
        assert not stands_before(shore_drawing, top, crossing).any()
        assert not stands_before(shore_drawing, crossing, hits.points).any()


def test_the_reference_is_the_bed_that_was_drawn_and_fills_the_bounds(shore_drawing, shore_folder):
    mesh = read_reference(shore_folder / "truth" / "reference.ply")
    local = shore_drawing.frame.local_from_crs(mesh.vertices)
    ground = shore_drawing.renderer.ground
    of_bodies = sum(len(solid.vertices) for solid in ground.solids)
    bed, bodies = local[: len(local) - of_bodies], local[len(local) - of_bodies :]
    assert np.abs(bed[:, 2] - ground.bed.height(bed[:, 0], bed[:, 1])).max() < EXACT_M
    np.testing.assert_allclose(bodies, np.concatenate([s.vertices for s in ground.solids]), atol=EXACT_M)
    centroids = local[mesh.faces[(mesh.faces < len(bed)).all(axis=1)]].mean(axis=1)
    # Triangles of the mesh, not only their corners, lie in the surface that rays meet.
    on_bed = ground.bed.height(centroids[:, 0], centroids[:, 1])
    assert np.abs(centroids[:, 2] - on_bed).max() < EXACT_M
    bed_crs = mesh.vertices[: len(bed)]
    e0, n0, e1, n1 = read_config(shore_folder / "survey.toml").area.bounds
    assert (bed_crs[:, :2].min(axis=0) < (e0, n0)).all()
    assert (bed_crs[:, :2].max(axis=0) > (e1, n1)).all()


def test_visible_points_are_seen_by_three_cameras_along_ways_that_nothing_covers(shore_drawing, shore_folder, rng):
    cloud = read_reference(shore_folder / "truth" / "visible.ply")
    points = shore_drawing.frame.local_from_crs(cloud.points)
    points = points[rng.choice(len(points), 200, replace=False)]
    num_views = np.zeros(len(points), dtype=int)
    for camera in shore_drawing.cameras:
        pixels = camera.project(points, shore_drawing.water)
        crossing = crossing_by_snell(camera, points, shore_drawing.water)
        top = camera.centre + 0.9 * (crossing - camera.centre)
        free = ~stands_before(shore_drawing, top, crossing) & ~stands_before(shore_drawing, crossing, points)
        num_views += free & ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
    assert num_views.min() >= 3


def test_the_bed_under_the_boat_is_in_the_reference_but_not_visible(shore_drawing, shore_folder):
    boat = shore_drawing.renderer.ground.solids[0]

    def num_inside(points_crs):
        points = shore_drawing.frame.local_from_crs(points_crs)
        return (points @ boat.normals.T < boat.offsets - 0.001).all(axis=1).sum()

    assert num_inside(read_reference(shore_folder / "truth" / "reference.ply").vertices) > 50
    assert num_inside(read_reference(shore_folder / "truth" / "visible.ply").points) == 0
