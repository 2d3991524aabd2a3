"""geo.txt of OpenDroneMap: its positions and accuracies count instead of EXIF, in every CRS and form."""

import re
import tomllib

import numpy as np
import pytest
from pyproj import CRS, Transformer
from small_survey import E0, LEVEL, N0, rows_of, unposed, write_image

from geo.errors import GeoError, PlaceMismatch, UnknownUnit
from survey.errors import ConfigError, PosesError
from survey.folder.found import find_survey, survey_inputs
from survey.folder.headers import with_positions
from survey.folder.pose_priors import accuracy_of_gps, common_up_std_of_exif
from survey.init.draft import draft
from survey.photos.exif import Exif, TablePlace, without_void_fixes
from survey.plan.check import check_survey
from survey.pose_files import find_poses
from survey.settings.config import CamerasConfig
from survey.settings.tables import InitOptions
from survey.sfm.gps import positions_in_crs

NAMES = [f"{i:04d}.jpg" for i in range(4)]
# Where geo.txt has the cameras: a metre or two from where EXIF has them, heights too.
PLACES = np.array([[E0 + 3.0 * i, N0 - 2.0 * i + (i % 2), LEVEL + 21.5] for i in range(4)])
HEADERS = {
    "EPSG:25832": 1.0,
    "epsg:25832+5778": 1.0,
    "EPSG: 32632": 1.0,
    "WGS84 UTM 32N": 1.0,
    "WGS 84 UTM 32 n": 1.0,
    "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs": 1.0,
    '"+proj=utm +zone=32 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0 +units=m"': 1.0,
    "EPSG:4326": 1.0,
    "WGS84": 1.0,
    "EPSG:4258+5778": 1.0,
}
# What follows a name: numbers after x and y, as the file format has them.
TAILS = {
    "no height": [],
    "height": ["z"],
    "angles": ["z", "1", "2", "3"],
    "one accuracy": ["z", "1", "2", "3", "0.02"],
    "accuracies": ["z", "0", "0", "0", "0.02", "0.03"],
    "no accuracies": ["z", "0", "0", "0", "0", "0"],
    "more": ["z", "0", "0", "0", "0.02", "0.03", "any", "words 1"],
}


def geo_txt(header: str, tail: list[str], *, names=NAMES, places=PLACES, between: str = " ") -> str:
    """A geo.txt with places in crs of the small survey."""
    crs = CRS(header.strip('"')) if "+proj" in header else _crs(header)
    x, y = Transformer.from_crs("EPSG:25832", crs.to_2d(), always_xy=True).transform(*np.asarray(places)[:, :2].T)
    lines = [header]
    for name, *xyz in zip(names, x, y, np.asarray(places)[:, 2], strict=True):
        words = [f"{xyz[2]:.4f}" if word == "z" else word for word in tail]
        lines.append(between.join([name, f"{xyz[0]:.10f}", f"{xyz[1]:.10f}", *words]))
    return "\n".join(lines) + "\n"


def _crs(header: str) -> CRS:
    words = header.upper().replace(" ", "")
    return CRS({"WGS84UTM32N": "EPSG:32632", "WGS84": "EPSG:4326"}.get(words, words))


@pytest.mark.parametrize(
    ("header", "tail"),
    [*((header, "height") for header in HEADERS), *(("EPSG:4326", tail) for tail in TAILS if tail != "height")],
)
def test_positions_and_accuracies_are_those_of_the_file_in_every_form(tmp_path, header, tail):
    folder = unposed(tmp_path / "s")
    (folder / "geo.txt").write_text(geo_txt(header, TAILS[tail]))
    found = find_survey(folder)
    positions, _ = positions_in_crs(found.headers, found.crs, "crs")
    expected = PLACES.copy()
    if tail == "no height":
        expected[:, 2] = LEVEL + 20.0  # that of EXIF
    # Degrees with ten digits are 10 micrometres.
    assert np.abs(np.array([positions[name] for name in NAMES]) - expected).max() < 1e-4
    (said_of,) = [sentence for sentence in found.findings.assumptions if "geo.txt" in sentence]
    assert said_of.startswith("positions of 4 of 4 images are those in geo.txt (")
    assert "instead of those in EXIF of 4, " in said_of
    has_std = tail in ("accuracies", "more")
    accuracy = accuracy_of_gps(found.config.cameras, found.headers)
    good = "4 of 4 positions good to 0.02, 0.02 and 0.03 m east, north and up (geo.txt)"
    assert accuracy == (good if has_std else "4 of 4 positions of unknown accuracy (geo.txt)")
    assert (common_up_std_of_exif(CamerasConfig(), found.headers) == 0.0) is has_std
    assert any("horizontal accuracy alone" in warning for warning in found.findings.warnings) is (
        tail == "one accuracy"
    )


