"""Where a height map is steep."""

from __future__ import annotations

import numpy as np
import pytest

from fields.sweep.slopes import is_steep


@pytest.mark.parametrize("height", [0.0, -300.0])
def test_a_plane_is_steep_where_it_rises_by_more_than_the_tolerance_from_pixel_to_pixel(height):
    rows, columns = np.mgrid[:20, :30]
    plane = (height + 0.03 * rows - 0.04 * columns).astype(np.float32)
    inner = np.s_[1:-1, 1:-1]
    assert is_steep(plane, 0.049)[inner].all()
    assert not is_steep(plane, 0.051).any()
