"""What the benchmark of the survey field measures by: masts apart, held-out photographs, water pixels."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from plane_survey import look
from small_survey import small_survey

from refract import FlatWater
from survey.folder.survey import load_survey

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import bench_survey_field
    import survey_field_measures

    return SimpleNamespace(rows=bench_survey_field, measures=survey_field_measures)


def test_masts_are_told_from_hulls_and_slopes(benchmark, rng):
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
    found = benchmark.measures.is_mast(np.concatenate([points, mast]))
    assert not found[: len(points)].any()
    # Half a metre over the bed, give or take a cell of the slope.
    np.testing.assert_array_equal(found[len(points) :][up < 0.4], False)
    np.testing.assert_array_equal(found[len(points) :][up > 0.8], True)


def test_every_eighth_photograph_is_left_out_and_no_other(benchmark, tmp_path):
    survey = small_survey(tmp_path / "survey")
    before = sorted(p.name for p in survey.rglob("*"))
    table = benchmark.rows.held_survey(survey, tmp_path / "held")
    lines = (survey / "cameras.csv").read_text().splitlines()
    held, kept = table.read_text().splitlines(), (tmp_path / "held" / "cameras.csv").read_text().splitlines()
    assert held == [lines[0], *lines[1:][4::8]]
    assert sorted(held[1:] + kept[1:]) == sorted(lines[1:])
    assert sorted(p.name for p in (tmp_path / "held" / "images").iterdir()) == sorted(
        line.split(",")[0] for line in kept[1:]
    )
    assert sorted(p.name for p in survey.rglob("*")) == before
    assert len(load_survey(tmp_path / "held").views) == len(kept) - 1
    of_survey = benchmark.rows.kept_views(load_survey(survey), table)
    assert [view.name for view in of_survey] == [line.split(",")[0] for line in kept[1:]]


def test_water_pixels_stay_inside_the_bounds_down_to_the_bed(benchmark, monkeypatch):
    monkeypatch.setattr(benchmark.measures, "local_area", lambda _: (-1.0, -1.0, 1.0, 1.0))
    monkeypatch.setattr(benchmark.measures, "load_mask", lambda _: None)
    water = FlatWater((0.0, 0.0, 0.0))
    camera = look((4.0, 0.0, 10.0), (0.0, 0.0, 0.0), size=(64, 48), focal=150.0)
    found = benchmark.measures.water_pixels(SimpleNamespace(water=water), SimpleNamespace(camera=camera), 2.0)
    path = camera.paths(camera.pixel_centres(), water)
    ends = [path.at_height(np.full(found.shape, h), water)[..., :2] for h in (0.0, -1.0, -2.0)]
    inside = np.all([np.abs(xy).max(axis=-1) < 1.0 for xy in ends], axis=0)
    np.testing.assert_array_equal(found, inside)
    assert 0 < found.sum() < found.size


def test_a_summary_weighs_squared_errors_by_pixels(benchmark):
    views = [
        {"image": "a", "pixels": 300, "psnr_db": 40.0, "ssim": 0.9},
        {"image": "b", "pixels": 100, "psnr_db": 30.0},
        {"image": "c", "pixels": 0},
    ]
    found = benchmark.measures.summary(views)
    assert (found["images"], found["psnr_db"], found["ssim"]) == (2, 35.0, 0.9)
    assert found["psnr_pooled_db"] == pytest.approx(-10.0 * np.log10((3e-4 + 1e-3) / 4.0))


def test_views_are_chosen_evenly(benchmark, tmp_path):
    held = tmp_path / "held.csv"
    held.write_text("image\n" + "".join(f"{i}.jpg\n" for i in range(6)))
    assert benchmark.rows.some_of(held, 3).read_text().split() == ["image", "0.jpg", "2.jpg", "4.jpg"]
    assert benchmark.rows.some_of(held, None) == benchmark.rows.some_of(held, 6) == held