@pytest.mark.parametrize("between", [" ", "   ", "\t"])
@pytest.mark.parametrize("where", ["geo.txt", "images/geo.txt", "GEO.TXT"])
def test_the_file_is_found_beside_the_photographs_and_never_overwritten(tmp_path, where, between):
    folder = unposed(tmp_path / "s")
    (folder / where).write_text(geo_txt("EPSG:25832", ["z"], between=between))
    assert "geo.txt" in find_survey(folder).findings.assumptions[0].casefold()
    assert survey_inputs(folder).same_as(folder / where) is not None


def test_check_and_init_name_the_file(tmp_path):
    folder = unposed(tmp_path / "s")
    (folder / "geo.txt").write_text(geo_txt("EPSG:25832", ["z"]))
    sections = check_survey(folder)
    assert rows_of(sections, "Found")["positions"].startswith("4 of 4 images have one in geo.txt, heights 2126.5")
    (folder / "survey.toml").unlink()
    text = draft(folder, InitOptions(level_m=LEVEL))
    assert "# Found: positions of 4 of 4 images are those in geo.txt (ETRS89 / UTM zone 32N)" in text
    assert tomllib.loads(text)["crs"].startswith("EPSG:25832+")


def test_the_angles_of_the_file_make_it_no_poses(tmp_path):
    folder = unposed(tmp_path / "s")
    text = geo_txt("EPSG:25832", ["z", "0", "0", "0"]).replace("\n", "\n# image x y z omega phi kappa\n", 1)
    (folder / "geo.txt").write_text("# image x y z omega phi kappa\n" + text)
    assert find_poses(folder) == []
    assert find_survey(folder).poses_path is None


def test_photographs_and_lines_without_each_other_are_named(tmp_path):
    folder = unposed(tmp_path / "s")
    (folder / "geo.txt").write_text(geo_txt("EPSG:25832", ["z"], names=[*NAMES[:3], "other.jpg"]))
    found = find_survey(folder)
    assert "1 image of geo.txt not among the photographs: other.jpg" in found.findings.warnings
    assert "1 image not in geo.txt, which keep what EXIF has: 0003.jpg" in found.findings.warnings
    positions, _ = positions_in_crs(found.headers, found.crs, "crs")
    assert list(positions) == NAMES
    assert abs(positions["0003.jpg"][2] - (LEVEL + 20.0)) < 1e-9


def test_names_are_those_of_the_photographs_by_the_rules_of_all_files(tmp_path):
    folder = unposed(tmp_path / "s")
    (folder / "images" / "0003.jpg").rename(folder / "images" / "a b.jpg")
    (folder / "geo.txt").write_text(
        geo_txt("EPSG:25832", ["z"], names=["0000", "0001.JPG", "images/0002.jpg", "a b.jpg"])
    )
    assert "positions of 4 of 4" in find_survey(folder).findings.assumptions[0]
    for flight in ("a", "b"):
        write_image(folder / "images" / flight / "0009.jpg")
    (folder / "geo.txt").write_text(geo_txt("EPSG:25832", ["z"], names=["0009.jpg", *NAMES[:3]]))
    with pytest.raises(ValueError, match=r"line 2: 0009.jpg fits a/0009.jpg and b/0009.jpg"):
        find_survey(folder)


def test_a_position_in_another_place_is_doubted(tmp_path):
    folder = unposed(tmp_path / "s")
    (folder / "geo.txt").write_text(geo_txt("EPSG:25832", ["z"], places=PLACES + np.array([3000.0, 0.0, 0.0])))
    (warning,) = [text for text in find_survey(folder).findings.warnings if "geo.txt" in text]
    assert re.match(r"the positions in geo.txt lie (299|300)\d m \(median\) from those in EXIF", warning)


