"""Metashape's cameras.xml: chunk, component and Earth, its lens, and what its cameras know of themselves."""

import re
from xml.sax.saxutils import escape

import numpy as np
import pytest
from control_files import METASHAPE
from foreign_block import (
    CLOSE_PX,
    SIZE,
    draw_block,
    ecef_from_enu,
    in_ecef,
    in_utm,
    load,
    lon_lat_height,
    most_missed_px,
)
from pyproj import CRS
from scipy.spatial.transform import Rotation

from geo.errors import GeoError
from survey.errors import PosesError
from survey.folder.found import NO_WATER
from survey.folder.pose_priors import BY_FILE
from survey.plan.check import check_survey
from survey.plan.plan import pose_choice
from survey.pose_files import find_poses, read_poses

WKT = CRS("EPSG:25832").to_wkt("WKT1_GDAL")
# From a chunk of no particular scale, place and direction to the Earth.
RESOLUTION = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
SCALE, TURN = 12.354, Rotation.from_euler("XYZ", (33.0, -71.0, 140.0), degrees=True).as_matrix()


@pytest.fixture(scope="module")
def block():
    return draw_block()


def numbers(values) -> str:
    return " ".join(f"{v:.17g}" for v in np.ravel(values))


def calibration(lens, kind="frame") -> str:
    """A lens as Metashape writes it: the middle of the image is 0, 0; p1 and p2 change places."""
    b1, b2 = lens.fx - lens.fy, lens.skew
    values = {
        "f": lens.fy, "cx": lens.cx - SIZE[0] / 2, "cy": lens.cy - SIZE[1] / 2, "b1": b1, "b2": b2,
        **{f"k{i + 1}": k for i, k in enumerate(lens.k)}, "p1": lens.p2, "p2": lens.p1,
    }  # fmt: skip
    tags = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items() if value)
    return f'<calibration type="{kind}" class="adjusted">{RESOLUTION}{tags}</calibration>'


def transform_of(origin: np.ndarray, scale=SCALE) -> str:
    return (
        f'<transform><rotation locked="true">{numbers(TURN)}</rotation><translation locked="true">{numbers(origin)}'
        f'</translation><scale locked="true">{scale!r}</scale></transform>'
    )


def cameras_xml(
    block, *, where="component", labels=None, wkt=WKT, more="", sensor="", world=None, references=()
) -> str:
    """The block in a chunk; the origin of this lies near the cameras, or is 0 where the world is local."""
    turn, origin = (ecef_from_enu(), in_ecef(np.zeros((1, 3)))[0]) if world is None else world
    lines = []
    for i, name in enumerate(block.names):
        centre = turn @ block.centres[i] + origin
        matrix = np.eye(4)
        matrix[:3, :3] = TURN.T @ turn @ block.cams[i].T
        matrix[:3, 3] = TURN.T @ (centre - origin) / SCALE
        reference = references[i] if references else ""
        component = 'component_id="0"' if where == "component" else ""
        lines.append(
            f'<camera id="{i}" sensor_id="{i % 2}" {component} label="{labels[i] if labels else name}">'
            f"<transform>{numbers(matrix)}</transform><orientation>1</orientation>{reference}</camera>"
        )
    sensors = "".join(
        f'<sensor id="{i}" label="one" type="frame">{RESOLUTION}'
        f'<calibration type="frame" class="initial"><f>9</f></calibration>{calibration(block.lens)}{sensor}</sensor>'
        for i in (0, 1)
    )
    component = f'<components><component id="0">{transform_of(origin)}</component></components>'
    of_component, of_chunk = (component, "") if where == "component" else ("", transform_of(origin))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1"><sensors>{sensors}'
        f'</sensors>{of_component}<cameras><group id="0">{"".join(lines)}</group>{more}</cameras>{of_chunk}'
        f"<reference>{escape(wkt)}</reference></chunk></document>"
    )


def loaded(folder, block, text: str, **settings):
    folder.mkdir(exist_ok=True)
    (folder / "cameras.xml").write_text(text)
    return load(folder, block, "cameras.xml", **settings)


@pytest.mark.parametrize("where", ["component", "chunk"])
def test_a_georeferenced_chunk_is_set_on_the_earth(tmp_path, block, where):
    survey = loaded(tmp_path, block, cameras_xml(block, where=where))
    assert find_poses(tmp_path) == [tmp_path / "cameras.xml"]
    assert most_missed_px(survey, block) < CLOSE_PX
    assert survey.provenance.tool == "Metashape"
    assert survey.views[0].lens.model == "FULL_OPENCV"
    assert survey.findings.warnings == (NO_WATER,)


