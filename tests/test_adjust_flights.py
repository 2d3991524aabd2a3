"""Blocks of several flights after structure from motion: what straight rays decide, bent ones decide again.

Straight rays put focal lengths of such blocks 2 % off, some 8 %, and the cameras of one flight against those of another
by decimetres to metres.
"""

from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.applied import apply_adjustment
from survey.adjust.refine import adjust_survey
from survey.adjust.result.parts import common_error
from tests.drawn_flights import Flight, draw_flights

HIGH = Flight()
LOW = Flight(focal=1000.0, size_px=(640, 480), height_m=36.0, tide_m=0.6)
FEW = replace(LOW, rows=3, columns=4)
NO_RTK = replace(LOW, position_std_m=None)
# Of some tens of drawn values; of 20 blocks of each kind the largest was 2.4 for heights of the bed.
MOST_SIGMAS = 4.0

KINDS = {
    "two heights, two tides": (HIGH, LOW),
    "two tides": (replace(HIGH, height_m=38.0), replace(HIGH, height_m=38.0, tide_m=0.8)),
    "a large and a small flight": (HIGH, FEW),
    "a small and a large flight": (replace(HIGH, rows=3, columns=4), LOW),
    "one without corrections": (HIGH, NO_RTK),
    "a small one without corrections": (HIGH, replace(NO_RTK, rows=3, columns=4)),
    "one in whose EXIF the focal length is 5 % off": (HIGH, replace(FEW, exif=1.05)),
}


@pytest.mark.parametrize("seed", [3, 8])
@pytest.mark.parametrize("flights", KINDS.values(), ids=KINDS.keys())
def test_straight_rays_decide_nothing_that_bent_ones_do_not_confirm(flights, seed):
    drawn = draw_flights(seed, flights)
    found = adjust_survey(drawn.survey, use_windows=False)
    assert not [warning for warning in found.warnings if "contradict" in warning]

    known = np.array([flight.position_std_m is not None for flight in flights])[drawn.flight]
    off = (found.poses.centres - drawn.centres) / found.poses.position_std
    assert np.sqrt(np.mean(off[known] ** 2)) < 1.5
    focals = [row for row in found.parameters if row.name.endswith(".f")]
    for number, row in enumerate(focals):
        true = drawn.focals[drawn.flight == number][0]
        assert abs(row.value - true) < MOST_SIGMAS * row.std

    error = float(np.mean(found.points[:, 2] - drawn.bed(*found.points[:, :2].T)))
    assert abs(error) < MOST_SIGMAS * common_error(found, apply_adjustment(drawn.survey, found).water).mean


def test_a_flight_under_another_datum_of_heights_is_no_focal_length():
    """Ellipsoidal heights beside those of the survey: 45 m, where the camera flies 36 m high."""
    drawn = draw_flights(3, (HIGH, FEW), datum_m=(0.0, 45.0))
    names = [view.name for view, flight in zip(drawn.survey.views, drawn.flight, strict=True) if flight == 1]
    rejected = [name for name, prior in drawn.survey.observations.priors.items() if prior.rejected is not None]
    assert rejected == names
    found = adjust_survey(drawn.survey, use_windows=False)
    assert "contradicts are not used: flight1/0000.jpg" in " ".join(found.warnings)
    off = (found.poses.centres - drawn.centres)[drawn.flight == 0]
    assert np.sqrt(np.mean(off**2)) < 0.05
