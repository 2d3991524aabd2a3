"""The light whose texture is matched, and the index of the water for it."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, shift
from small_survey import LEVEL, TOML, replaced, small_survey

from refract import water_index
from refract.media import converted_index, mixed_index, mixed_wavelength
from survey.errors import ConfigError
from survey.folder.survey import load_survey
from survey.photos.images import LUMA
from survey.photos.texture import matched_light, texture_of
from survey.settings.config import dump_config, parse_config

SODIUM_NM = 589.3


def _shares(pixels: np.ndarray) -> np.ndarray:
    products, _ = texture_of(pixels.astype(np.float32))
    return products / products.sum()


def test_an_index_of_the_sodium_line_becomes_that_of_the_channels_in_closed_form():
    shares = (0.1, 0.7, 0.2)
    by_hand = sum(
        share * float(water_index(nm, 15.0, 0.0)) for share, nm in zip(shares, (610.0, 540.0, 460.0), strict=True)
    )
    assert mixed_index(shares, 15.0, 0.0) == pytest.approx(by_hand, abs=1e-12)
    # Of the water that the conversion is for, and with little loss (0.5 mm of 10 m) of warm sea water.
    assert converted_index(float(water_index(SODIUM_NM, 15.0, 0.0)), SODIUM_NM, shares) == pytest.approx(
        by_hand, abs=1e-12
    )
    sea = float(water_index(SODIUM_NM, 28.0, 35.0))
    assert converted_index(sea, SODIUM_NM, shares) == pytest.approx(mixed_index(shares, 28.0, 35.0), abs=8e-5)
    # From the sodium line to green, 13 mm of 10 m.
    assert converted_index(1.333, 589.0, (0.0, 1.0, 0.0)) - 1.333 == pytest.approx(0.0017, abs=5e-5)


def test_the_wavelength_of_a_mixture_is_that_at_which_water_has_its_index():
    assert mixed_wavelength((0.0, 1.0, 0.0)) == pytest.approx(540.0, abs=1e-6)
    found = mixed_wavelength((0.3, 0.5, 0.2))
    assert water_index(found, 15.0, 0.0) == pytest.approx(mixed_index((0.3, 0.5, 0.2), 15.0, 0.0), abs=1e-12)


def test_the_shares_say_where_least_squares_of_grey_puts_channels_that_are_shifted_apart(rng):
    moved = np.array([-0.06, 0.01, 0.1])
    textures = [
        a * gaussian_filter(rng.standard_normal((300, 300)), s) for a, s in ((9.0, 2.0), (12.0, 1.5), (5.0, 3.0))
    ]
    before = np.stack(textures, axis=-1)
    after = np.stack([shift(t, (0.0, d), order=5) for t, d in zip(textures, moved, strict=True)], axis=-1)
    grey, seen = before @ LUMA, after @ LUMA
    inner = np.s_[10:-10, 10:-10]
    slope = np.gradient(grey, axis=1)[inner]
    found = -np.sum(slope * (seen - grey)[inner]) / np.sum(slope**2)
    assert found == pytest.approx(_shares(before) @ moved, abs=0.1 * np.ptp(moved))


def test_a_channel_of_noise_alone_has_no_share(rng):
    texture = gaussian_filter(rng.standard_normal((400, 400)), 2.0)
    pixels = np.stack([np.zeros_like(texture), 40.0 * texture, 20.0 * texture], axis=-1)
    noisy = pixels + rng.normal(0.0, 3.0, pixels.shape)
    red, green, blue = _shares(noisy)
    assert red == pytest.approx(0.0, abs=0.02)
    assert green / blue == pytest.approx(LUMA[1] * 40.0 / (LUMA[2] * 20.0), rel=0.05)


def test_what_a_mask_leaves_out_does_not_count(tmp_path, rng):
    survey = load_survey(small_survey(tmp_path / "s"))
    coarse = 128.0 + 60.0 * gaussian_filter(rng.standard_normal((48, 64)), 4.0) / 0.07
    green_left = np.stack([np.where(np.arange(64) < 32, 128.0, coarse), coarse, np.full_like(coarse, 128.0)], axis=-1)
    mask = np.repeat(np.where(np.arange(64) < 32, 255, 0)[None], 48, axis=0)
    for view in survey.views:
        Image.fromarray(np.clip(green_left, 0.0, 255.0).astype(np.uint8)).save(view.path, quality=95, subsampling=0)
    Image.fromarray(mask.astype(np.uint8)).save(tmp_path / "mask.png")
    masked = [replace(view, mask_path=tmp_path / "mask.png") for view in survey.views]
    assert matched_light(survey.views).shares[0] > 0.2
    assert matched_light(masked).shares == pytest.approx((0.0, 1.0, 0.0), abs=0.05)


def test_glint_is_no_texture(tmp_path, rng):
    survey = load_survey(small_survey(tmp_path / "s"))
    green = 128.0 + 60.0 * gaussian_filter(rng.standard_normal((48, 64)), 4.0) / 0.07
    pixels = np.stack([np.full_like(green, 128.0), np.clip(green, 0.0, 240.0), np.full_like(green, 128.0)], axis=-1)
    pixels[10:22, 10:30] = 255.0
    for view in survey.views:
        Image.fromarray(np.clip(pixels, 0.0, 255.0).astype(np.uint8)).save(view.path, quality=95, subsampling=0)
    assert matched_light(survey.views).shares == pytest.approx((0.0, 1.0, 0.0), abs=0.05)


def test_survey_toml_says_to_which_wavelength_its_index_belongs_and_the_settings_keep_what_took_effect(tmp_path):
    toml = replaced(("refractive_index = 1.333", "refractive_index = 1.333\nindex_wavelength_nm = 589.3"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    expected = converted_index(1.333, 589.3, LUMA)
    assert survey.water.n_water == pytest.approx(expected, abs=1e-6)
    assert any(
        text.startswith(f"refractive_index = {expected:.6f}, 1.333 at 589.3 nm for")
        for text in survey.findings.assumptions
    )
    again = parse_config(dump_config(survey.config)).water
    assert (again.refractive_index, again.index_wavelength_nm) == (survey.water.n_water, None)
    # Without a wavelength it is that of the light that is matched.
    assert load_survey(small_survey(tmp_path / "t", toml=TOML)).water.n_water == 1.333


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ("index_wavelength_nm = 589.3", "index_wavelength_nm is given without refractive_index"),
        ("refractive_index = 1.333\nindex_wavelength_nm = 0.589", "expected 400 to 700, the wavelengths of light"),
    ],
)
def test_a_wavelength_that_tells_nothing_is_refused(given, named):
    with pytest.raises(ConfigError, match=named):
        parse_config(f"[water]\nlevel_m = {LEVEL}\n{given}")
