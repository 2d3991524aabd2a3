"""`bench_field --write` writes the tables that the page has."""

from __future__ import annotations

import re
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


def on_page(name: str) -> list[str]:
    text = (ROOT / "docs" / "notes" / "field.md").read_text(encoding="utf-8")
    return re.split(f"<!-- {name}: (?:begin|end) -->", text)[1].strip().split("\n")


def test_the_ablation_has_the_columns_of_the_page(tables):
    rows = [row("wreck", "vm", 32.1, 0.1113), row("wreck", "mdw", 33.7, 0.0964, parameters_mb=0.646, step_s=0.0643)]
    found = tables.ablation_table(rows)
    assert found[:2] == on_page("ablation")[:2]
    assert found[2] == "| wreck | VM | 32.10 dB | 111.3 mm | 1.70 MB | 61 MB | 54 ms |"
    assert (
        found[3] == "| wreck | MDW | 33.70 dB (+1.60) | 96.4 mm (x 0.87) | 0.65 MB (x 0.38) | 61 MB | 64 ms (x 1.19) |"
    )


def test_all_models_stand_in_a_row_each_with_their_seeds_side_by_side(tables):
    rows = [
        row("wreck", "vm", 31.8, 0.122), row("ship", "vm", 28.3, 0.046), row("ship", "vm", 28.5, 0.045, seed=1),
        row("hull", "vm", 34.3, 0.060), row("hull", "vm", 35.0, 0.058, parameters_mb=1.75),
        row("hull", "nerfacto", 39.7, 0.061, parameters_mb=33.7),
    ]  # fmt: skip
    found = tables.models_table(rows)
    assert found[:2] == on_page("models")[:2]
    assert found[2] == "| VM | 31.8 dB; 122 mm | 28.3, 28.5 dB; 46, 45 mm | 34.3, 35.0 dB; 60, 58 mm | 1.75 MB |"
    assert found[3] == "| Nerfacto | not run | not run | 39.7 dB; 61 mm | 33.70 MB |"
    assert set(tables.PAGE) == {"ablation", "models", "seeds"}


def test_of_several_seeds_stand_the_mean_and_its_interval(tables):
    rows = [row("ship", "vm", 28.0, 0.046), row("ship", "vm", 29.0, 0.046, seed=1)]
    rows += [row("ship", "mdw", 29.0, 0.046), row("ship", "mdw", 30.0, 0.046, seed=1)]
    found = tables.seeds_table(rows)
    assert found[:2] == on_page("seeds")[:2]
    assert found[2] == "| ship | VM | 28.50 ± 6.35 dB | 46.0 ± 0.0 mm | 1.70 MB | 61 MB | 54.0 ms |"
    assert found[3].startswith("| ship | MDW | 29.50 ± 6.35 dB (+1.00 ± 0.00) | 46.0 ± 0.0 mm (x 1.00 ± 0.00) |")


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
