"""Photographs that look as if they showed water are named where no water was given, and those of dry land are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image
from small_survey import TOML, small_survey

from survey.photos.texture import SIZE, looks_like_water
from survey.plan.check import require_processable


def ground(seed: int, *, size=SIZE) -> np.ndarray:
    """Grass and gravel: texture everywhere."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(0.7, 1.3, (12, 16)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    fine = rng.normal(1.0, 0.2, (size[1], size[0])).astype(np.float32)
    return np.clip(np.array([130.0, 140.0, 80.0]) * (coarse * fine)[..., None], 0, 255).astype(np.uint8)


def lake(seed: int, colour, share: float, *, size=SIZE) -> np.ndarray:
    """A part of the picture with a little noise of one colour."""
    pixels, rng = ground(seed, size=size), np.random.default_rng(seed)
    wide = round(share * size[0])
    pixels[:, :wide] = np.clip(np.array(colour) + rng.normal(0.0, 1.5, (size[1], wide, 1)), 0, 255)
    return pixels


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("colour", [(60, 75, 60), (30, 60, 90), (90, 80, 60), (20, 22, 20), (90, 150, 150)])
def test_a_lake_looks_like_water_and_a_puddle_and_dry_land_do_not(seed, colour):
    assert looks_like_water(lake(seed, colour, 0.25))
    assert not looks_like_water(lake(seed, colour, 0.03))
    assert not looks_like_water(ground(seed))


@pytest.mark.parametrize("colour", [(190, 180, 160), (150, 150, 150), (230, 230, 235)])
def test_sand_roads_and_snow_do_not(colour):
    assert not looks_like_water(lake(1, colour, 0.4))


def test_a_black_border_does_not():
    pixels = ground(2)
    pixels[:, :60] = pixels[:40] = 0
    assert not looks_like_water(pixels)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("given", ["nothing", "dry", "water"])
def test_check_names_the_photographs_where_no_water_is_given(tmp_path, suffix, given):
    bare = TOML[: TOML.index("[water]")]
    toml = {"nothing": bare, "dry": f"dry = true\n{bare}", "water": TOML}[given]
    folder = small_survey(tmp_path / "s", toml=toml)
    for i, path in enumerate(sorted((folder / "images").iterdir())):
        pixels = ground(i, size=(64, 48)) if i != 2 else lake(i, (40, 60, 70), 0.4, size=(64, 48))
        path.unlink()
        Image.fromarray(pixels).save(path.with_suffix(f".{suffix}"))
    cameras = folder / "cameras.csv"
    cameras.write_text(cameras.read_text().replace(".jpg", f".{suffix}"))
    found = [line for line in require_processable(folder).warnings if "look like water" in line]
    assert [line.endswith(f"give [water] level_m: 0002.{suffix}") for line in found] == [True] * (given == "nothing")
