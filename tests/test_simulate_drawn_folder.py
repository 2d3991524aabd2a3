"""The folder of a drawn survey: the same bytes from the same scene, whole or absent, and refused where it is none."""

import dataclasses

import pytest
from drawn_shore import SHORE

from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.settings.config import read_config
from survey.simulate import writing
from survey.simulate.drawn import DrawnScene, draw_survey, main, stage_drawing
from survey.simulate.sidecars import StagedScene

# For tests of the folder alone: the same angle of view in a seventh of the pixels.
FEW = DrawnScene.tiny(num_views=3, image_px=(60, 45), focal_px=105.0)


def test_the_same_scene_gives_the_same_bytes_and_another_seed_another_bed(shore_folder, tmp_path):
    draw_survey(tmp_path / "same", SHORE)
    files = sorted(p.relative_to(shore_folder) for p in shore_folder.rglob("*") if p.is_file())
    assert len(files) == 3 * 8 + 5
    for file in files:
        assert (tmp_path / "same" / file).read_bytes() == (shore_folder / file).read_bytes(), file
    other = stage_drawing(dataclasses.replace(SHORE, seed=2))
    assert other.renderer.ground.bed.height(0.0, 0.0) != stage_drawing(SHORE).renderer.ground.bed.height(0.0, 0.0)


def test_a_dry_survey_has_the_same_bed_and_no_water(shore_folder, tmp_path):
    scene = dataclasses.replace(SHORE, water=False)
    draw_survey(tmp_path / "dry", scene)
    assert read_config(tmp_path / "dry" / "survey.toml").water is None
    wet, dry = (path / "truth" / "reference.ply" for path in (shore_folder, tmp_path / "dry"))
    assert wet.read_bytes() == dry.read_bytes()


def test_a_finished_folder_is_left_alone_until_told_and_keeps_what_is_not_of_it(tmp_path):
    path = tmp_path / "survey"
    draw_survey(path, FEW)
    (path / "bathynerf").mkdir()
    (path / "bathynerf" / "cloud.las").write_text("a run")
    (path / "cameras.csv").write_text("changed")
    draw_survey(path, FEW)
    assert (path / "cameras.csv").read_text() == "changed"
    draw_survey(path, FEW, again=True)
    assert (path / "cameras.csv").read_text().startswith("image,easting")
    draw_survey(path, dataclasses.replace(FEW, seed=5))
    assert (path / "bathynerf" / "cloud.las").read_text() == "a run"
    assert [p.name for p in tmp_path.iterdir()] == ["survey"]


@pytest.mark.parametrize("renamed", [1, 2])
def test_files_of_the_user_come_back_after_a_run_was_killed_while_it_replaced_a_survey(tmp_path, renamed):
    path, old = tmp_path / "survey", tmp_path / ".survey.part" / "old"
    draw_survey(path, FEW)
    (path / "bathynerf").mkdir()
    (path / "bathynerf" / "cloud.las").write_text("a run")
    old.parent.mkdir()
    path.rename(old)
    if renamed == 2:
        draw_survey(tmp_path / "new", FEW)
        (tmp_path / "new").rename(path)
    draw_survey(path, FEW if renamed == 2 else dataclasses.replace(FEW, seed=5))
    assert (path / "bathynerf" / "cloud.las").read_text() == "a run"
    assert not old.exists()


def test_files_put_where_a_stopped_run_would_write_are_refused_and_kept(tmp_path):
    path = tmp_path / "survey"
    (tmp_path / ".survey.part").mkdir()
    draw_survey(tmp_path / "other", FEW)
    (tmp_path / "other" / writing.MARKER).rename(tmp_path / ".survey.part" / writing.MARKER)
    (path / "images").mkdir(parents=True)
    (path / "images" / "mine.jpg").write_text("mine")
    with pytest.raises(SurveyError, match="is not empty and was not simulated here"):
        draw_survey(path, FEW)
    assert (path / "images" / "mine.jpg").read_text() == "mine"


def test_a_change_of_any_file_of_the_simulator_draws_the_survey_anew(tmp_path, monkeypatch):
    code = tmp_path / "simulate"
    code.mkdir()
    (code / "module.py").write_text("", encoding="utf-8")
    assert (writing.CODE / "path_tracer.py").is_file()
    monkeypatch.setattr(writing, "CODE", code)
    draw_survey(tmp_path / "survey", FEW)
    marker = tmp_path / "survey" / writing.MARKER
    before = marker.read_text(encoding="utf-8")
    (code / "module.py").write_text("changed = True", encoding="utf-8")
    draw_survey(tmp_path / "survey", FEW)
    assert marker.read_text(encoding="utf-8") != before


def test_what_fails_leaves_no_survey_and_the_next_try_takes_no_photograph_twice(tmp_path, monkeypatch):
    def disk_is_full(*_, **__):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(writing, "write_ply", disk_is_full)
        with pytest.raises(OSError, match="no space"):
            draw_survey(tmp_path / "survey", FEW)
    assert not (tmp_path / "survey").exists()
    with monkeypatch.context() as patch:
        patch.setattr(StagedScene, "photograph", lambda *_: pytest.fail("an image was taken twice"))
        draw_survey(tmp_path / "survey", FEW)
    assert [p.name for p in tmp_path.iterdir()] == ["survey"]
    draw_survey(tmp_path / "whole", FEW)
    assert (tmp_path / "survey" / "images" / "0001.png").read_bytes() == (
        tmp_path / "whole" / "images" / "0001.png"
    ).read_bytes()


def test_a_folder_with_other_things_in_it_is_refused(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SurveyError, match=r"not empty and was not simulated here.*give another folder"):
        draw_survey(tmp_path, DrawnScene.tiny())
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path), "--tiny"])
    assert stop.value.code == 2
    assert "give another folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_settings_of_a_scene_are_named_on_the_command_line_as_in_toml(tmp_path, capsys):
    main([str(tmp_path / "dry"), "--tiny", "water=false", "size_m=[1.3, 1.2]", "num_views=3", "cell_m=0.1"])
    settings = read_json_object(tmp_path / "dry" / "simulated.json")["scene"]
    assert (settings["water"], settings["size_m"], settings["image_px"]) == (False, [1.3, 1.2], [160, 120])
    for argument, mend in (("glint=0.1", "unknown key glint"), ("shore=yes", "not valid TOML")):
        with pytest.raises(SystemExit) as stop:
            main([str(tmp_path / "other"), argument])
        assert stop.value.code == 2
        assert mend in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"num_views": 2}, "at least 3"), ({"seed": -1}, "from zero on"), ({"n_water": 0.7}, "1.333"),
     ({"depth_m": 0.0}, "depth_m of a drawn scene is 0, expected a number above 0"),
     ({"flying_m": 3.0}, "twice the depth"), ({"focal_px": float("nan")}, "above 0"),
     ({"readout_s": 1.0}, "at most 0.25")],
)  # fmt: skip
def test_scenes_that_cannot_be_drawn_are_refused_with_the_mend(changes, named):
    with pytest.raises(SurveyError, match=named):
        DrawnScene(**changes)
