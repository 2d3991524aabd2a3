"""The PSNR that noise and JPEG leave to a perfect rendering."""

from __future__ import annotations

import bench_picture_bound as bound
import numpy as np
import pytest
from PIL import Image


def test_noise_has_its_square_and_a_level_picture_is_stored_as_it_is(tmp_path, rng):
    path = tmp_path / "level.jpg"
    Image.new("RGB", (203, 155), (128, 128, 128)).save(path, quality=95, subsampling=0)
    noise, jpeg, both = bound.squared_errors(path, 2.0, rng)
    # Rounding adds a twelfth; the standard deviation of a mean of 90,000 squares is half a percent.
    assert noise == pytest.approx(4.0 + 1.0 / 12.0, rel=0.03)
    assert jpeg == 0.0
    # Quantization takes a part of the noise away with the finest detail, and adds its own.
    assert 0.5 < both < 8.0


def test_a_coarser_table_costs_more(tmp_path, rng):
    texture = rng.integers(60, 200, (80, 80, 3)).astype(np.uint8)
    errors = []
    for quality in (95, 60):
        path = tmp_path / f"{quality}.jpg"
        Image.fromarray(texture).save(path, quality=quality, subsampling=0)
        errors.append(bound.squared_errors(path, 0.0, rng)[1])
    assert 0.0 < 2.0 * errors[0] < errors[1]