def test_the_affine_term_and_the_eighth_power_of_the_radius_are_kept(tmp_path, block):
    block = block.with_lens(k=(-0.08, 0.03, -0.01, 0.02), skew=1.7)
    survey = loaded(tmp_path, block, cameras_xml(block))
    assert survey.views[0].lens.model == "BROWN_AFFINE"
    assert most_missed_px(survey, block) < CLOSE_PX
    # A test that would not see them proves nothing.
    without = block.with_lens(skew=0.0)
    assert most_missed_px(loaded(tmp_path, block, cameras_xml(without)), block) > 0.5


@pytest.mark.parametrize(
    "change",
    [{"p1": -0.002, "p2": 0.004}, {"cx": 326.0}, {"cy": 237.75}, {"fy": 520.0}, {"k": (-0.08, 0.03, 0.01, 0.0)}],
    ids=["p1 and p2 swapped", "half a pixel right", "half a pixel up", "b1 lost", "sign of k3"],
)
def test_half_a_pixel_or_swapped_coefficients_do_not_pass(tmp_path, block, change):
    assert most_missed_px(loaded(tmp_path, block, cameras_xml(block.with_lens(**change))), block) > 0.3


def test_labels_may_be_paths_or_have_no_suffix(tmp_path, block):
    labels = [f"/home/user/flight/{name}" for name in block.names[:3]] + [name[:-4] for name in block.names[3:]]
    survey = loaded(tmp_path, block, cameras_xml(block, labels=labels))
    assert most_missed_px(survey, block) < CLOSE_PX


@pytest.mark.parametrize(
    "wkt", [CRS("EPSG:4326").to_wkt("WKT1_GDAL"), CRS("EPSG:31468").to_wkt("WKT1_GDAL").replace("31468", "0")]
)
def test_the_map_of_the_chunk_does_not_matter_its_datum_does(tmp_path, block, wkt):
    first, other = (loaded(tmp_path, block, cameras_xml(block, wkt=one)) for one in (WKT, wkt))
    moved = np.subtract(*(s.frame.crs_from_local(s.views[0].camera.centre) for s in (first, other)))
    # DHDN lies some hundred metres from WGS 84; the same geocentric coordinates count on its own ellipsoid.
    assert (np.linalg.norm(moved) > 100.0) == ("Bessel" in wkt)
    assert (np.linalg.norm(moved) < 1e-3) == ("Bessel" not in wkt)


def test_a_chunk_in_local_coordinates_takes_its_place_from_local(tmp_path, block):
    text = cameras_xml(block, wkt='LOCAL_CS["Local Coordinates (m)"]', world=(np.eye(3), np.zeros(3)))
    origin = in_utm(np.zeros((1, 3)))[0].tolist()
    survey = loaded(tmp_path, block, text, more=f"[local]\norigin = {origin}")
    assert most_missed_px(survey, block) < CLOSE_PX


def test_cameras_that_are_disabled_or_not_aligned_are_left_out_and_named(tmp_path, block):
    more = (
        '<camera id="90" sensor_id="0" label="off.jpg" enabled="false"><transform>1</transform></camera>'
        '<camera id="91" sensor_id="0" label="lost.jpg"/><camera id="92" component_id="7" label="far.jpg"/>'
    )
    text = cameras_xml(block, more=more, sensor="<rolling_shutter>true</rolling_shutter>")
    warnings = " ".join(loaded(tmp_path, block, text).findings.warnings)
    assert "1 camera disabled in cameras.xml, left out: off.jpg" in warnings
    assert "2 cameras not aligned in cameras.xml, left out: lost.jpg, far.jpg" in warnings
    assert "compensated a rolling shutter" in warnings


def reference_tags(block, more: str, shift=0.0) -> list[str]:
    places = (in_utm(block.centres) + shift).tolist()
    return [f'<reference x="{e!r}" y="{n!r}" z="{h!r}" {more} enabled="true"/>' for e, n, h in places]


def test_positions_before_the_adjustment_come_with_the_accuracy_of_their_reference(tmp_path, block):
    text = cameras_xml(
        block, references=reference_tags(block, 'sx="0.02" sy="0.03" sz="0.05"', shift=np.array([0.1, 0.0, 0.2]))
    )
    survey = loaded(tmp_path, block, text)
    for view in survey.views:
        prior = survey.observations.priors[view.name]
        assert prior.source == BY_FILE
        assert prior.position_std.tolist() == [0.02, 0.03, 0.05]
        # 0.1 m of easting: the grid is turned by 0.8 degrees and 0.04 % smaller there.
        assert prior.position - view.camera.centre == pytest.approx([0.1, 0.0, 0.2], abs=2e-3)
    assert pose_choice(survey, "auto", free_water=False)[0] == "refine"
    assert "good to 0.02, 0.03 and 0.05 m" in dict(check_survey(tmp_path)[0].rows)["accuracy"]
    survey = loaded(tmp_path, block, text, cameras="position_std_m = 0.1")
    assert {prior.source for prior in survey.observations.priors.values()} == {"survey.toml"}