SPOILT = {
    "": "is empty, expected a line with its CRS",
    "EPSG:25832\n": "has no line after its CRS",
    "0000.jpg 589012 5194736 2126\n": "line 1: .* is a line of a point, expected the CRS before it",
    "my system\n0000.jpg 1 2 3\n": "line 1: .* is not a CRS that geo.txt may begin with",
    "EPSG:99999\n0000.jpg 1 2 3\n": "is not a known CRS",
    "EPSG:5773\n0000.jpg 1 2 3\n": "expected a CRS of a map or of degrees",
    "EPSG:4978\n0000.jpg 1 2 3\n": "expected a CRS of a map or of degrees",
    "EPSG:25832\n0000.jpg,589012,5194736,2126\n": "line 2: values are separated by commas",
    "EPSG:25832\n0000.jpg 589012\n": "line 2: .* was found, expected image x y",
    "EPSG:25832\n0000.jpg 589012 5194736 nan\n": "line 2: .* was found, expected image x y",
    "EPSG:25832\n0000.jpg 589012 5194736 1 2\n": "line 2: .* was found, expected image x y",
    "EPSG:25832\n0000.jpg 589012 5194736 1 2 3 x 1 1\n": "line 2: .* was found, expected image x y",
    "EPSG:25832\n0000.jpg 589012 5194736 1 0 0 0 -1 1\n": r"line 2: the accuracy is \[-1.0, 1.0\]",
    "EPSG:25832\n0000.jpg 589012 5194736 1 0 0 0 1 0\n": "expected a standard deviation above 0",
    "EPSG:25832\n0000.jpg 589012 5194736 1 0 0 0 1 500\n": "expected a standard deviation above 0 and at most 100",
    "EPSG:25832\n0000.jpg 589012 5194736\n0000.JPG 589012 5194736\n": "line 3: 0000.jpg has a second position",
    "EPSG:25832\nother.jpg 589012 5194736\n": 'names none of the photographs: "other.jpg" for "0000.jpg"',
    "EPSG:4326\n0000.jpg 10 5194736\n": "line 2: 10, 5194736 is not on the map of WGS 84",
    "EPSG:2154\n0000.jpg 5000000 5194736\n": "degrees outside the area that .* is made for",
}


@pytest.mark.parametrize("text", SPOILT)
def test_a_spoilt_file_is_refused_with_its_line(tmp_path, text):
    folder = unposed(tmp_path / "s")
    (folder / "geo.txt").write_text(text)
    with pytest.raises((PosesError, ConfigError, PlaceMismatch), match=SPOILT[text]):
        find_survey(folder)


def test_two_files_are_refused(tmp_path):
    folder = unposed(tmp_path / "s")
    for name in ("geo.txt", "images/geo.txt"):
        (folder / name).write_text(geo_txt("EPSG:25832", ["z"]))
    with pytest.raises(PosesError, match="both have positions of the photographs; remove one"):
        find_survey(folder)


@pytest.mark.parametrize(
    ("header", "gps_height", "error", "words"),
    [
        ("EPSG:25832+5773", "crs", GeoError, "heights in geo.txt are above EGM96 height, expected above GHA height"),
        ("EPSG:4979", "crs", ConfigError, 'above the ellipsoid .* write gps_height = "ellipsoidal"'),
        ("EPSG:2263", "crs", UnknownUnit, "the GPS heights in geo.txt have no unit"),
    ],
)
def test_heights_of_another_datum_or_of_no_unit_are_refused(header, gps_height, error, words):
    head = at(header, (10.17, 46.9, 2126.0) if header == "EPSG:4979" else (1e6, 2e5, 10.0))
    with pytest.raises(error, match=words):
        positions_in_crs({"a.jpg": head}, CRS("EPSG:25832+5778"), gps_height)


@pytest.mark.parametrize(("header", "factor"), [("EPSG:26915+5703", 1.0), ("EPSG:26915+6360", 1200.0 / 3937.0)])
@pytest.mark.parametrize("gps_height", ["crs", "ellipsoidal"])
def test_heights_of_the_datum_of_the_survey_are_brought_to_its_unit(header, factor, gps_height):
    head = at(header, (5e5, 5e6, 200.0))
    found, _ = positions_in_crs({"a.jpg": head}, CRS("EPSG:26915+5703"), gps_height)
    assert np.abs(found["a.jpg"] - [5e5, 5e6, 200.0 * factor]).max() < 1e-9


def at(header: str, place: tuple[float, float, float]) -> Exif:
    return Exif((64, 48), (0.0, 0.0, 0.0), None, 1, "", None, table_place=TablePlace("geo.txt", CRS(header), place))


@pytest.mark.parametrize("has_height", [True, False])
def test_a_position_of_the_file_is_not_void_and_one_in_exif_still_gives_its_height(tmp_path, has_height):
    headers = {name: Exif((64, 48), (47.0, 9.0, 500.0), None, 1, "", None, is_void=name == NAMES[0]) for name in NAMES}
    lines = [f"{name} 9.0 47.0{' 510.0' if has_height else ''}" for name in NAMES]
    (tmp_path / "geo.txt").write_text("\n".join(["EPSG:4326", *lines, ""]))
    done, _ = with_positions(tmp_path / "geo.txt", headers)
    assert without_void_fixes(done) == done
    assert [head.lat_lon_height[2] for head in done.values()] == [510.0 if has_height else 500.0] * len(NAMES)
    assert not any(head.is_void for head in done.values())
