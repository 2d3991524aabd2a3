"""`bathynerf init`: a folder as a program leaves it becomes one that check accepts."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import typer
from command_line import Terminal, bathynerf, fake_module, raising
from foreign_block import HEIGHT, SIZE, draw_block, in_utm, write_images
from small_survey import unposed, write_image
from test_folder_gps_placement import colmap_text
from test_pose_files_metashape import cameras_xml
from test_pose_files_opensfm import REFERENCE, block_json, tracks_csv

from geo.compatibility import height_systems_at
from geo.crs import vertical_crs
from survey.commands.console import asking
from survey.errors import ConfigError
from survey.init.crs import FolderPhotographs, SettingsTable, write_crs
from survey.init.draft import draft
from survey.photos.exif import Exif
from survey.photos.xmp import ELLIPSOIDAL
from survey.settings.tables import InitOptions

LEVEL = HEIGHT + 4.0


def photographs_alone(folder):
    (unposed(folder) / "survey.toml").unlink()


def opendronemap(folder):
    block = draw_block()
    write_images(folder, block.names)
    path = folder / "opensfm" / "reconstruction.json"
    path.parent.mkdir()
    path.write_text(json.dumps([block_json(block, reference_lla=REFERENCE)]))
    path.with_name("tracks.csv").write_text(tracks_csv(block))


def metashape(folder):
    block = draw_block()
    write_images(folder, block.names)
    (folder / "cameras.xml").write_text(cameras_xml(block))


def colmap(folder, *, scale=1.0, gps=True):
    """A model in metres, east, north and up of the place of the block, with positions in EXIF."""
    block = draw_block()
    folder.mkdir(exist_ok=True)
    colmap_text(folder, replace(block, centres=scale * block.centres, points=scale * block.points))
    for name, place in zip(block.names, in_utm(block.centres).tolist(), strict=True):
        write_image(folder / "images" / name, size=SIZE, gps=place if gps else None)


@pytest.mark.parametrize("made", [photographs_alone, opendronemap, metashape, colmap])
def test_what_a_program_leaves_becomes_a_survey_that_check_accepts(tmp_path, made):
    folder = tmp_path / "s"
    folder.mkdir()
    made(folder)
    level = () if made is photographs_alone else ("--level", LEVEL)
    written = bathynerf("init", folder, *level)
    assert written.exit_code == 0, written.output
    assert "level_m" in written.output
    settings = tomllib.loads((folder / "survey.toml").read_text())
    assert settings["crs"] == "EPSG:32632+5773"
    assert settings["water"] == ({"level_m": LEVEL} if level else {})
    checked = bathynerf("check", folder)
    assert checked.exit_code == 0, checked.output


def test_the_origin_of_a_colmap_model_is_that_of_its_gps_positions(tmp_path):
    colmap(tmp_path)
    local = tomllib.loads(draft(tmp_path, InitOptions(level_m=LEVEL)))["local"]
    # The axes of EXIF are those of WGS 84, and 15 m apart they turn by 1e-6: the rest is that GPS has 1e-7 degrees.
    assert local["origin"] == pytest.approx(in_utm(np.zeros((1, 3)))[0], abs=0.05)


def test_a_model_that_is_not_in_metres_is_left_to_gps_positions_and_without_these_needs_its_origin(tmp_path):
    colmap(tmp_path / "scaled", scale=0.1)
    text = draft(tmp_path / "scaled", InitOptions(level_m=LEVEL))
    assert tomllib.loads(text)["local"] == {}
    assert "are their own: placed with a scale of 10 and a rotation by 0 degrees by" in text
    colmap(tmp_path, gps=False)
    options = InitOptions(crs="EPSG:25832+5778", level_m=LEVEL)
    with pytest.raises(ConfigError, match="--origin"):
        draft(tmp_path, options)
    given = tomllib.loads(draft(tmp_path, replace(options, origin=(1.0, 2.0, 3.0))))
    assert given["local"]["origin"] == [1.0, 2.0, 3.0]


def test_settings_are_never_replaced_without_force_nor_written_where_something_is_missing(tmp_path):
    photographs_alone(tmp_path / "s")
    path = tmp_path / "s" / "survey.toml"
    path.write_text("mine")
    refused = bathynerf("init", tmp_path / "s")
    assert (refused.exit_code, "--force" in refused.output, path.read_text()) == (2, True, "mine")
    assert bathynerf("init", tmp_path / "s", "--force").exit_code == 0
    assert "crs" in tomllib.loads(path.read_text())
    metashape(tmp_path / "m")
    refused = bathynerf("init", tmp_path / "m")
    assert (refused.exit_code, "--level" in refused.output) == (2, True)
    assert not (tmp_path / "m" / "survey.toml").exists()


def test_a_terminal_is_asked_for_what_no_file_tells(tmp_path):
    metashape(tmp_path)
    asked = []

    def ask(question, read):
        asked.append(question)
        return read("5773" if "Heights" in question else "2109.5 sea")

    with pytest.raises(ConfigError, match="expected one of the codes"):
        draft(tmp_path, InitOptions(ask=ask))
    assert "9274 EVRF2000 Austria" in asked[0]
    settings = tomllib.loads(draft(tmp_path, InitOptions(crs="EPSG:32632+5773", ask=ask)))
    assert settings["water"] == {"level_m": 2109.5, "refractive_index": 1.34, "index_wavelength_nm": 589.3}
    assert len(asked) == 2
    assert (
        tomllib.loads(draft(tmp_path, InitOptions(crs="EPSG:32632+5773", ask=lambda _, read: read("dry"))))["dry"]
        is True
    )


def test_a_mistyped_answer_is_asked_for_again(monkeypatch):
    answers, terminal = ["deep", "nan", "1e9", "", " 12,34 sea "], Terminal()
    monkeypatch.setattr("typer.prompt", lambda *_args, **_options: answers.pop(0))
    monkeypatch.setattr("sys.stdin", terminal)
    monkeypatch.setattr("sys.stderr", terminal)
    found = asking(InitOptions(), needs_level=True).with_level("in metres", can_do_without=False)
    assert (found.level_m, found.sea, answers) == (12.34, True, [])
    said = " ".join(terminal.getvalue().split())
    assert 'the answer is "deep", expected a number such as 12.34, 12.34 sea, or dry' in said
    assert "the height of the water in metres is not known" in said
    # Ctrl-C and Ctrl-D at a question end the command as anywhere else.
    monkeypatch.setattr("typer.prompt", raising(typer.Abort()))
    with pytest.raises(KeyboardInterrupt):
        asking(InitOptions(), needs_level=True).with_level("in metres", can_do_without=False)
    for level in ("nan", "1e9"):
        assert (
            f'the answer is "{level}", expected a number such as 12.34, 12.34 sea, or dry; levels are -500 to 9000 m'
            in said
        )


@pytest.mark.parametrize(
    ("name", "table", "key"),
    [
        ("gauge.csv", "water", "gauge"),
        ("Shoreline.geojson", "water", "shoreline"),
        ("surface.csv", "water", "gnss_points"),
        ("clicks.csv", "water", "clicks"),
        ("levels.csv", "water", "image_levels"),
        ("gcp_list.txt", "control", "gcps"),
        ("checkpoints.csv", "control", "checkpoints"),
    ],
)
def test_files_are_taken_by_their_names(tmp_path, name, table, key):
    photographs_alone(tmp_path / "s")
    (tmp_path / "s" / name).write_text("")
    settings = tomllib.loads(draft(tmp_path / "s", InitOptions()))
    assert settings[table] == {key: name}


def test_a_height_system_is_taken_where_it_is_the_only_one():
    names = {place: [system.name for system in height_systems_at(*place)] for place in [(52.1, 4.9), (0.0, -30.0)]}
    assert names == {(52.1, 4.9): ["NAP height"], (0.0, -30.0): []}
    # Rectangles around countries overlap: near a border there are several, and the newest of each.
    codes = {system.to_epsg() for system in height_systems_at(48.1, 11.6)}
    assert 7837 in codes
    assert codes.isdisjoint({5783, 5784})


def photographs_above_the_ellipsoid(lat, lon):
    head = Exif((640, 480), (lat, lon, 60.0), 800.0, 1, "DJI FC6310", None, height_datum=ELLIPSOIDAL)
    return FolderPhotographs({"a.jpg": head, "b.jpg": head}, None, None)


@pytest.mark.parametrize("lat_lon", [(0.0, -30.0), (52.1, 4.9)])
def test_heights_above_the_ellipsoid_become_national_ones_only_by_the_grid_of_the_geoid(lat_lon):
    """Whether the grid is installed is the machine's business; crs and gps_height have to agree either way."""
    top, cameras = SettingsTable(""), SettingsTable("cameras")
    crs = write_crs(photographs_above_the_ellipsoid(*lat_lon), InitOptions(), top, cameras)
    written = tomllib.loads(top.text() + cameras.text())
    if vertical_crs(crs) is None:
        assert written["crs"].endswith("+4979")
        assert "cameras" not in written
    else:
        assert lat_lon != (0.0, -30.0)
        assert written["crs"].endswith("+5709")
        assert written["cameras"]["gps_height"] == "ellipsoidal"


