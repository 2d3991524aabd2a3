"""Exposures of the photographs that novel views are blended of."""

from __future__ import annotations

import numpy as np
import pytest

from survey.export.novel_views import attenuation_per_metre, log_exposures

ABSORPTION = (0.3, 0.1, 0.05)


def test_what_water_takes_along_a_path_is_told_from_the_colours_of_the_bed(rng):
    bed, slant = rng.normal(4.0, 0.5, (500, 3)), rng.uniform(1.0, 1.3, (12, 500))
    lengths = slant * rng.uniform(0.5, 6.0, 500)
    shown = bed - lengths[..., None] * ABSORPTION
    shown[rng.random(lengths.shape) < 0.3] = np.nan
    np.testing.assert_allclose(attenuation_per_metre(shown, lengths), np.negative(ABSORPTION), rtol=1e-3)


def test_dry_photographs_have_no_change_with_the_path(rng):
    shown = rng.normal(4.0, 0.5, (5, 40, 3))
    assert not attenuation_per_metre(shown, np.zeros((5, 40))).any()


@pytest.mark.parametrize("along", [0.4, -0.4, 0.0])
def test_exposures_that_go_with_the_path_are_told_from_the_water(rng, along):
    bed, depth, slant = rng.normal(4.0, 0.5, (800, 3)), rng.uniform(0.5, 3.0, 800), rng.uniform(1.0, 1.2, (6, 800))
    # Half of the views look more obliquely, and are exposed otherwise.
    lengths = depth * slant + 0.5 * (np.arange(6) < 3)[:, None]
    exposure = along * (np.arange(6) < 3) + 0.1 * rng.normal(size=6)
    shown = bed - lengths[..., None] * ABSORPTION + exposure[:, None, None] + 0.02 * rng.normal(size=(6, 800, 3))
    shown[rng.random(lengths.shape) < 0.3] = np.nan
    # 0.02 over lengths that differ by 0.1 m in 3000 colours: 0.004 for one standard deviation.
    np.testing.assert_allclose(attenuation_per_metre(shown, lengths), np.negative(ABSORPTION), atol=0.016)
    found = log_exposures(shown, lengths)
    np.testing.assert_allclose(found, np.repeat(exposure[:, None], 3, axis=1) - exposure.mean(), atol=0.015)


def test_where_lengths_are_those_of_the_views_exposures_explain_all(rng):
    bed, longer = rng.normal(4.0, 0.5, (300, 3)), np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0])
    lengths = rng.uniform(1.0, 3.0, 300) + longer[:, None]
    apart = np.array([0.4, 0.4, 0.4, 0.0, 0.0, 0.0])[:, None] - longer[:, None] * ABSORPTION
    shown = bed + apart[:, None] + 0.01 * rng.normal(size=(6, 300, 3))
    assert np.abs(attenuation_per_metre(shown, lengths)).max() < 0.01
    np.testing.assert_allclose(log_exposures(shown, lengths), apart - apart.mean(axis=0), atol=0.01)


def test_no_water_brightens_the_bed_with_the_path(rng):
    lengths = rng.uniform(1.0, 6.0, (5, 200))
    shown = rng.normal(4.0, 0.5, (200, 3)) + 0.2 * lengths[..., None]
    assert not attenuation_per_metre(shown, lengths).any()
