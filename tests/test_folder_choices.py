"""Files of a survey folder: settings that are none, several of poses, photographs elsewhere, inputs of no result."""

import shutil

import pytest
from small_survey import HEADER, TOML, camera_lines, replaced, small_survey, write_image

from survey.errors import ConfigError, ImageError
from survey.folder.found import find_survey, poses_inputs, survey_inputs
from survey.marking.geometry import survey_to_mark

READERS = (find_survey, survey_inputs, survey_to_mark)


def broken_link(folder):
    (folder / "survey.toml").symlink_to(folder / "elsewhere" / "survey.toml")


def loop(folder):
    (folder / "survey.toml").symlink_to(folder / "survey.toml")


def directory(folder):
    (folder / "survey.toml").mkdir()


def named(name):
    return lambda folder: (folder / name).write_text(TOML)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (broken_link, "a link to a file that is not there, expected the settings"),
        (loop, "expected the settings"),
        (directory, "is no file, expected the settings"),
        (named("survey.toml.txt"), r"has survey\.toml\.txt and no survey\.toml; rename it"),
        (named("Survey.TOML"), r"has Survey\.TOML and no survey\.toml"),
    ],
)
def test_settings_that_exist_and_cannot_be_read_are_not_passed_over(tmp_path, make, words, reader):
    folder = small_survey(tmp_path / "s", gps=True, toml=None)
    make(folder)
    with pytest.raises(ConfigError, match=words):
        reader(folder)


def write_model(folder, names):
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 100 100 32 24\n")
    lines = [f"{i + 1} 0 1 0 0 {-3 * int(name[:4])} {i % 2} 20 1 {name}\n\n" for i, name in enumerate(names)]
    (folder / "images.txt").write_text("".join(lines))


def poses_of_some(path, numbers):
    path.write_text("\n".join([HEADER, *(line for i, line in enumerate(camera_lines(9)) if i in numbers)]) + "\n")


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"sparse/0": range(2), "sparse/1": range(2, 9)}, "sparse/1"),
        ({"sparse/0": range(6), "sparse/1": range(6, 9)}, "sparse/0"),
        ({"sparse/0": range(2), "sparse/1": range(2, 4), "sparse/12": range(4, 9)}, "sparse/12"),
        ({"colmap/sparse/0": range(3), "sparse": range(9)}, "sparse"),
        ({"cameras.csv": range(4), "all.csv": range(9)}, "all.csv"),
        ({"cameras.csv": range(9), "sparse/0": range(5)}, "cameras.csv"),
        ({"cameras.csv": range(5), "sparse/0": range(9)}, "sparse/0"),
    ],
)
def test_of_several_files_of_poses_the_one_with_most_photographs_is_taken_and_said(tmp_path, files, expected):
    folder = small_survey(tmp_path / "s", num=9, gps=True, toml=TOML.replace('poses = "cameras.csv"', ""))
    (folder / "cameras.csv").unlink()
    for name, numbers in files.items():
        if name.endswith(".csv"):
            poses_of_some(folder / name, numbers)
        else:
            write_model(folder / name, [f"{i:04d}.jpg" for i in numbers])
    found = find_survey(folder)
    assert found.poses_path == folder / expected
    (said,) = [text for text in found.findings.assumptions if "the poses are those in" in text]
    for name, numbers in files.items():
        assert f"{name} with {len(numbers)} of 9 photographs" in said


def test_as_many_poses_in_two_files_need_a_name(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True, toml=TOML.replace('poses = "cameras.csv"', ""))
    shutil.copy(folder / "cameras.csv", folder / "again.csv")
    with pytest.raises(ConfigError, match=r"several files of poses \(again\.csv with 4 of 4 .*; name one"):
        find_survey(folder)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("DCIM/100MEDIA", "DCIM/100MEDIA"),
        ("photos", "photos"),
        ("flight 1/raw", "flight 1/raw"),
        ("DCIM", "DCIM"),
        ("Fotos/DJI_202606011030_001", "Fotos/DJI_202606011030_001"),
    ],
)
@pytest.mark.parametrize("empty", [False, True])
def test_photographs_in_another_folder_are_named(tmp_path, place, said, empty):
    folder = tmp_path / "s"
    for i in range(3):
        write_image(folder / place / f"DJI_{i}.JPG")
    if empty:
        (folder / "images").mkdir()
    (folder / "survey.toml").write_text(TOML)
    with pytest.raises(ImageError, match=rf'3 photographs lie in .*write \[images\] dir = "{said}"'):
        find_survey(folder)
    write_image(folder / "bathynerf" / "report" / "map.png")
    with pytest.raises(ImageError, match="3 photographs lie in"):
        find_survey(folder)


def test_files_of_another_kind_are_counted(tmp_path):
    folder = tmp_path / "s"
    (folder / "images").mkdir(parents=True)
    for i in range(3):
        (folder / "images" / f"{i}.DNG").write_bytes(b"II*\0")
    (folder / "survey.toml").write_text(TOML)
    with pytest.raises(ImageError, match=r"but 3 files ending in \.DNG; expected files ending in \.jpg"):
        find_survey(folder)


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