@pytest.mark.parametrize(
    ("accuracy", "sensor"),
    [("", ""), ('sxyz="0.03"', "<antenna><location_ref>0 0.1 0</location_ref></antenna>")],
    ids=["no accuracy", "an antenna"],
)
def test_without_accuracies_or_with_an_antenna_the_reference_is_not_used(tmp_path, block, accuracy, sensor):
    text = cameras_xml(block, references=reference_tags(block, accuracy), sensor=sensor)
    survey = loaded(tmp_path, block, text)
    assert {prior.source for prior in survey.observations.priors.values()} == {"poses file"}


def test_water_makes_straight_rays_bent_and_check_says_so(tmp_path, block):
    survey = loaded(tmp_path, block, cameras_xml(block), more="[water]\nlevel_m = 2106.0\nrefractive_index = 1.333")
    (said,) = [text for text in survey.findings.assumptions if "refraction" in text]
    assert said.startswith("Metashape ignores refraction")
    assert pose_choice(survey, "fixed", free_water=False)[1] == "set by --poses, though Metashape ignored refraction"
    assert pose_choice(survey, "auto", free_water=False)[0] == "refine"


ADJUSTED = 'class="adjusted">'
FAULTS = {
    "no XML": ("<?xml", "what?", "is not well-formed XML"),
    "entities": ("<document", '<!DOCTYPE a [<!ENTITY b "cc">]><document', r"a document type \(<!DOCTYPE>\) was found"),
    "external": ("<document", '<!DOCTYPE a SYSTEM "http://x"><document', r"a document type"),
    "deep": ("<chunk ", "<a>" * 200 + "<chunk ", "nested more than 100 deep"),
    "digits": ('<scale locked="true">', '<scale locked="true">' + "9" * 10_000, "9{57}.* was found, expected 1"),
    "NaN": ("<rotation ", "<rotation>nan" + 8 * " 0" + "</rotation><x ", "nan 0 .* expected 9 finite numbers"),
    "shear": ("<rotation ", "<rotation>1 2 0 0 1 0 0 0 1</rotation><x ", "is not a rotation with a scale"),
    "no scale": ("<scale ", "<scale>0</scale><x ", "is not a rotation with a scale"),
    "large scale": ("<scale ", "<scale>1e308</scale><x ", "is not a rotation with a scale"),
    "overflow": (
        "<rotation ",
        "<rotation>1e200 0 0 0 1e200 0 0 0 1e200</rotation><scale>1e200</scale><x ",
        "is not a rotation with a scale",
    ),
    "no sensor": ('<sensor id="1"', '<sensor id="7"', "its sensor is not in the file"),
    "spherical": ('"frame" class="adjusted"', '"spherical" class="adjusted"', "of the type spherical is not supported"),
    "focal length": ("<f>523.0", "<f>1e999", "f is 1e999, expected a finite number"),
    "higher tangential": ("<f>523.0", "<p3>0.1</p3><f>523.0", "p3 is 0.1, a part of the lens that is not read"),
    "size": (ADJUSTED, ADJUSTED + '<resolution width="-1" height="4"/>', "its width is -1"),
    "size digits": (ADJUSTED, ADJUSTED + f'<resolution width="{"9" * 10_000}"/>', "expected whole pixels"),
    "two labels": ('label="0001.jpg"', 'label="0000.jpg"', "image 0000.jpg has a second pose"),
    "reference": ("<reference>PROJCS", "<reference>PROJ[", "is not a known CRS"),
    "long matrix": ('label="0000.jpg"><transform>', 'label="0000.jpg"><transform>1 ', "expected 16 finite numbers"),
    "not updated": ("<translation ", "<translation>0 0 0</translation><x ", "m from the centre of the Earth"),
    "no transform": ("<components>", "<parts>", "no camera that is enabled, aligned and georeferenced"),
}  # fmt: skip


def spoilt(text: str, old: str, new: str) -> str:
    """With something else in its first place; the end of a tag that gets another name is renamed too."""
    assert old in text
    text = text.replace(old, new, 1)
    if new.endswith("<x "):
        end = f"</{old.strip('<').split(' ')[0]}>"
        at = text.index(end, text.index("<x "))
        text = text[:at] + "</x>" + text[at + len(end) :]
    return text.replace("</components>", "</parts>") if new == "<parts>" else text


