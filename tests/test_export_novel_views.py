"""Exposures of the photographs that novel views are blended of."""

from __future__ import annotations

import numpy as np

from survey.export.novel_views import per_metre

ABSORPTION = (0.3, 0.1, 0.05)


def test_what_water_takes_along_a_path_is_told_from_the_colours_of_the_bed(rng):
    bed, slant = rng.normal(4.0, 0.5, (500, 3)), rng.uniform(1.0, 1.3, (12, 500))
    lengths = slant * rng.uniform(0.5, 6.0, 500)
    shown = bed - lengths[..., None] * ABSORPTION
    shown[rng.random(lengths.shape) < 0.3] = np.nan
    np.testing.assert_allclose(per_metre(shown, lengths), np.negative(ABSORPTION), atol=1e-9)


def test_dry_photographs_have_no_change_with_the_path(rng):
    shown = rng.normal(4.0, 0.5, (5, 40, 3))
    assert not per_metre(shown, np.zeros((5, 40))).any()
