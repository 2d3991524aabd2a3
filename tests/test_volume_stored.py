"""A trained field that is read back from its folder shows what its training showed."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from command_line import bathynerf
from painted_survey import painted_survey, run_over
from PIL import Image

import survey.volume.scene
from bathynerf import Field, train_field
from geo import read_cloud
from survey.commands.faults import BAD_INPUT
from survey.errors import OutputError, SurveyError
from survey.export.export import cloud_of, export
from survey.export.loaded import LoadedRun
from survey.files.paths import ReadFiles
from survey.run.trained_field import FIELD_STATE
from survey.viewer.shown import load_shown
from survey.viewer.tree import camera_of_screen
from survey.volume.options import VolumeOptions
from survey.volume.scene import VolumeFolder
from survey.volume.submodules import StoredVolume

OPTIONS = VolumeOptions(model="vm", steps=3, rays=64, samples=8, cells=16, image_scale=0.5, appearance=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run ``run`` with a field ``f``, and the photographs' own cameras rendered in ``f/views``."""
    folder = tmp_path_factory.mktemp("stored")
    run = run_over(painted_survey(folder / "s"), folder / "run")
    train_field(run, folder / "f", **{**vars(OPTIONS), "cameras": folder / "s" / "cameras.csv"})
    return folder


def test_it_renders_what_the_training_rendered(folder):
    with LoadedRun(folder / "run") as run:
        stored, view = StoredVolume.of_run(folder / "f", run), run.flight.views[1]
    seen = stored.load("torch")(view.camera, False)
    with Image.open(folder / "f" / "views" / "0001.png") as picture:
        before = np.asarray(picture)
    assert (seen.seen == (before[..., 3] > 0)).mean() > 0.999
    assert np.abs(seen.rgb.astype(int) - before[..., :3])[seen.seen].max() <= 1


def test_its_folder_is_rendered_and_opened_by_itself(folder, tmp_path):
    found = bathynerf("render", folder / "f", "--cameras", folder / "s" / "cameras.csv", "-o", tmp_path / "views")
    assert found.exit_code == 0, found.stderr
    for name in ("0001.png", "0002.png"):
        assert (tmp_path / "views" / name).read_bytes() == (folder / "f" / "views" / name).read_bytes()
    field = Field(folder / "f")
    assert field.run == folder / "run"
    assert len(field.surface.points) == field.report["points"]
    assert "data:image/png" in field._repr_html_()
    with pytest.raises(SurveyError, match="holds no trained field"):
        Field(folder / "run")


def test_its_surface_is_exported_and_compared_as_the_points_of_a_run_are(folder, tmp_path):
    cloud = folder / "f" / "cloud.las"
    las, *others = export(folder / "f", las=tmp_path / "bed.las", dem=tmp_path / "bed.tif", mesh=tmp_path / "bed.ply")
    points = read_cloud(cloud).points
    np.testing.assert_array_equal(read_cloud(las).points, points)
    assert all(path.is_file() for path in others)
    # Not taken for up to date where the run's own points are asked for.
    export(folder / "run", las=las)
    assert len(read_cloud(las).points) != len(points)
    assert cloud_of(folder / "f") == cloud
    shutil.copytree(folder / "f", tmp_path / "f")
    shutil.rmtree(tmp_path / "f" / "bed")
    with pytest.raises(SurveyError, match="has no points yet; give its options to bathynerf field again"):
        export(tmp_path / "f", las=tmp_path / "none.las")


def test_a_field_whose_run_is_gone_says_how_it_is_told(folder, tmp_path):
    shutil.copytree(folder / "f", tmp_path / "f")
    settings = json.loads((tmp_path / "f" / "settings.json").read_text())
    (tmp_path / "f" / "settings.json").write_text(json.dumps(settings | {"run": str(tmp_path / "moved")}))
    with pytest.raises(SurveyError, match="moved, which is not there; give the same options"):
        Field(tmp_path / "f")
    # Trained to the end: the same command only reads it, and writes the place of the run.
    assert train_field(folder / "run", tmp_path / "f", **vars(OPTIONS)).run == folder / "run"


