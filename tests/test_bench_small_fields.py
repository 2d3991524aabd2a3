"""Errors over time, tables of fields and colours without water, as their benchmarks measure them."""

import bench_error_time
import bench_field
import numpy as np
import pytest
import switch_scene
import torch
from bench_true_colour import cell_means, chroma, differences, veiling_light
from gallery_canvas import bar_length, px_per_m
from plane_survey import look

from fields.water_column import WaterColumn
from refract import FlatWater
from survey.simulate.conditions import WaterOptics

ROW = {"seed": 0, "parameters_mb": 1.7, "step_s": 0.054, "train_mb": None, "steps_mb": 61.0, "steps": 1000,
       "rays_per_s": 54e3, "held_out_ssim": 0.9}  # fmt: skip


def row(name: str, model: str, psnr: float, distance: float, **changes) -> dict:
    return ROW | {"object": name, "model": model, "held_out_psnr_db": psnr, "chamfer_m": distance} | changes


def test_a_dry_scene_and_an_enlarged_one_show_the_same_surface(monkeypatch):
    monkeypatch.setattr(switch_scene, "VIEWS", 4)
    dry, wet = switch_scene.build(water=None), switch_scene.build(enlarged=2.0)
    assert dry.held.cameras[0].width == 96
    assert wet.held.cameras[0].width == 192
    assert wet.train.cameras[0].width == 96
    camera, length = dry.held.cameras[0], dry.length[0]
    known = np.isfinite(length)
    points = camera.centre + length[..., None] * camera.directions(camera.pixel_centres())
    assert points[known][:, 2].min() == pytest.approx(switch_scene.BED)
    assert points[known][:, 2].max() == pytest.approx(switch_scene.BLOCK[1][2])


def test_a_table_of_errors_has_each_model_once_with_what_it_reached():
    looks = [{"seconds": 1.0, "steps": 5, "psnr_db": 20.0, "depth_m": 0.3},
             {"seconds": 2.0, "steps": 9, "psnr_db": 25.04, "depth_m": 0.0504}]  # fmt: skip
    rows = [{"model": "mdw", "scene": "wet", "steps": 9, "looks": looks}]
    assert bench_error_time.table(rows)[2:] == ["| MDW | - | - | - | 9 | 25.0 dB | 50 mm |"]
    # Of two seeds half of Student's interval is 12.7 times the standard deviation of their mean.
    rows.append({"model": "mdw", "scene": "wet", "steps": 11, "looks": [looks[-1] | {"psnr_db": 25.24}]})
    assert bench_error_time.table(rows)[2:] == ["| MDW | - | - | - | 10 ± 13 | 25.1 ± 1.3 dB | 50 ± 0 mm |"]


def test_colours_differ_by_their_chroma_alone():
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


def test_of_several_seeds_stand_the_mean_and_its_interval():
    rows = [row("ship", "vm", 28.0, 0.046), row("ship", "vm", 29.0, 0.046, seed=1)]
    rows += [row("ship", "mdw", 29.0, 0.046), row("ship", "mdw", 30.0, 0.046, seed=1)]
    found = bench_field.table_of(rows).splitlines()[2:]
    assert found[0].startswith("| ship | VM | 28.50 ± 6.35 dB | 0.900 ± 0.000 | 46.0 ± 0.0 mm | 1.70 MB | 61 MB |")
    assert found[1].startswith("| ship | MDW | 29.50 ± 6.35 dB (+1.00 ± 0.00) | 0.900 ± 0.000 | 46.0 ± 0.0 mm (x 1.00")


def test_a_scale_bar_is_a_round_length_of_a_quarter_of_the_picture_at_most():
    assert [bar_length(width) for width in (8.0, 7.9, 21.0, 0.5)] == pytest.approx([2.0, 1.0, 5.0, 0.1])
    camera = look((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), size=(64, 48), focal=150.0)
    middle, water = (camera.cx, camera.cy), FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    assert px_per_m(camera, water, middle, 2.0) == pytest.approx(150.0 / 8.0)
    # Straight down, water of depth d is as far as d / n of air; beside it by the square of half a pixel's angle.
    assert px_per_m(camera, water, middle, -4.0) == pytest.approx(150.0 / (10.0 + 4.0 / 1.333), rel=1e-5)
