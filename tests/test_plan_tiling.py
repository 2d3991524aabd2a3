"""Tiles of the ground, and how many a run takes."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from survey import machine
from survey.display.quantities import bytes_of, room, size
from survey.errors import SurveyError
from survey.plan.area import Tiling, inside
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.tiling import choose_tiles, ground_of, ray_skew_px, tile_warnings, window_pixels, with_workers
from survey.plan.workload import amounts_of_run, workload_of
from survey.water.surface import Departure
from tests.changed_survey import changed


def test_every_place_is_in_one_tile_those_on_lines_and_beyond_the_ground_too(rng):
    tiling = Tiling.of((0.0, -10.0, 30.0, 10.0), 6, rim=0.5)
    assert (len(tiling.x), len(tiling.y), len(tiling)) == (4, 3, 6)
    places = np.concatenate([rng.uniform((-40, -40), (70, 40), (500, 2)), [(x, y) for x in tiling.x for y in tiling.y]])
    assert sum(inside(places, tiling.cell(number)).astype(int) for number in range(6)).tolist() == [1] * len(places)


def test_the_ground_of_a_tile_is_wider_only_where_another_tile_follows():
    tiling = Tiling.of((0.0, 0.0, 30.0, 20.0), 6, rim=0.5)
    assert tiling.ground(0, 0.5) == (0.0, 0.0, 10.5, 10.5)
    assert tiling.ground(4, 0.5) == (9.5, 9.5, 20.5, 20.0)
    assert tiling.ground(4, 0.0) == (10.0, 10.0, 20.0, 20.0)


def test_tiles_are_as_square_as_their_number_allows():
    assert (len(Tiling.of((0, 0, 100, 100), 4, 1.0).x), len(Tiling.of((0, 0, 10, 100), 4, 1.0).x)) == (3, 2)


SIZES = {"8GB": 8e9, "500 mb": 5e8, "2GiB": 2**31, "1e9": None, "": None, "0GB": None, "much": None}


@pytest.mark.parametrize(("text", "expected"), SIZES.items())
def test_sizes_are_read_in_words(text, expected):
    if expected is not None:
        assert bytes_of(text) == expected
        return
    with pytest.raises(SurveyError, match=r"--memory is .*, expected a size such as 8GB"):
        bytes_of(text)


def test_sizes_are_rounded_up_and_room_down():
    assert (size(1.27e9), room(1.27e9)) == ("1.3 GB", "1.2 GB")


@pytest.fixture(scope="module")
def planned(shallow_survey):
    plan = make_plan(shallow_survey)
    return shallow_survey, plan, workload_of(shallow_survey, plan)


def tiles_for(survey, plan, chosen, workload, *, earlier=None, chooses_workers=False):
    """Tiles with the amounts of the survey, and their processes."""
    tiles = choose_tiles(survey, plan, chosen, workload, amounts_of_run(survey, plan), earlier=earlier)
    return with_workers(tiles, chosen, chooses=chooses_workers)


def test_one_piece_where_memory_suffices_and_the_plan_says_why(planned, monkeypatch):
    monkeypatch.setattr(machine, "free_memory_bytes", lambda: 10_000_000_000)
    found = tiles_for(*planned[:2], Choices(), planned[2])
    assert (found.tiling, found.decisions[0].choice, found.memory_bytes) == (None, "1", planned[2].memory_bytes)
    assert found.decisions[0].reason.endswith("of memory, which is free")
    own = tiles_for(*planned[:2], Choices(memory="8GB"), planned[2])
    assert own.decisions[0].reason.endswith("of memory, which is within the 8.0 GB of --memory")


def test_a_number_of_tiles_is_taken_as_it_is(planned):
    found = tiles_for(*planned[:2], Choices(tiles=3), planned[2])
    assert len(found.tiling) == 3
    assert found.decisions[0].reason.startswith("set by --tiles, ")
    assert tiles_for(*planned[:2], Choices(tiles=1), planned[2]).tiling is None


def test_less_memory_asks_for_more_tiles(planned):
    survey, plan, workload = planned
    # As if photographs were of 300 megapixels: windows are what the memory is for.
    plan = replace(plan, footprint_m=(2.0, 1.5))
    workload = replace(workload, memory_bytes=4_000_000_000)
    many = tiles_for(survey, plan, Choices(memory="600MB"), workload)
    assert len(many.tiling) > 1
    assert many.memory_bytes < 4e9
    assert "600 MB are allowed (--memory); in tiles of " in many.decisions[0].reason
    # An unfinished run goes on with its own tiles.
    again = tiles_for(survey, plan, Choices(memory="600MB"), workload, earlier=7)
    assert len(again.tiling) == 7


def test_ground_smaller_than_a_photograph_is_in_tiles_where_memory_asks_for_them(planned):
    survey, plan, workload = planned
    plan, workload = replace(plan, footprint_m=(26.0, 19.0)), replace(workload, memory_bytes=4_000_000_000)
    found = tiles_for(survey, plan, Choices(memory="100MB"), workload)
    x, y = found.tiling.x, found.tiling.y
    assert len(found.tiling) > 1
    assert (x[1] - x[0]) * (y[1] - y[0]) >= 26.0 * 19.0 / 16.0


def test_a_run_that_has_to_be_in_one_piece_refuses_tiles(planned):
    survey, plan, workload = planned
    trained = replace(plan, field="mdw")
    with pytest.raises(SurveyError, match="--tiles 4, but a run with --field mdw is in one piece"):
        tiles_for(survey, trained, Choices(tiles=4), workload)
    assert tiles_for(survey, trained, Choices(), workload).tiling is None
    with pytest.raises(SurveyError, match="--tiles is 0"):
        Choices(tiles=0)


def test_the_ground_is_the_bounds_or_what_two_views_see(shallow_survey):
    plan = make_plan(shallow_survey)
    bounded, free = ground_of(shallow_survey, plan), ground_of(changed(shallow_survey, bounds=None), plan)
    assert bounded[2] - bounded[0] == pytest.approx(13.0 + 1.0, abs=0.5)
    assert free[0] < bounded[0]
    assert free[3] > bounded[3]


def test_each_worker_has_a_tile_and_the_memory_of_one(planned):
    found = tiles_for(*planned[:2], Choices(workers=3, memory="8GB"), planned[2])
    assert len(found.tiling) >= found.workers == 3
    assert (found.decisions[1].choice, found.decisions[1].reason) == ("3", "set by --workers")
    alone = tiles_for(*planned[:2], Choices(tiles=len(found.tiling), workers=1), planned[2])
    assert found.memory_bytes == pytest.approx(3 * alone.memory_bytes)
    few = tiles_for(*planned[:2], Choices(tiles=2, workers=5), planned[2])
    assert (few.workers, few.decisions[1].reason) == (2, "--workers 5, but there are no more tiles")


def test_a_small_ground_has_as_many_tiles_as_workers(planned):
    # Seven are no columns and rows of about square tiles.
    found = tiles_for(*planned[:2], Choices(workers=7, memory="8GB"), planned[2])
    assert len(found.tiling) >= found.workers == 7


def test_workers_of_a_scheduler_have_memory_of_their_own(planned):
    survey, plan, workload = planned
    plan, workload = replace(plan, footprint_m=(2.0, 1.5)), replace(workload, memory_bytes=4_000_000_000)
    there = tiles_for(survey, plan, Choices(scheduler=AT, memory="8GB"), workload)
    assert (len(there.tiling) >= 2, there.workers, there.decisions[1].choice) == (True, 1, "of a scheduler")
    eight = tiles_for(survey, plan, Choices(scheduler=AT, workers=2, memory="600MB"), workload)
    alone = tiles_for(survey, plan, Choices(memory="600MB"), workload)
    assert len(eight.tiling) == len(alone.tiling)


def test_processes_are_chosen_only_where_the_caller_may_start_them(planned, monkeypatch):
    monkeypatch.setattr(machine, "num_cores", lambda: 8)
    chosen = Choices(tiles=3, memory="64GB")
    assert tiles_for(*planned[:2], chosen, planned[2]).workers == 1
    assert tiles_for(*planned[:2], chosen, planned[2], chooses_workers=True).workers == 2


AT = "tcp://one:8786"


@pytest.mark.parametrize(
    ("chosen", "field", "said"),
    [
        (Choices(scheduler=AT), "mdw", f"--scheduler {AT}, but a run with --field mdw is in one piece"),
        (Choices(workers=2), "mdw", "--workers 2, but a run with --field mdw is in one piece"),
        (Choices(tiles=1, scheduler=AT), "off", f"--scheduler {AT}, but --tiles 1 is one piece"),
        (Choices(tiles=1, workers=2), "off", "--workers 2, but --tiles 1 is one piece"),
    ],
)
def test_workers_for_one_piece_are_refused(planned, chosen, field, said):
    survey, plan, workload = planned
    with pytest.raises(SurveyError, match=said):
        tiles_for(survey, replace(plan, field=field), chosen, workload)


def test_workers_are_refused_in_the_plan_where_dask_is_missing(planned, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for chosen in (Choices(workers=2), Choices(scheduler=AT)):
        with pytest.raises(SurveyError, match=r"pip install 'bathynerf\[cluster\]'"):
            tiles_for(*planned[:2], chosen, planned[2])
    assert tiles_for(*planned[:2], Choices(tiles=2, workers=1), planned[2]).workers == 1


def with_water(planned, over):
    """The survey with water ``over(x, y)`` [m] over its plane, from the middle of its ground, and its plan."""
    survey, plan, workload = planned
    xy = np.stack(np.meshgrid(np.arange(-12.0, 13.0), np.arange(-12.0, 13.0)), axis=-1).reshape(-1, 2)
    ground = ground_of(survey, plan)
    middle = 0.5 * (np.array(ground[:2]) + ground[2:])
    departure = Departure(np.column_stack([xy + middle, over(*xy.T)]), np.full(len(xy), 0.002))
    return replace(survey, observations=replace(survey.observations, departure=departure)), plan, workload


def test_water_near_a_plane_needs_no_tiles(planned):
    survey, plan, workload = with_water(planned, lambda x, y: 0.02 * np.sin(x))
    found = tiles_for(survey, plan, Choices(memory="8GB"), workload)
    assert found.tiling is None
    assert not tile_warnings(survey, plan)


def test_water_far_from_a_plane_gets_tiles_and_the_plan_says_why(planned):
    survey, plan, workload = with_water(planned, lambda x, y: 3.0 * np.tanh(y / 4.0))
    plan = replace(plan, footprint_m=(2.0, 1.5), gsd_m=0.02)
    found = tiles_for(survey, plan, Choices(memory="8GB"), workload)
    assert len(found.tiling) > 1
    assert found.decisions[0].reason.startswith("rays of a point bent at one plane are skew by up to ")
    ground = ground_of(survey, plan)
    (_, in_one), (_, in_tiles) = ray_skew_px(survey, plan, ground, [None, found.tiling])
    assert in_tiles < 0.5 * in_one
    assert "are skew by up to" in tile_warnings(survey, plan)[0]


def test_rays_miss_by_what_snell_says(planned):
    survey, plan, _ = with_water(planned, lambda x, y: 0.1 + 0.0 * x)
    rays = np.concatenate([view.camera.directions(view.camera.outline()) for view in survey.views])
    steep = float((rays @ -np.array(survey.water.up)).min())
    incidence = np.arccos(max(steep, np.cos(np.radians(70.0))))
    in_water = np.arcsin(np.sin(incidence) / survey.water.n_water)
    aside = 0.1 * (np.tan(incidence) - survey.water.n_water * np.tan(in_water)) / plan.gsd_m
    assert list(ray_skew_px(survey, plan, ground_of(survey, plan), [None])) == [(None, pytest.approx(aside, rel=1e-3))]


def test_windows_are_as_large_as_the_ground_that_they_show(planned):
    survey, plan, _ = planned
    small, wide = (window_pixels(survey, plan, sides) for sides in ((1.0, 1.0), (4.0, 1.0)))
    # A cell of the ground is a pixel; relief and tilt make boxes of it larger, never smaller.
    cell_px = plan.gsd_m**-2
    assert (small > 0.7 * cell_px).all()
    assert np.median(small) < 6.0 * cell_px
    assert (wide > small).all()
    # Turned by 45 degrees, the box about a square is twice as large.
    half = np.sqrt(0.5)
    turn = np.array([[half, half, 0.0], [-half, half, 0.0], [0.0, 0.0, 1.0]])
    level = np.diag([1.0, -1.0, -1.0])
    of_yaw = []
    for rotation in (level, turn @ level):
        views = (replace(v, camera=replace(v.camera, cam_from_local=rotation)) for v in survey.views)
        of_yaw.append(np.median(window_pixels(replace(survey, views=tuple(views)), plan, (2.0, 2.0))))
    assert of_yaw[1] / of_yaw[0] == pytest.approx(2.0, rel=0.05)
    whole = window_pixels(survey, plan, (1000.0, 1000.0))
    camera = survey.views[0].camera
    assert (whole == camera.width * camera.height).all()
