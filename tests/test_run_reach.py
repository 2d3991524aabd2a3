"""A short reach whose water is no plane, drawn and processed: by one plane, and by its surface in one piece and two."""

import math

import bench_reach as drawn
import numpy as np
import pytest
from drawn_runs import inner90

from survey.progress import Progress
from survey.run.process import process

pytestmark = pytest.mark.slow

AMPLITUDE = 0.06


def errors(survey, run, tiles):
    """Signed errors [m] of the points within the bounds, and their places along the reach [m]."""
    with Progress(verbosity=-1):
        assert process(survey, run, field="off", tiles=tiles) == 0
    found = drawn.errors_of(survey, run / "cloud.las")
    return found.off, found.xyz[:, 0]


def test_points_are_under_the_surface_and_not_under_a_plane(tmp_path):
    def leaning(off, along):
        # Of crest and trough, 1 m of the reach about each.
        west, east = (np.median(off[np.abs(along - at) < 0.5]) for at in (-2.0, 2.0))
        return west - east

    reach = drawn.Reach("reach", (6.0, 2.4), 1.2, (200, 150), 300.0, 7.0, 0.0, [(AMPLITUDE, 8.0, math.pi)], seed=1)
    with Progress(verbosity=-1):
        survey = reach.draw(tmp_path)
    plane, along = errors(survey, tmp_path / "plane", 1)
    # Water that is 6 cm higher than the plane has its bed (n - 1) times as much too high, west, and too low, east; a
    # tenth less as the surface focuses.
    assert leaning(plane, along) == pytest.approx(0.333 * 2.0 * AMPLITUDE, rel=0.3)
    # Points of the surface a metre apart and good to a millimetre.
    places = np.stack(np.meshgrid(np.arange(-8.0, 8.5), np.arange(-4.0, 4.5)), axis=-1).reshape(-1, 2)
    reach.write_points(survey / "water.csv", places, 0.001)
    drawn.with_measured_water(survey, 'surface = "water.csv"')
    for tiles in (1, 2):
        off, along = errors(survey, tmp_path / f"surface{tiles}", tiles)
        assert abs(leaning(off, along)) < 3e-3
        assert abs(inner90(off)[0]) < 1e-3
        assert len(off) == pytest.approx(len(plane), rel=0.01)