def test_the_viewer_renders_it_from_a_browsers_place(folder):
    with LoadedRun(folder / "run") as run:
        shown = load_shown(run, None, volume=folder / "f")
    (field,) = shown.fields
    assert field.name == "vm"
    above = shown.middle + np.array([0.0, 0.0, 8.0])
    down = camera_of_screen(above, np.diag([1.0, -1.0, -1.0]), math.radians(60.0), 1.5, 900.0)
    wet, dry = (field.picture(down, dry=dry) for dry in (False, True))
    assert wet.shape == dry.shape == (200, 300, 3)
    assert (wet != dry).any()
    assert (dry[100, 150] < 255).any()


def test_a_training_of_other_parameters_is_refused(folder, tmp_path):
    shutil.copytree(folder / "f", tmp_path / "f")
    state = torch.load(tmp_path / "f" / FIELD_STATE, weights_only=True)
    state["renderer"].popitem()
    torch.save(state, tmp_path / "f" / FIELD_STATE)
    with pytest.raises(SurveyError, match="the training in this folder cannot go on: its parameters are others"):
        train_field(folder / "run", tmp_path / "f", **vars(OPTIONS))


def test_one_of_another_result_is_refused(folder, tmp_path):
    shutil.copytree(folder / "f", tmp_path / "f")
    settings = json.loads((tmp_path / "f" / "settings.json").read_text())
    (tmp_path / "f" / "settings.json").write_text(json.dumps(settings | {"result": {"bed": "another"}}))
    with LoadedRun(folder / "run") as run, pytest.raises(SurveyError, match="trained on another run"):
        StoredVolume.of_run(tmp_path / "f", run)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("settings.json", None, "holds no trained field"),
        ("settings.json", {"model": "vm"}, "cannot be read"),
        ("settings.json", {"cells": 24}, "does not fit its settings.json"),
    ],
)
def test_what_cannot_be_rendered_is_named(folder, tmp_path, name, content, said):
    shutil.copytree(folder / "f", tmp_path / "f")
    path = tmp_path / "f" / name
    whole = json.loads(path.read_text())
    path.unlink()
    if content is not None:
        path.write_text(json.dumps({**(whole if "cells" in content else {"result": whole["result"]}), **content}))
    with LoadedRun(folder / "run") as run, pytest.raises(SurveyError, match=said):
        StoredVolume.of_run(tmp_path / "f", run).load("torch")


def test_a_page_without_a_server_has_no_field(folder):
    done = bathynerf("view", folder / "run", "--field", folder / "f", "--export", folder / "view.html")
    assert done.exit_code == BAD_INPUT
    assert "leave out --field or --export" in done.stderr


def test_a_folder_of_another_result_is_refused_without_its_hashes(tmp_path):
    VolumeFolder(tmp_path / "f", {"result": {"bed": "3f"}, "steps": 2}, ReadFiles())
    with pytest.raises(OutputError, match="trained on another run, or on an earlier result of this one; name another"):
        VolumeFolder(tmp_path / "f", {"result": {"bed": "7a"}, "steps": 3}, ReadFiles())


def test_a_state_is_saved_every_five_seconds_and_more_seldom_where_that_takes_long(tmp_path, monkeypatch):
    now, cost = [0.0], [0.0]
    monkeypatch.setattr(survey.volume.scene.time, "monotonic", lambda: now[0])
    folder, saved = VolumeFolder(tmp_path / "f", {}, ReadFiles()), []

    def make():
        saved.append(now[0])
        now[0] += cost[0]
        return {"step": int(saved[-1]), "history": []}

    for cost[0], until in ((0.0, 23.0), (1.0, 60.0)):
        while now[0] < until:
            now[0] += 1.0
            folder.save(make, last=False)
    assert saved == [5.0, 10.0, 15.0, 20.0, 25.0, 46.0]
    assert folder.load()["step"] == 46
    folder.save(lambda: {"step": 99, "history": []}, last=True)
    assert folder.load()["step"] == 99


def test_a_model_that_is_gone_is_named_and_its_state_is_left_alone(folder, tmp_path):
    shutil.copytree(folder / "f", tmp_path / "f")
    settings = json.loads((tmp_path / "f" / "settings.json").read_text())
    (tmp_path / "f" / "settings.json").write_text(json.dumps(settings | {"model": "gone:Field"}))
    with LoadedRun(folder / "run") as run, pytest.raises(SurveyError, match="No module named 'gone'") as found:
        StoredVolume.of_run(tmp_path / "f", run).load("torch")
    assert "delete" not in str(found.value)