@pytest.mark.parametrize(("old", "new", "words"), FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_is_refused_in_one_sentence(tmp_path, block, old, new, words):
    path = tmp_path / "cameras.xml"
    text = spoilt(cameras_xml(block), old, new)
    path.write_text(text)
    with pytest.raises(PosesError, match=words) as error:
        read_poses(path)
    assert ";" in str(error.value)


def test_several_chunks_are_refused(tmp_path, block):
    one = cameras_xml(block)
    chunk = one[one.index("<chunk") : one.index("</document>")]
    (tmp_path / "cameras.xml").write_text(one.replace("</document>", chunk + "</document>"))
    with pytest.raises(PosesError, match="aligned cameras of 2 chunks, expected one"):
        read_poses(tmp_path / "cameras.xml")


def test_markers_of_metashape_are_no_poses(tmp_path):
    (tmp_path / "markers.xml").write_text(METASHAPE)
    assert find_poses(tmp_path) == []


class Geoid:
    """A geoid 48.5 m over the ellipsoid everywhere."""

    @staticmethod
    def transform(lon, lat, height):
        return lon, lat, height - 48.5


@pytest.mark.parametrize("vertical", ["EPSG:25832+5773", "EPSG:25832+4937"])
def test_a_geoid_that_the_program_added_is_taken_away_again(tmp_path, block, monkeypatch, vertical):
    monkeypatch.setattr("survey.folder.local_frame.height_transformer", lambda crs, area: Geoid)
    wkt = CRS(vertical).to_wkt("WKT1_GDAL") if "5773" in vertical else CRS("EPSG:4979").to_wkt()
    # The reference of the cameras is in the chunk's CRS: over the geoid, or longitude, latitude over the ellipsoid.
    places = in_utm(block.centres) - [0.0, 0.0, 48.5] if "5773" in vertical else lon_lat_height(block.centres)
    tags = [f'<reference x="{x!r}" y="{y!r}" z="{z!r}" sxyz="0.1" enabled="1"/>' for x, y, z in places.tolist()]
    survey = loaded(tmp_path, block, cameras_xml(block, wkt=wkt, references=tags), crs="EPSG:25832+5773")
    heights = survey.frame.crs_from_local([view.camera.centre for view in survey.views])[:, 2]
    assert heights == pytest.approx(in_utm(block.centres)[:, 2] - 48.5, abs=1e-3)
    for view in survey.views:
        assert survey.observations.priors[view.name].position == pytest.approx(view.camera.centre, abs=2e-3)


def test_a_chunk_over_another_vertical_datum_is_refused(tmp_path, block):
    text = cameras_xml(block, wkt=CRS("EPSG:25832+5773").to_wkt("WKT1_GDAL"))
    with pytest.raises(GeoError, match=r"the heights of the poses are above EGM96 height, expected above"):
        loaded(tmp_path, block, text)


def test_a_camera_without_a_label_is_left_out_and_named_unless_its_file_is(tmp_path, block):
    text, label = cameras_xml(block), 'label="0001.jpg"'
    assert label in text
    (tmp_path / "cameras.xml").write_text(text.replace(label, 'label=" "', 1))
    file = read_poses(tmp_path / "cameras.xml")
    assert [pose.name for pose in file.poses] == [name for name in block.names if name != "0001.jpg"]
    assert any(re.match(r"1 camera without a label in cameras.xml, left out: id \d+", text) for text in file.warnings)
    with_photo = re.sub(r'label="0001.jpg"([^>]*)>', r'\1><photo path="/flight/0001.jpg"/>', text, count=1)
    (tmp_path / "cameras.xml").write_text(with_photo)
    assert "/flight/0001.jpg" in [pose.name for pose in read_poses(tmp_path / "cameras.xml").poses]
    (tmp_path / "cameras.xml").write_text(re.sub(r'label="\d+.jpg"', "", text))
    with pytest.raises(PosesError, match="no aligned camera has a label, expected the name of its image"):
        read_poses(tmp_path / "cameras.xml")


@pytest.mark.parametrize("num_frames", [1, 3])
def test_the_frames_of_a_series_in_time_are_no_cameras(tmp_path, block, num_frames):
    text = cameras_xml(block)
    photos = "".join(
        f'<frame id="{f}"><cameras>'
        + "".join(f'<camera camera_id="{i}"><photo path="{f}/{name}"/></camera>' for i, name in enumerate(block.names))
        + "</cameras></frame>"
        for f in range(num_frames)
    )
    (tmp_path / "cameras.xml").write_text(text.replace("</chunk>", f"<frames>{photos}</frames></chunk>"))
    (tmp_path / "plain.xml").write_text(text)
    found, plain = read_poses(tmp_path / "cameras.xml"), read_poses(tmp_path / "plain.xml")
    assert [pose.name for pose in found.poses] == [pose.name for pose in plain.poses]
    more = [text for text in found.warnings if text not in [w.replace("plain", "cameras") for w in plain.warnings]]
    assert ["has 3 frames" in text for text in more] == ([] if num_frames == 1 else [True])
