"""The table of `bench_field`, and scale bars of its pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROW = {"seed": 0, "parameters_mb": 1.7, "step_s": 0.054, "train_mb": None, "steps_mb": 61.0, "steps": 1000,
       "rays_per_s": 54e3}  # fmt: skip


def row(name: str, model: str, psnr: float, distance: float, **changes) -> dict:
    return ROW | {"object": name, "model": model, "held_out_psnr_db": psnr, "chamfer_m": distance} | changes


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import field_tables

    return field_tables


def test_of_several_seeds_stand_the_mean_and_its_interval(tables):
    rows = [row("ship", "vm", 28.0, 0.046), row("ship", "vm", 29.0, 0.046, seed=1)]
    rows += [row("ship", "mdw", 29.0, 0.046), row("ship", "mdw", 30.0, 0.046, seed=1)]
    found = tables.table_of(rows).splitlines()[2:]
    assert found[0].startswith("| ship | VM | 28.50 ± 6.35 dB | 46.0 ± 0.0 mm | 1.70 MB | 61 MB | 1000 | 54.0 ms |")
    assert found[1].startswith("| ship | MDW | 29.50 ± 6.35 dB (+1.00 ± 0.00) | 46.0 ± 0.0 mm (x 1.00 ± 0.00) |")


def test_a_scale_bar_is_a_round_length_of_a_quarter_of_the_picture_at_most(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from gallery_canvas import bar_length, px_per_m
    from plane_survey import look

    from refract import FlatWater

    assert [bar_length(width) for width in (8.0, 7.9, 21.0, 0.5)] == pytest.approx([2.0, 1.0, 5.0, 0.1])
    camera = look((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), size=(64, 48), focal=150.0)
    middle, water = (camera.cx, camera.cy), FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    assert px_per_m(camera, water, middle, 2.0) == pytest.approx(150.0 / 8.0)
    # Straight down, water of depth d is as far as d / n of air; beside it by the square of half a pixel's angle.
    assert px_per_m(camera, water, middle, -4.0) == pytest.approx(150.0 / (10.0 + 4.0 / 1.333), rel=1e-5)
