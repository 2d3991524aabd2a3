"""Where results may go: never over an input, never over a file of another kind."""

import os
from functools import partial
from pathlib import Path

import pytest
from small_survey import small_survey

from survey.adjust.waterline import estimate_water
from survey.errors import OutputError
from survey.files.paths import ReadFiles, is_json, require_file, require_folder
from survey.run.process import process

require_json = partial(require_file, "--json", kind="a JSON file", is_of_kind=is_json)


@pytest.fixture
def cloud(tmp_path):
    path = tmp_path / "cloud.las"
    path.write_bytes(b"LASF")
    return path


@pytest.mark.parametrize("link", ["name", "symbolic link", "hard link", "other spelling"])
def test_an_input_is_not_overwritten_under_any_name(tmp_path, cloud, link):
    # Of the right kind, so that nothing but its being an input speaks against it.
    cloud.write_bytes(b"{}")
    path = cloud if link == "name" else tmp_path / "n.json"
    if link == "symbolic link":
        path.symlink_to(cloud)
    elif link == "hard link":
        path.hardlink_to(cloud)
    elif link == "other spelling":
        path = tmp_path / "gone" / ".." / "cloud.las"
        (tmp_path / "gone").mkdir()
    with pytest.raises(OutputError, match=r"--json names .*, which would overwrite the input .*cloud\.las; choose"):
        require_json(path, ReadFiles.of(None, cloud))


@pytest.mark.parametrize("link", [False, True])
def test_a_file_below_a_folder_of_inputs_is_an_input(tmp_path, link):
    photo = tmp_path / "images" / "a" / "0001.png"
    photo.parent.mkdir(parents=True)
    photo.write_bytes(b"{}")
    path = photo
    if link:
        path = tmp_path / "n.json"
        path.hardlink_to(photo)
    with pytest.raises(OutputError, match="would overwrite the input"):
        require_json(path, ReadFiles.of(tmp_path / "images"))


def test_only_a_file_of_the_same_kind_is_replaced(tmp_path, cloud):
    with pytest.raises(OutputError, match=r"cloud\.las, which exists and is not a JSON file; remove it or choose"):
        require_json(cloud, ReadFiles())
    for content in ("", ' \n{"n_points": 1}'):
        (tmp_path / "n.json").write_text(content)
        require_json(tmp_path / "n.json", ReadFiles.of(cloud))


def test_a_new_file_needs_a_folder_that_exists_and_nothing_is_made(tmp_path, cloud):
    require_json(None, ReadFiles())
    require_json(tmp_path / "new.json", ReadFiles())
    # A device is written into.
    require_json(Path(os.devnull), ReadFiles())
    for path, words in (
        (tmp_path / "no" / "deep" / "n.json", "whose folder does not exist; create the folder or correct the path"),
        (cloud / "n.json", "whose folder is a file"),
        (tmp_path, "which is a folder; name a file"),
    ):
        with pytest.raises(OutputError, match=words):
            require_json(path, ReadFiles())
    assert list(tmp_path.iterdir()) == [cloud]


def test_a_folder_is_made_unless_a_file_is_in_the_way(tmp_path, cloud):
    require_folder("-o", None, ReadFiles())
    require_folder("-o", tmp_path / "new" / "deep", ReadFiles())
    with pytest.raises(OutputError, match=r"-o names .*cloud\.las, which is a file; name another folder"):
        require_folder("-o", cloud, ReadFiles())
    with pytest.raises(OutputError, match=r"-o names .*run, but .*cloud\.las is a file"):
        require_folder("-o", cloud / "new" / "run", ReadFiles())
    assert list(tmp_path.iterdir()) == [cloud]


@pytest.mark.parametrize("name", ["images", "images/run", "link/run"])
def test_a_folder_of_results_does_not_lie_among_inputs(tmp_path, name):
    (tmp_path / "images").mkdir()
    (tmp_path / "link").symlink_to("images")
    inputs = ReadFiles.of(tmp_path / "images")
    with pytest.raises(OutputError, match=r"images.*, whose files are read; name a folder elsewhere"):
        require_folder("-o", tmp_path / name, inputs)
    require_folder("-o", tmp_path / "images_2", inputs)


def test_a_folder_of_results_does_not_hold_inputs_unless_it_replaces_only_its_own_files(tmp_path, cloud):
    (tmp_path / "run").mkdir()
    (tmp_path / "link.las").symlink_to(cloud)
    with pytest.raises(OutputError, match=r"which holds the input .*link\.las; move that, or name another folder"):
        require_folder("-o", tmp_path, ReadFiles.of(tmp_path / "link.las"))
    require_folder("-o", tmp_path / "run", ReadFiles.of(cloud))
    require_folder("-o", tmp_path, ReadFiles.of(cloud), may_hold_inputs=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_what_may_not_be_written_to_is_refused(tmp_path):
    (tmp_path / "n.json").write_text("{}")
    (tmp_path / "n.json").chmod(0o400)
    with pytest.raises(OutputError, match="write-protected"):
        require_json(tmp_path / "n.json", ReadFiles())
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OutputError, match="is not writable"):
            require_json(tmp_path / "new.json", ReadFiles())
        with pytest.raises(OutputError, match="is not writable"):
            require_folder("-o", tmp_path / "new" / "run", ReadFiles())
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no folder of the system that takes no file")
def test_a_folder_that_takes_no_file_is_refused_whoever_asks():
    with pytest.raises(OutputError, match=r"/proc/self/task/x, but /proc/self/task (takes no|is not)"):
        require_folder("--report", Path("/proc/self/task/x"), ReadFiles())
    with pytest.raises(OutputError, match=r"/proc/self/task (takes no|is not)"):
        require_json(Path("/proc/self/task/x.json"), ReadFiles())


@pytest.fixture
def survey_folder(tmp_path):
    return small_survey(tmp_path / "s")


@pytest.mark.parametrize("name", ["survey.toml", "cameras.csv", "images/0001.jpg"])
def test_waterline_refuses_to_overwrite_its_survey(survey_folder, name):
    before = (survey_folder / name).read_bytes()
    with pytest.raises(OutputError, match="would overwrite the input"):
        estimate_water(survey_folder, json_path=survey_folder / name)
    assert (survey_folder / name).read_bytes() == before


def test_process_refuses_a_run_folder_among_its_inputs(survey_folder):
    (survey_folder / "run").mkdir()
    reference = survey_folder / "run" / "cloud.las"
    reference.touch()
    for run, options, words in (
        ("images/run", {}, "lies in .*images, whose files are read"),
        (".", {}, "holds the input .*survey.toml"),
        ("run", {"reference": reference}, "holds the input .*cloud.las"),
        ("run", {"reference": survey_folder / "cameras.csv", "visible": reference}, "holds the input .*cloud.las"),
    ):
        with pytest.raises(OutputError, match=words):
            process(survey_folder, survey_folder / run, **options)