def bare_card(folder):
    """Photographs as a card has them."""
    photographs_alone(folder)
    (folder / "DCIM").mkdir()
    (folder / "images").rename(folder / "DCIM" / "100MEDIA")
    return folder


@pytest.fixture
def processed(monkeypatch):
    """The folders that process is called for."""
    calls = []
    fake_module(monkeypatch, "survey.run.process", process=lambda folder, *_, **__: calls.append(folder) or 0)
    return calls


def test_process_writes_the_settings_of_bare_photographs_and_goes_on(tmp_path, processed):
    folder = bare_card(tmp_path / "s")
    for level, said in (((), "--level 12.34, or --dry"), (("--level", LEVEL + 500.0), "all of them under the water")):
        refused = bathynerf("process", folder, *level)
        assert (refused.exit_code, processed, (folder / "survey.toml").exists()) == (2, [], False)
        assert said in " ".join(refused.output.split())
    for _ in range(2):  # The same command resumes a run
        done = bathynerf("process", folder, "--level", LEVEL, "--sea")
        assert done.exit_code == 0, done.output
        assert ("refractive_index = 1.34" in done.stdout, "# No poses" in done.stdout) == (not processed[1:], False)
    settings = tomllib.loads((folder / "survey.toml").read_text())
    assert settings["images"] == {"dir": "DCIM/100MEDIA"}
    assert settings["water"]["refractive_index"] == 1.34
    assert processed == [folder] * 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--level", 3.0), "level_m is told to be 3.0, but"),
        (("--dry",), "dry is told to be True, but"),
        (("--sea",), "sea is told to be True, but"),
        (("--crs", "EPSG:25832+7837"), "has EPSG:32632+5773; change it there"),
    ],
)
def test_options_that_contradict_the_settings_are_refused(tmp_path, processed, options, said):
    folder = bare_card(tmp_path / "s")
    assert bathynerf("init", folder, "--level", LEVEL).exit_code == 0
    refused = bathynerf("process", folder, *options)
    assert (refused.exit_code, processed) == (2, [])
    assert said in refused.output


