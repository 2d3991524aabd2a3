"""Errors over time and colours without water, as their benchmarks measure them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")


def test_a_dry_scene_and_an_enlarged_one_show_the_same_surface(monkeypatch):
    from switch_scene import BED, BLOCK, build

    monkeypatch.setattr("switch_scene.VIEWS", 4)
    dry, wet = build(water=None), build(enlarged=2.0)
    assert dry.held.cameras[0].width == 96
    assert wet.held.cameras[0].width == 192
    assert wet.train.cameras[0].width == 96
    camera, length = dry.held.cameras[0], dry.length[0]
    known = np.isfinite(length)
    points = camera.centre + length[..., None] * camera.directions(camera.pixel_centres())
    assert points[known][:, 2].min() == pytest.approx(BED)
    assert points[known][:, 2].max() == pytest.approx(BLOCK[1][2])


def test_a_table_of_errors_has_each_model_once_with_what_it_reached():
    from bench_error_time import table

    looks = [{"seconds": 1.0, "steps": 5, "psnr_db": 20.0, "depth_m": 0.3},
             {"seconds": 2.0, "steps": 9, "psnr_db": 25.04, "depth_m": 0.0504}]  # fmt: skip
    rows = [{"model": "mdw", "scene": "wet", "steps": 9, "looks": looks}]
    assert table(rows)[2:] == ["| MDW | - | - | - | 9 | 25.0 dB | 50 mm |"]
    # Of two seeds half of Student's interval is 12.7 times the standard deviation of their mean.
    rows.append({"model": "mdw", "scene": "wet", "steps": 11, "looks": [looks[-1] | {"psnr_db": 25.24}]})
    assert table(rows)[2:] == ["| MDW | - | - | - | 10 ± 13 | 25.1 ± 1.3 dB | 50 ± 0 mm |"]


def test_errors_over_time_are_measured_again_for_each_model_scene_and_time(tmp_path, monkeypatch, capsys):
    import bench_error_time

    measured = []

    def measure(name, where, seconds, seed):
        measured.append((name, where, seconds, seed))
        looks = [{"seconds": seconds, "steps": 5, "psnr_db": 20.0, "depth_m": 0.3}]
        return {"model": name, "scene": where, "seed": seed, "steps": 9, "looks": looks}

    monkeypatch.setattr(bench_error_time, "measure", measure)
    for seconds in ("2", "2", "3"):
        words = ["bench_error_time.py", str(tmp_path), "--models", "mdw", "--seconds", seconds]
        monkeypatch.setattr("sys.argv", words)
        bench_error_time.main()
    assert measured == [("mdw", where, seconds, 0) for seconds in (2.0, 3.0) for where in ("dry", "wet")]
    assert "| MDW | 9 | 20.0 dB | 300 mm | 9 | 20.0 dB | 300 mm |" in capsys.readouterr().out


def test_colours_differ_by_their_chroma_alone():
    from bench_true_colour import cell_means, chroma, differences

    grey = np.full((1, 3), 0.4)
    np.testing.assert_allclose(chroma(grey), 0.0, atol=0.02)  # OpenCV's table
    # Red of sRGB in CIELAB under D65.
    np.testing.assert_allclose(chroma(np.array([[1.0, 0.0, 0.0]])), [[80.1, 67.2]], atol=0.2)
    bed = np.random.default_rng(0).uniform(0.1, 0.5, (50, 3))
    np.testing.assert_allclose(differences(0.6 * bed, bed), 0.0, atol=0.02)
    assert differences(bed * (0.5, 1.0, 1.0), bed).min() > 1.0
    xyz = np.repeat([[0.1, 0.1, 0.0], [0.4, 0.1, 0.0], [0.9, 0.9, 0.0]], [12, 10, 3], axis=0)
    assert cell_means(xyz, np.arange(25.0)[:, None]).ravel().tolist() == [5.5, 16.5]


def test_absorption_and_veil_of_a_drawn_scene_give_its_bed_back():
    from bench_true_colour import veiling_light

    from fields.water_column import WaterColumn
    from survey.simulate.water import WaterOptics

    optics, depth = WaterOptics(), np.linspace(0.1, 4.0, 40)
    bed = np.random.default_rng(0).uniform(0.1, 0.5, (40, 3))
    seen = torch.from_numpy(optics.seen_through(bed, depth, depth)).float()
    way, none = torch.from_numpy(2.0 * depth).float(), torch.zeros(40)

    def error(veil) -> float:
        column = WaterColumn(absorption=optics.absorption, veil=veil)
        return float(np.abs(column.bed_of(seen, way, none).detach().numpy() - bed).max())

    # The two veils build up differently with depth: 0.0008 in red, which 8 m of water divide by 0.26.
    assert error(veiling_light(optics, 4.0)) < 0.004
    assert error((0.0, 0.0, 0.0)) > 0.04
