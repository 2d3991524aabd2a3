"""Drawn surveys: geometry that is projected back onto its pixels, and what photographs hold."""

import dataclasses

import numpy as np
import pytest
from drawn_shore import EXACT_M, EXACT_PX, SHORE, STORED_PX
from PIL import Image

from geo import read_reference
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.settings.config import read_config
from survey.simulate.drawn import DrawnScene, draw_survey, stage_drawing


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
