"""Plants of drawn surveys: leaves keep their length, and what rises over the bed is told from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def benches(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import bench_plants
    import plant_scenes

    return bench_plants, plant_scenes


def test_a_leaf_keeps_its_length_however_it_leans(benches):
    _, scenes = benches
    leaf = scenes.Leaf(np.array([1.0, 2.0, -3.0]), 0.5, 0.3, 0.0)
    for lean in ((0.0, 0.0), (0.3, -0.1)):
        top = leaf.solid(np.array(lean)).vertices
        tip = top[top[:, 2] > -2.9].mean(axis=0)
        assert np.linalg.norm(tip - leaf.foot) == pytest.approx(0.5)
        np.testing.assert_allclose(tip[:2] - leaf.foot[:2], 0.5 * np.array(lean), atol=1e-12)


def test_a_survey_that_other_code_drew_is_drawn_again(benches, monkeypatch, tmp_path):
    _, scenes = benches
    settings, changed = [], tmp_path / "plant_scenes.py"
    monkeypatch.setattr(scenes, "write_survey", lambda folder, of, stage: settings.append(of))
    monkeypatch.setattr(scenes.PlantSurvey, "leaves", lambda self, bed: [])
    staged = scenes.stage_drawing(scenes.PlantSurvey(0).scene)
    monkeypatch.setattr(scenes, "stage_drawing", lambda scene: staged)
    changed.write_text("LEAVES = 23")
    for file in (scenes.__file__, scenes.__file__, str(changed)):
        monkeypatch.setattr(scenes, "__file__", file)
        scenes.PlantSurvey(0).draw(tmp_path / "survey")
    assert settings[0] == settings[1] != settings[2]


def test_what_rises_over_the_bed_is_plant_and_the_bed_beneath_it_is_where_it_was(benches, rng):
    bench, scenes = benches
    xy = rng.uniform(-2.0, 2.0, (6000, 2))
    bed = -2.0 + 0.05 * xy[:, 0]
    tall = (np.hypot(*xy.T) < 0.4) & (rng.random(6000) < 0.5)
    true = np.column_stack([xy, bed + np.where(tall, 0.4, 0.0)])
    points = true + np.array([0.0, 0.0, 1.0]) * rng.normal(0.0, 0.005, (6000, 1))
    plant, low = bench.classes(points)
    np.testing.assert_array_equal(plant, tall)
    # The low of a cell of a slope of 5 %, and noise.
    assert np.abs(low - bed)[np.abs(xy).max(axis=1) < 1.4].max() < 0.02
    leaves = [scenes.Leaf(np.array([0.0, 0.0, -2.0]), 0.4, 0.0, 0.0)]

    class Level:
        @staticmethod
        def height(x, y):
            return -2.0 + 0.05 * x

    row = bench.figures(points, true, leaves, Level())
    assert row[:3] == [1.0, 1.0, 1.0]
    assert row[3:5] == [0.0, 0.0]
    assert abs(row[5]) < 0.002
    assert abs(row[6]) < 0.02
