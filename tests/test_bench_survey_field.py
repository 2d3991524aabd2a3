"""What the benchmark of the survey field measures by: masts, held-out photographs, water pixels, steps of depth."""

from types import SimpleNamespace

import bench_survey_field as benchmark
import numpy as np
import pytest
from plane_survey import look
from small_survey import small_survey

from refract import FlatWater
from survey.folder.survey import load_survey
from survey.simulate.shapes import TriangleMesh

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
BED, TOP = -3.0, -1.0


def test_masts_are_told_from_hulls_and_slopes(rng):
    x, y = rng.uniform(0.0, 12.0, (2, 40_000))
    bed = -4.0 + 0.3 * x
    hull = np.hypot(x - 6.0, y - 6.0) < 1.5
    toward, high = rng.uniform(0.0, [[2.0 * np.pi], [2.0]], (2, 4000))
    side = np.column_stack(
        [6.0 + 1.5 * np.sin(toward), 6.0 + 1.5 * np.cos(toward), -2.2 + 0.45 * np.sin(toward) + high]
    )
    points = np.concatenate([np.column_stack([x, y, bed + 2.0 * hull]), side])
    up = rng.uniform(0.0, 3.0, 200)
    mast = np.column_stack([3.0 + rng.uniform(-0.1, 0.1, (200, 2)), -3.1 + up])
    found = benchmark.is_mast(np.concatenate([points, mast]))
    assert not found[: len(points)].any()
    # Half a metre over the bed, give or take a cell of the slope.
    np.testing.assert_array_equal(found[len(points) :][up < 0.4], False)
    np.testing.assert_array_equal(found[len(points) :][up > 0.8], True)


def test_every_eighth_photograph_is_left_out_and_no_other(tmp_path):
    survey = small_survey(tmp_path / "survey")
    before = sorted(p.name for p in survey.rglob("*"))
    table = benchmark.held_survey(survey, tmp_path / "held")
    lines = (survey / "cameras.csv").read_text().splitlines()
    held, kept = table.read_text().splitlines(), (tmp_path / "held" / "cameras.csv").read_text().splitlines()
    assert held == [lines[0], *lines[1:][4::8]]
    assert sorted(held[1:] + kept[1:]) == sorted(lines[1:])
    assert sorted(p.name for p in (tmp_path / "held" / "images").iterdir()) == sorted(
        line.split(",")[0] for line in kept[1:]
    )
    assert sorted(p.name for p in survey.rglob("*")) == before
    assert len(load_survey(tmp_path / "held").views) == len(kept) - 1
    of_survey = benchmark.kept_views(load_survey(survey), table)
    assert [view.name for view in of_survey] == [line.split(",")[0] for line in kept[1:]]


def test_water_pixels_stay_inside_the_bounds_down_to_the_bed(monkeypatch):
    monkeypatch.setattr(benchmark, "local_area", lambda _: (-1.0, -1.0, 1.0, 1.0))
    monkeypatch.setattr(benchmark, "load_mask", lambda _: None)
    water = FlatWater((0.0, 0.0, 0.0))
    camera = look((4.0, 0.0, 10.0), (0.0, 0.0, 0.0), size=(64, 48), focal=150.0)
    found = benchmark.water_pixels(SimpleNamespace(water=water), SimpleNamespace(camera=camera), 2.0)
    path = camera.paths(camera.pixel_centres(), water)
    ends = [path.at_height(np.full(found.shape, h), water)[..., :2] for h in (0.0, -1.0, -2.0)]
    inside = np.all([np.abs(xy).max(axis=-1) < 1.0 for xy in ends], axis=0)
    np.testing.assert_array_equal(found, inside)
    assert 0 < found.sum() < found.size


def test_a_summary_weighs_squared_errors_by_pixels():
    views = [
        {"image": "a", "pixels": 300, "psnr_db": 40.0, "ssim": 0.9},
        {"image": "b", "pixels": 100, "psnr_db": 30.0},
        {"image": "c", "pixels": 0},
    ]
    found = benchmark.summary(views)
    assert (found["images"], found["psnr_db"], found["ssim"]) == (2, 35.0, 0.9)
    assert found["psnr_pooled_db"] == pytest.approx(-10.0 * np.log10((3e-4 + 1e-3) / 4.0))


def test_views_are_chosen_evenly(tmp_path):
    held = tmp_path / "held.csv"
    held.write_text("image\n" + "".join(f"{i}.jpg\n" for i in range(6)))
    assert benchmark.some_of(held, 3).read_text().split() == ["image", "0.jpg", "2.jpg", "4.jpg"]
    assert benchmark.some_of(held, None) == benchmark.some_of(held, 6) == held


def block() -> TriangleMesh:
    """A bed of 20 m and a block of 2 m on it, without its underside."""

    def quad(*corners):
        return [corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]

    square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    faces = [*quad(*((10 * x, 10 * y, BED) for x, y in square)), *quad(*((x, y, TOP) for x, y in square))]
    for (x0, y0), (x1, y1) in zip(square, square[1:] + square[:1], strict=True):
        faces += quad((x0, y0, BED), (x1, y1, BED), (x1, y1, TOP), (x0, y0, TOP))
    vertices = np.array(faces).reshape(-1, 3)
    return TriangleMesh(vertices, np.arange(len(vertices)).reshape(-1, 3))


def test_true_points_lie_on_the_surface_at_their_length_of_the_bent_path():
    camera = look((2.0, 0.0, 10.0), (0.0, 0.0, -2.0), size=(40, 30), focal=80.0)
    distance, points = benchmark.true_points(camera, WATER, block())
    np.testing.assert_allclose(camera.paths(camera.pixel_centres(), WATER).at(distance), points, atol=1e-9)
    on_bed, on_top = (np.abs(points[..., 2] - z) < 1e-9 for z in (BED, TOP))
    beside = np.abs(np.abs(points[..., :2]).max(axis=-1) - 1.0) < 1e-9
    assert (on_bed | on_top | beside).all()
    assert on_bed.any()
    assert on_top.any()
    thinned, _ = benchmark.true_points(camera, WATER, block(), 4)
    np.testing.assert_array_equal(thinned, distance[2::4, 2::4])


def test_pixels_beside_a_step_are_those_within_reach_of_it_and_a_slope_is_none():
    distance = np.full((20, 30), 10.0)
    distance[:, 15:] = 11.0
    found = benchmark.near_steps(distance, 100.0)
    np.testing.assert_array_equal(np.flatnonzero(found[0]), np.arange(14 - 5, 15 + 6))
    assert (found == found[0]).all()
    # A rise by 0.3 m over a pixel of 0.1 m, steep and no step.
    assert not benchmark.near_steps(10.0 + 0.3 * np.arange(30.0)[None] * np.ones((20, 1)), 100.0).any()


def test_places_behind_the_block_are_not_seen():
    cameras = [look((x, 0.0, 10.0), (0.0, 0.0, -2.0), size=(240, 180), focal=260.0) for x in (-8.0, 0.0, 8.0)]
    points = np.array([[[0.0, 0.0, TOP], [1.5, 0.0, BED], [-1.5, 0.0, BED], [np.nan] * 3, [90.0, 0.0, BED]]])
    assert benchmark.sightings(points, cameras, WATER, block()).tolist() == [[3, 2, 2, 0, 0]]
