"""Tiles of a survey of kilometres in local frames of their own: the same rays, water and places as in that of it."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from geo.frames import LocalFrame
from survey.control.points import Control, ControlPoint
from survey.plan.area import Tiling, flattened, inside, limits
from survey.plan.choices import USUAL
from survey.plan.heights import dry_ground
from survey.plan.plan import make_plan
from survey.plan.recipe import RECIPES, required_views
from survey.progress import Progress
from survey.run import stage_range
from survey.run.job import Job
from survey.run.tile_job import TileJob, over_own_plane
from survey.run.windows import BedSearch, area_in_frame, frame_of_tile, has_frames, survey_in_frame
from survey.water.surface import curvature_drop, still_water

TILING = Tiling((-500.0, 3000.0, 6500.0, 10_000.0), (-200.0, 200.0), 0.2)
LAST = 2
EVERYWHERE = (-1e6, -1e6, 1e6, 1e6)


@pytest.fixture(scope="module")
def far(shallow_survey):
    """The survey in a frame whose origin lies 8 km west of it, and its tile."""
    east, north, height = shallow_survey.frame.origin
    frame = LocalFrame(shallow_survey.frame.crs, (east - 8_000.0, north - 50.0, height))
    survey = survey_in_frame(shallow_survey, frame, EVERYWHERE)
    own = frame_of_tile(frame, TILING, LAST)
    return survey, own


def test_tiles_answer_what_stages_ask_of_a_job_for_themselves():
    asked = "stage_name views_to_match ground own_ground limits bound hashes photographs block in_survey"
    for name in asked.split():
        assert getattr(TileJob, name) is not getattr(Job, name)
    # What is defined is asked for: a name of the base class, or of the tile alone.
    own = {name for name in vars(TileJob) if not name.startswith("_")}
    assert own - set(dir(Job)) == {"over_whole"}


def test_only_a_survey_of_more_than_a_kilometre_has_frames_of_tiles():
    assert has_frames(TILING)
    assert not has_frames(Tiling((-499.0, 0.0, 499.0), (-300.0, 300.0), 0.2))


def test_the_frame_of_a_tile_touches_the_earth_in_its_middle(far):
    survey, own = far
    there = survey.frame.local_from_crs(own.origin)
    np.testing.assert_allclose(there[:2], (8250.0, 0.0), atol=0.02)
    assert there[2] == pytest.approx(-curvature_drop(8250.0), rel=0.01)


def test_cameras_and_water_are_the_same_in_the_frame_of_a_tile(shallow_survey, far, rng):
    survey, own = far
    moved = survey_in_frame(survey, own, EVERYWHERE)
    points = rng.uniform((-3.0, -3.0, -4.0), (3.0, 3.0, 1.0), (50, 3))
    in_crs = shallow_survey.frame.crs_from_local(points)
    for before, after in zip(shallow_survey.views, moved.views, strict=True):
        pixels = before.camera.project(points, shallow_survey.water)
        again = after.camera.project(own.local_from_crs(in_crs), moved.water)
        # A tenth of a micrometre, seen from 20 m.
        np.testing.assert_allclose(again, pixels, atol=1e-4)
    np.testing.assert_allclose(
        moved.water.depth(own.local_from_crs(in_crs)), shallow_survey.water.depth(points), atol=1e-7
    )
    back = own.from_frame(survey.frame)
    xyz = back(survey.frame.local_from_crs(in_crs))
    np.testing.assert_allclose(own.crs_from_local(xyz), in_crs, rtol=0.0, atol=1e-7)


def test_still_water_is_level_in_the_frame_of_a_tile(far):
    survey, own = far
    frame, plane = survey.frame, replace(survey.water, point=(0.0, 0.0, 0.0), slope_x=0.0, slope_y=0.0)
    reached = np.array([[-500.0, -200.0, 80.0], [10_000.0, 200.0, 80.0]])
    observations = replace(survey.observations, departure=still_water(frame, plane, reached))
    in_tile = survey_in_frame(replace(survey, water=plane, observations=observations), own, EVERYWHERE)
    ground = (-100.0, -100.0, 100.0, 100.0)
    found, _ = over_own_plane(in_tile, ground)
    # Level to a tenth of a microradian, at the height of the origin in crs but for the drop within the ground.
    assert math.hypot(found.water.slope_x, found.water.slope_y) < 1e-7
    places = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, -curvature_drop(100.0)]])
    np.testing.assert_allclose(found.observations.departure.at(places[:, :2])[0] + found.water.height(*places[:, :2].T),
                               places[:, 2], atol=1e-5)  # fmt: skip


def test_the_ground_of_a_tile_holds_it_in_its_frame_whatever_the_height(far, rng):
    survey, own = far
    moved = own.from_frame(survey.frame)
    ground = TILING.ground(LAST, TILING.rim)
    level = -curvature_drop(8250.0)
    places = rng.uniform((*ground[:2], level - 30.0), (*ground[2:], level + 30.0), (500, 3))
    area = area_in_frame(ground, moved)
    assert inside(moved(places)[:, :2], area).all()
    # No wider than the turn of the axes makes it.
    assert max(np.subtract(area[2:], area[:2]) - np.subtract(ground[2:], ground[:2])) < 10.0
    cell = area_in_frame(TILING.cell(LAST), moved)
    assert (math.isfinite(cell[0]), *map(math.isinf, cell[1:])) == (True, True, True, True)


def everywhere(job) -> BedSearch:
    """A search within all limits, by all views."""
    return BedSearch(job.limits, list(range(len(job.survey.views))))


@pytest.fixture
def dry_job(far, tmp_path):
    """The survey dry, without matched points, its first view 700 m beside the others, in a tile each."""
    survey, _ = far
    bare = replace(survey.observations, points=None, control=None, departure=None, ties=None)
    first, *others = survey.views
    aside = replace(first.camera, centre=first.camera.centre - (700.0, 0.0, 0.0))
    views = (replace(first, camera=aside), *others)
    area = replace(survey.config.area, bounds=None, heights=None)
    survey = replace(survey, water=None, views=views, observations=bare, config=replace(survey.config, area=area))
    x = aside.centre[0]
    with Progress(verbosity=-1) as progress:
        tiling = Tiling((x - 20.0, x + 300.0, x + 800.0), (-100.0, 200.0), 0.2)
        yield Job(survey, USUAL, replace(make_plan(survey), tiling=tiling), progress, scratch=tmp_path)


def test_a_tile_of_known_windows_has_the_same_cameras(dry_job, monkeypatch):
    plan = everywhere(dry_job)
    tiles = [TileJob(dry_job, number, plan) for number in (0, 1)]
    known = replace(plan, windows=tuple(tile.windows for tile in tiles))
    # They are not looked for again.
    monkeypatch.setattr("survey.run.tile_job.windows_of", None)
    for tile in tiles:
        again = TileJob(dry_job, tile.number, known)
        assert again.windows == tile.windows
        cameras = [[view.camera for view in each.survey.views] for each in (again, tile)]
        assert [(c.width, c.cx, c.cy) for c in cameras[0]] == [(c.width, c.cx, c.cy) for c in cameras[1]]
        np.testing.assert_array_equal(*([c.centre for c in each] for each in cameras))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_one_photograph_over_dry_ground_takes_the_limits_of_the_survey(dry_job):
    tile = TileJob(dry_job, 0, everywhere(dry_job))
    assert tile.bound == limits(flattened(dry_job.survey))
    assert np.isfinite(tile.bound).all()


def test_a_tile_that_only_views_of_the_sky_show_is_void(dry_job):
    tile = TileJob(dry_job, 1, everywhere(dry_job))
    assert not tile.is_void
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    views = (replace(view, camera=replace(view.camera, cam_from_local=level)) for view in tile.survey.views)
    tile.survey = replace(tile.survey, views=tuple(views))
    assert tile.is_void


def test_dry_ground_by_control_is_as_high_in_the_frame_of_a_tile(far):
    survey, own = far
    place = np.array([8000.0, 50.0, -curvature_drop(8000.0)])
    crs = tuple(survey.frame.crs_from_local(place).tolist())
    control = Control((ControlPoint("a", crs, place, np.full(3, 0.01)),), (), 0.5)
    dry = replace(survey, water=None, observations=replace(survey.observations, points=None, control=control))
    heights = [dry_ground(each).height for each in (dry, survey_in_frame(dry, own, EVERYWHERE))]
    # 8 km from the origin of the first frame and 250 m from that of the second: 5 m under its z = 0, and 5 mm.
    np.testing.assert_allclose(heights, 0.0, atol=0.02)


def test_tiles_choose_more_views_under_glitter(monkeypatch):
    asked = []

    class Tile(SimpleNamespace):
        block = SimpleNamespace(
            saturated=(0.5, 0.5),
            cover=lambda *times: asked.append(times) or [0],
            set_overlap_height=lambda height: None,
        )

    def tile(*_):
        return Tile(
            is_void=False,
            windows=[SimpleNamespace(view=7)],
            bound=None,
            range_within=lambda _: (-2.0, 0.0),
            release=int,
        )

    monkeypatch.setattr(stage_range, "TileJob", tile)
    plan = SimpleNamespace(recipe=RECIPES["draft"], tiling=[0])
    job = SimpleNamespace(plan=plan, limits=(-3.0, 1.0), survey=SimpleNamespace(views=[]))
    bounds, views = stage_range._of_tiles(job, lambda share: None)
    assert (bounds, views, asked) == ([(-2.0, 0.0)], [7], [required_views((0.5, 0.5), RECIPES["draft"].times_seen)])
