"""A simulated survey: an ordinary one that projects its truth, drawn again only where its scene changed."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scene_files import scene_file
from typer.testing import CliRunner

from geo import read_reference
from survey.commands.verbs import app
from survey.errors import OutputError
from survey.folder.survey import load_survey
from survey.settings.config import read_config
from survey.simulate import writing
from survey.simulate.simulate import simulate, simulate_flight


@pytest.fixture(scope="module")
def survey(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    simulate(scene_file(folder), folder / "survey")
    return folder / "survey"


def test_a_simulated_survey_is_an_ordinary_one_and_projects_its_truth(survey):
    loaded = load_survey(survey)
    assert loaded.water.n_water == 1.333
    config = read_config(survey / "survey.toml")
    assert config.water.slope_north == 0.003
    cloud = loaded.frame.local_from_crs(read_reference(survey / "truth" / "visible.ply").points)
    assert len(cloud) > 2000
    for view in loaded.views[:3]:
        depth = np.asarray(Image.open(survey / "truth" / "depth" / f"{Path(view.name).stem}.tif"))
        pixels = view.camera.project(cloud, loaded.water)
        inside = ((pixels > 1.0) & (pixels < (95.0, 71.0))).all(axis=1)
        at = pixels[inside].astype(int)
        true = loaded.water.height(cloud[inside, 0], cloud[inside, 1]) - cloud[inside, 2]
        # Over a level bed depth changes by the slope of the water, 0.003 m per metre, within a pixel of 4 cm.
        np.testing.assert_allclose(depth[at[:, 1], at[:, 0]], true, atol=2e-4)
        assert (np.asarray(Image.open(survey / "truth" / "wet" / f"{Path(view.name).stem}.png")) == 255).all()


def test_simulating_again_changes_nothing_and_another_scene_replaces_it(survey, tmp_path):
    path = scene_file(tmp_path)
    simulate(path, tmp_path / "a")
    for name in ("survey.toml", "cameras.csv", "images/0002.png", "truth/visible.ply", "truth/depth/0001.tif"):
        assert (tmp_path / "a" / name).read_bytes() == (survey / name).read_bytes()
    before = (tmp_path / "a" / writing.MARKER).stat().st_mtime_ns
    simulate(path, tmp_path / "a")
    assert (tmp_path / "a" / writing.MARKER).stat().st_mtime_ns == before
    simulate(scene_file(tmp_path, depth_m="depth_m = 0.8"), tmp_path / "a")
    assert json.loads((tmp_path / "a" / writing.MARKER).read_text())["scene"]["bed"]["depth_m"] == 0.8


def test_the_verb_simulates_plans_and_refuses(tmp_path):
    path = scene_file(tmp_path)
    run = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "plan"), "--flight-only"])
    assert run.exit_code == 0
    assert sorted(p.name for p in (tmp_path / "plan").iterdir()) == ["cameras.csv"]
    run = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "plan")])
    assert run.exit_code == 2
    assert "not simulated here" in run.stderr


def test_a_flight_is_not_planned_over_the_cameras_of_a_survey(survey, tmp_path):
    before = (survey / "cameras.csv").read_bytes()
    with pytest.raises(OutputError, match=r"-o names .*, which has cameras\.csv; name a new or empty folder"):
        simulate_flight(scene_file(tmp_path), survey)
    assert (survey / "cameras.csv").read_bytes() == before


@pytest.mark.parametrize("make", [simulate, simulate_flight])
def test_a_scene_does_not_replace_the_survey_that_its_bed_comes_from(survey, tmp_path, make):
    bed = survey / "truth" / "reference.ply"
    before = bed.read_bytes()
    path = scene_file(tmp_path, kind=f'kind = "mesh"\nfile = "{bed}"')
    with pytest.raises(OutputError, match=r"-o names .*survey, which holds the input .*reference\.ply; move that"):
        make(path, survey)
    assert bed.read_bytes() == before