def test_check_of_bare_photographs_says_what_process_would_write_and_writes_nothing(tmp_path):
    folder = bare_card(tmp_path / "s")
    checked = bathynerf("check", folder)
    assert checked.exit_code == 0, checked.output
    assert 'dir = "DCIM/100MEDIA"' in checked.stdout
    assert not (folder / "survey.toml").exists()


def control_alone(folder, header, place, height=581):
    write_image(folder / "images" / "0000.jpg")
    (folder / "gcp_list.txt").write_text(f"{header}\n{place} {height} 4 5 0000.jpg a\n")
    return folder


@pytest.mark.parametrize(
    ("header", "place", "crs"),
    [
        ("EPSG:25832+7837", "676120 5311480", "EPSG:25832+7837"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs", "676120 5311480", "EPSG:32632+"),
        ("WGS84 UTM 32N", "676120 5311480", "EPSG:32632+"),
        # With the heights that EPSG combines with it.
        ("EPSG:27700", "351139.7 512875.8", "EPSG:27700+5701"),
    ],
)
def test_the_crs_of_control_points_is_taken_with_its_heights(tmp_path, header, place, crs):
    folder = control_alone(tmp_path / "s", header, place)
    settings = tomllib.loads(draft(folder, InitOptions(level_m=LEVEL)))
    assert settings["crs"].startswith(crs)
    assert settings["control"] == {"gcps": "gcp_list.txt"}


def test_photographs_that_nothing_places_are_refused(tmp_path):
    write_image(tmp_path / "images" / "0000.jpg")
    with pytest.raises(ConfigError, match="nothing tells where the photographs lie"):
        draft(tmp_path, InitOptions(level_m=LEVEL))


def test_the_question_for_the_level_says_where_the_cameras_are_and_their_bounds_are_proposed(tmp_path):
    photographs_alone(tmp_path)
    asked = []
    text = draft(tmp_path, InitOptions(ask=lambda question, read: asked.append(question) or read("")))
    assert "cameras are at 21" in asked[-1]
    (line,) = [line for line in text.splitlines() if line.startswith("# bounds")]
    low_e, low_n, high_e, high_n = tomllib.loads(line.removeprefix("# "))["bounds"]
    assert 5.0 < high_e - low_e < 20.0
    assert 5.0 < high_n - low_n < 20.0


def test_names_of_files_stay_in_their_comment(tmp_path):
    table = SettingsTable("cameras")
    table.set("poses", "a.csv", "not certain: there is also b\n[water]\nlevel_m = 1")
    table.add_comments("Found: \x1b[2J.")
    assert tomllib.loads(table.text()) == {"cameras": {"poses": "a.csv"}}
    assert "\x1b" not in table.text()


def test_a_folder_of_any_name_has_its_name_escaped(tmp_path):
    folder = tmp_path / "a\n[water]\x1b[31m"
    photographs_alone(folder)
    assert tomllib.loads(draft(folder, InitOptions(level_m=LEVEL)))["name"] == "a\\n[water]\\x1b[31m"
