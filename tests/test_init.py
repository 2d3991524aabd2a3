"""`bathynerf init`: a folder as a program leaves it becomes one that check accepts."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from command_line import bathynerf
from foreign_block import HEIGHT, SIZE, draw_block, in_utm, write_images
from scipy.spatial.transform import Rotation
from small_survey import unposed, write_image
from test_pose_files_metashape import cameras_xml
from test_pose_files_opensfm import REFERENCE, block_json, tracks_csv

from geo.area_of_use import height_systems_at
from geo.crs import vertical_crs
from survey.errors import ConfigError
from survey.init.crs import Answers, FolderPhotographs, SettingsTable, write_crs
from survey.init.draft import draft
from survey.photos.exif import Exif
from survey.photos.xmp import ELLIPSOIDAL

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
    lens = block.lens
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.k[:2], lens.p1, lens.p2)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 OPENCV {SIZE[0]} {SIZE[1]} {' '.join(map(repr, numbers))}\n")
    (model / "points3D.txt").write_text("")
    lines = []
    for i, (name, place) in enumerate(zip(block.names, in_utm(block.centres).tolist(), strict=True)):
        x, y, z, w = Rotation.from_matrix(block.cams[i]).as_quat()
        t = -block.cams[i] @ (scale * block.centres[i])
        lines += [" ".join(map(str, (i + 1, w, x, y, z, *t, 1, name))), ""]
        write_image(folder / "images" / name, size=SIZE, gps=place if gps else None)
    (model / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("made", [photographs_alone, opendronemap, metashape, colmap])
def test_what_a_program_leaves_becomes_a_survey_that_check_accepts(tmp_path, made):
    folder = tmp_path / "s"
    folder.mkdir()
    made(folder)
    level = () if made is photographs_alone else ("--level", LEVEL)
    written = bathynerf("init", folder, *level)
    assert written.exit_code == 0, written.output
    settings = tomllib.loads((folder / "survey.toml").read_text())
    assert settings["crs"] == "EPSG:32632+5773"
    assert settings["water"] == ({"level_m": LEVEL} if level else {})
    checked = bathynerf("check", folder)
    assert checked.exit_code == 0, checked.output


def test_the_origin_of_a_colmap_model_is_that_of_its_gps_positions(tmp_path):
    colmap(tmp_path)
    local = tomllib.loads(draft(tmp_path, Answers(level_m=LEVEL)))["local"]
    # The axes of EXIF are those of WGS 84, and 15 m apart they turn by 1e-6: the rest is that GPS has 1e-7 degrees.
    assert local["origin"] == pytest.approx(in_utm(np.zeros((1, 3)))[0], abs=0.05)


def test_a_model_that_is_not_in_metres_is_left_to_the_gps_positions(tmp_path):
    colmap(tmp_path, scale=0.1)
    text = draft(tmp_path, Answers(level_m=LEVEL))
    assert tomllib.loads(text)["local"] == {}
    assert "are their own: placed with a scale of 10 and a rotation by 0 degrees by" in text


def test_a_local_frame_without_gps_needs_its_origin(tmp_path):
    colmap(tmp_path, gps=False)
    answers = Answers(crs="EPSG:25832+5778", level_m=LEVEL)
    with pytest.raises(ConfigError, match="--origin"):
        draft(tmp_path, answers)
    given = tomllib.loads(draft(tmp_path, Answers(answers.crs, LEVEL, origin=(1.0, 2.0, 3.0))))
    assert given["local"]["origin"] == [1.0, 2.0, 3.0]


def test_settings_are_never_replaced_without_force(tmp_path):
    photographs_alone(tmp_path / "s")
    path = tmp_path / "s" / "survey.toml"
    path.write_text("mine")
    refused = bathynerf("init", tmp_path / "s")
    assert (refused.exit_code, path.read_text()) == (2, "mine")
    assert "--force" in refused.output
    assert bathynerf("init", tmp_path / "s", "--force").exit_code == 0
    assert "crs" in tomllib.loads(path.read_text())


def test_nothing_is_written_where_something_is_missing(tmp_path):
    metashape(tmp_path)
    refused = bathynerf("init", tmp_path)
    assert refused.exit_code == 2
    assert "--level" in refused.output
    assert not (tmp_path / "survey.toml").exists()


def test_a_terminal_is_asked_for_what_no_file_tells(tmp_path):
    metashape(tmp_path)
    asked = []

    def ask(question: str) -> str:
        asked.append(question)
        return "5773" if "Heights" in question else "2109.5"

    with pytest.raises(ConfigError, match="expected one of the codes"):
        draft(tmp_path, Answers(ask=ask))
    assert "9274 EVRF2000 Austria" in asked[0]
    settings = tomllib.loads(draft(tmp_path, Answers(crs="EPSG:32632+5773", ask=ask)))
    assert settings["water"]["level_m"] == 2109.5
    assert len(asked) == 2


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
    settings = tomllib.loads(draft(tmp_path / "s", Answers()))
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
    crs = write_crs(photographs_above_the_ellipsoid(*lat_lon), Answers(), top, cameras)
    written = tomllib.loads(top.text() + cameras.text())
    if vertical_crs(crs) is None:
        assert written["crs"].endswith("+4979")
        assert "cameras" not in written
    else:
        assert lat_lon != (0.0, -30.0)
        assert written["crs"].endswith("+5709")
        assert written["cameras"]["gps_height"] == "ellipsoidal"
