"""Pipes, sockets and devices in folders of surveys and runs are named, and never opened."""

import os
import socket

import pytest
from command_line import bathynerf
from shown_run import small_run
from small_survey import TOML, small_survey, unposed

from survey.commands.faults import BAD_INPUT

NAMES = ("survey.toml", "cameras.csv", "any.xml", "images/x.jpg", "sub/x")
KINDS = {
    "pipe": os.mkfifo,
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "socket": lambda path: socket.socket(socket.AF_UNIX).bind(os.path.relpath(path)),
}
VERBS = (("check",), ("init", "--force"), ("mark", "--no-browser"), ("process",))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_pipe_or_device_in_a_survey_is_named(tmp_path, monkeypatch, name, kind):
    folder = small_survey(tmp_path / "s")
    path = folder / name
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    monkeypatch.chdir(path.parent)
    if kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    else:
        KINDS[kind](path)
    for verb, *options in VERBS:
        said = bathynerf(verb, folder, *options)
        assert said.exit_code == BAD_INPUT
        assert f"{path} is a pipe, a socket or a device, expected a file or folder; remove it" in said.stderr


@pytest.mark.parametrize("key", ['masks = "/dev/zero"', 'dir = "/dev/zero"'])
def test_a_device_that_the_settings_name_is_named(tmp_path, key):
    said = bathynerf("check", small_survey(tmp_path / "s", toml=f"{TOML}[images]\n{key}\n"))
    assert said.exit_code == BAD_INPUT
    assert "/dev/zero is a pipe, a socket or a device" in said.stderr


@pytest.mark.parametrize("name", ["cloud.las", "report.json", "stages/x", ".lock"])
@pytest.mark.parametrize("verb", [("view",), ("export", "--dem", "dem.tif")])
def test_a_pipe_in_a_run_is_named(tmp_path, name, verb):
    run = small_run(tmp_path)
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)
    options = [tmp_path / each if "." in each else each for each in verb[1:]]
    said = bathynerf(verb[0], run, *options)
    assert said.exit_code == BAD_INPUT
    assert f"{run / name} is a pipe" in said.stderr


ENTRIES = (
    *("gcp_list.txt", "geo.txt", "clicks.csv", "any.csv", "any.json", "any.txt", "any.xml", "any.nvm", "any.psx"),
    *(
        "reconstruction.json",
        "transforms.json",
        "images/x.jpg",
        "masks/0000.png",
        "images/0000_mask.png",
        "geoid/x.tif",
    ),
    *("sparse/0/images.bin", "tracks.csv", "any.gpkg", "reconstruction.topocentric.json", "any.kml"),
)


@pytest.mark.parametrize("kind", ["folder", "link to itself", "link to nothing"])
def test_a_folder_or_broken_link_under_the_name_of_a_file_ends_in_no_other_error(tmp_path, kind):
    for name in ENTRIES:
        folder = unposed(tmp_path / name.replace("/", "_"))
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "folder":
            path.mkdir()
        else:
            path.symlink_to(path.name if kind == "link to itself" else "nowhere")
        said = bathynerf("check", folder)
        assert said.exit_code in (0, BAD_INPUT), name
        assert "bug" not in said.stderr, name
