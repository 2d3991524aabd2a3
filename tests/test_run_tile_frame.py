"""Tiles of a survey as jobs: what they answer for themselves, and in a survey of kilometres their own ranges."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from survey.plan.area import Tiling, flattened, limits
from survey.plan.choices import RECIPES, USUAL, required_views
from survey.plan.plan import make_plan
from survey.progress import Progress
from survey.run import stage_start
from survey.run.job import BedSearch, Job
from survey.run.tile_job import TileJob, has_own_ranges


def test_what_a_tile_answers_for_itself_is_asked_of_every_job():
    own = {name for name in vars(TileJob) if not name.startswith("_")}
    assert own - set(dir(Job)) == {"over_whole"}


def test_a_survey_of_more_than_a_kilometre_has_ranges_of_tiles():
    assert has_own_ranges(Tiling((-500.0, 3000.0), (-200.0, 200.0), 0.2))
    assert not has_own_ranges(Tiling((-499.0, 0.0, 499.0), (-300.0, 300.0), 0.2))


def everywhere(job) -> BedSearch:
    """A search within all limits, by all views."""
    return BedSearch(job.limits, list(range(len(job.survey.views))))


@pytest.fixture
def dry_job(shallow_survey, tmp_path):
    """A survey, dry, without matched points, its first view 700 m beside the others, in a tile each."""
    survey = shallow_survey
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

    monkeypatch.setattr(stage_start, "TileJob", tile)
    plan = SimpleNamespace(recipe=RECIPES["draft"], tiling=[0])
    job = SimpleNamespace(plan=plan, limits=(-3.0, 1.0), survey=SimpleNamespace(views=[]))
    bounds, views = stage_start._of_tiles(job, lambda share: None)
    assert (bounds, views, asked) == ([(-2.0, 0.0)], [7], [required_views((0.5, 0.5), RECIPES["draft"].times_seen)])
