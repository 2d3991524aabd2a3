"""The queue of kernel jobs: results, their order, and independence of both from the schedule."""

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep.kernels.arrays import Launch, floats, run_job, run_jobs
from fields.sweep.matching import DiscontinuitySearch, Pass
from fields.sweep.view_pass import SweepSettings, match_pass, view_passes

BED = PlaneBed(TILTED, -2.0, slope=0.1)
PASSES = (
    Pass(0.5, 2, None, 0.5, 4, False),
    Pass(1.0, 2, 5, 0.4, 4, True, DiscontinuitySearch(1, 0.75, 8, 0.2, 3, 0.1, walls=True)),
    Pass(1.0, 1, 3, 0.25, 6, True),
)


def counting(device, name: int, turns: int, log: list):
    """A job of so many launches, which writes down what it does, and returns its name and the sum of what it got."""
    total = 0.0
    for turn in range(turns):
        log.append(("ready", name, turn))

        def launch(turn=turn) -> Launch:
            log.append(("launched", name, turn))
            return Launch([floats(device, np.full(3, turn + 1.0))])

        (got,) = yield launch
        total += float(got.sum())
    log.append(("done", name, turns))
    return name, total


@pytest.mark.parametrize("most", [1, 2, 3])
@pytest.mark.parametrize("turns", [(), (0,), (2,), (3, 1, 0, 4, 1), (0, 0, 2, 0)])
def test_jobs_are_answered_in_their_order_whatever_turns_they_take(device, turns, most):
    jobs = (counting(device, name, count, []) for name, count in enumerate(turns))
    found = list(run_jobs(device, jobs, most))
    assert found == [(name, 3.0 * count * (count + 1) / 2) for name, count in enumerate(turns)]


def test_another_job_is_launched_before_one_goes_on(device):
    log = []
    list(run_jobs(device, [counting(device, name, 2, log) for name in range(2)]))
    assert log.index(("launched", 1, 0)) < log.index(("ready", 0, 1))
    assert log.index(("launched", 0, 1)) < log.index(("ready", 1, 1))


@pytest.mark.parametrize("most", [1, 2])
def test_no_more_jobs_than_that_are_begun_and_not_done(device, most):
    log = []
    list(run_jobs(device, (counting(device, name, 1 + name % 3, log) for name in range(7)), most))
    begun = np.cumsum([(what == "ready" and turn == 0) - (what == "done") for what, _, turn in log])
    assert begun.max() == most


def test_an_error_of_a_job_ends_all(device):
    def failing():
        yield lambda: Launch([floats(device, np.zeros(3))])
        raise ValueError("no height")

    with pytest.raises(ValueError, match="no height"):
        list(run_jobs(device, [counting(device, 0, 3, []), failing()]))


def test_a_job_alone_gets_what_it_launched(device):
    assert run_job(device, counting(device, 5, 3, [])) == (5, 18.0)


def test_height_maps_are_the_same_one_view_at_a_time_and_two(device):
    bound, found = (-3.0, -1.0), []
    for most in (1, 2):
        block, maps = BED.block(device, ring(6)), {}
        for p in PASSES:
            jobs = (
                match_pass(block, p, each, SweepSettings(bound), maps.get(each.view), 0)
                for each in view_passes(block, [3, 0, 2, 5], p, None if maps else bound)
            )
            maps = {each.map.view: each.map for each in run_jobs(device, jobs, most)}
        found.append(list(maps.values()))
    for one, two in zip(*found, strict=True):
        assert one.view == two.view
        for name in ("height", "score", "agreeing", "spread"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
