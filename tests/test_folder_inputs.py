"""The files of a survey that no result may overwrite."""

from __future__ import annotations

from small_survey import replaced, small_survey

from survey.folder.found import poses_inputs, survey_inputs


def test_settings_poses_and_photographs_are_inputs(tmp_path):
    folder = small_survey(tmp_path / "s")
    inputs = survey_inputs(folder)
    assert set(inputs.files) == {folder / "survey.toml", folder / "cameras.csv"}
    assert inputs.folders == (folder / "images",)


def test_masks_and_measured_levels_are_inputs_too(tmp_path):
    folder = small_survey(tmp_path / "s")
    (folder / "masks").mkdir()
    (folder / "gauge.csv").write_text("time,level\n")
    toml = replaced(("[water]", "[images]\nmasks = 'masks'\n[water]\ngauge = 'gauge.csv'"))
    lines = [line for line in toml.splitlines() if not line.startswith("level_")]
    (folder / "survey.toml").write_text("\n".join(lines))
    inputs = survey_inputs(folder)
    assert folder / "gauge.csv" in inputs.files
    assert set(inputs.folders) == {folder / "images", folder / "masks"}


def test_photographs_beside_each_other_in_the_survey_folder_leave_room_for_a_run_in_it(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "DJI_0001.JPG").touch()
    inputs = survey_inputs(folder)
    assert inputs.files == (folder / "DJI_0001.JPG",)
    assert inputs.folders == ()


def test_of_a_model_the_files_are_inputs_and_not_what_lies_below_its_folder(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "images.txt").touch()
    assert poses_inputs(tmp_path).files == (tmp_path / "images.txt",)
    assert poses_inputs(tmp_path).folders == ()
