"""Photographs of a survey folder as users have them: masks beside them, several cameras, pages, rotated ones, HEIC."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
from PIL import Image, ImageFile
from small_survey import SIZE, camera_lines, replaced, rows_of, small_survey, unposed, write_image, write_poses

from survey.errors import ConfigError, ImageError
from survey.folder.headers import burst_notes, header_warnings
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.photos.images import list_images, load_mask
from survey.plan.check import check_survey, require_processable
from survey.plan.choices import Choices
from survey.settings.config import SurveyConfig, parse_config

NO_LENS = replaced(
    ('model = "PINHOLE"', ""),
    ("size_px = [64, 48]", ""),
    ("focal_px = 100.0", ""),
    ("principal_point_px = [32.0, 24.0]", ""),
)


def write_mask(path, *, black: int) -> None:
    """A white mask whose first columns are black."""
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :black] = 0
    Image.fromarray(mask).save(path)


def test_masks_beside_photographs_are_no_photographs_and_are_used(tmp_path):
    folder = small_survey(tmp_path / "s")
    for i in range(4):
        write_mask(folder / "images" / f"{i:04d}_mask.png", black=20)
    (folder / "images" / "0003_mask.png").rename(folder / "images" / "0003_MASK.PNG")
    assert list(list_images(folder / "images")) == [f"{i:04d}.jpg" for i in range(4)]
    survey = load_survey(folder)
    assert [view.mask_path.name for view in survey.views] == [f"000{i}_mask.png" for i in range(3)] + ["0003_MASK.PNG"]
    assert load_mask(survey.views[0]).sum() == 48 * 44
    assert "the masks are those beside the images, of 4 images; black is left out" in survey.findings.assumptions


def test_an_image_whose_name_ends_like_a_mask_is_one_where_there_is_no_other(tmp_path):
    write_image(tmp_path / "reef_mask.jpg")
    write_image(tmp_path / "reef.jpg")
    write_image(tmp_path / "sea_mask.jpg")
    assert list(list_images(tmp_path)) == ["reef.jpg", "sea_mask.jpg"]


@pytest.mark.parametrize("name", ["{}.jpg", "{}.png", "{}.jpg.png", "{}_mask.png", "{}_mask.jpg", "{}.PNG"])
def test_masks_in_a_folder_have_one_of_several_names(tmp_path, name):
    folder = small_survey(tmp_path / "s", toml=replaced(("[cameras]", '[images]\nmasks = "masks"\n[cameras]')))
    (folder / "masks").mkdir()
    for i in range(3):
        write_mask(folder / "masks" / name.format(f"{i:04d}"), black=20)
    survey = load_survey(folder)
    assert [view.mask_path is not None for view in survey.views] == [True, True, True, False]
    assert any("1 image without a mask, used whole" in text for text in survey.findings.warnings)


@pytest.mark.parametrize(
    ("masks", "expected"),
    [
        (["a.png"], [None, "a.png"]),
        (["a.jpg"], ["a.jpg", None]),
        (["a.jpg.png"], ["a.jpg.png", None]),
        (["a.png.png"], [None, "a.png.png"]),
        (["a.jpg_mask.png", "a.png_mask.png"], ["a.jpg_mask.png", "a.png_mask.png"]),
        (["a.jpg", "a.png"], ["a.jpg", "a.png"]),
        (["a.tif"], "a.tif: a fits a.jpg and a.png, expected the name of one photograph"),
        (["a_mask.png"], "a_mask.png: a fits a.jpg and a.png, expected the name of one photograph"),
        (["a.jpg.png", "a.jpg.tif"], "are both masks of a.jpg; remove one of them"),
    ],
)
@pytest.mark.parametrize("is_beside", [False, True])
def test_photographs_that_differ_in_their_suffix_share_no_mask(tmp_path, masks, expected, is_beside):
    if is_beside:
        masks = [name for name in masks if "_mask" in name]
        expected = expected if masks else [None, None]
    pair = ("[cameras]", '[images]\nmasks = "masks"\n[cameras]')
    folder = small_survey(tmp_path / "s", toml=replaced(*(() if is_beside else (pair,))))
    lines = camera_lines()
    for i, name in enumerate(("a.jpg", "a.png")):
        Image.open(folder / "images" / f"{i:04d}.jpg").save(folder / "images" / name)
        (folder / "images" / f"{i:04d}.jpg").unlink()
        lines[i] = lines[i].replace(f"{i:04d}.jpg", name)
    write_poses(folder, lines)
    place = folder / ("images" if is_beside else "masks")
    place.mkdir(exist_ok=True)
    for name in [*masks, "0002_mask.png"]:
        write_mask(place / name, black=20)
    if isinstance(expected, str):
        with pytest.raises(ImageError, match=expected):
            load_survey(folder)
        return
    found = {view.name: view.mask_path and view.mask_path.name for view in load_survey(folder).views}
    assert [found["a.jpg"], found["a.png"]] == expected


def test_masks_of_flights_are_told_apart_by_their_folders(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(("[cameras]", '[images]\nmasks = "masks"\n[cameras]')))
    lines = camera_lines()
    for i in range(4):
        name = f"f{i % 2}/{i // 2}.jpg"
        (folder / "images" / name).parent.mkdir(exist_ok=True)
        (folder / "images" / f"{i:04d}.jpg").rename(folder / "images" / name)
        lines[i] = lines[i].replace(f"{i:04d}.jpg", name)
    write_poses(folder, lines)
    (folder / "masks" / "f1").mkdir(parents=True)
    write_mask(folder / "masks" / "f1" / "0.png", black=20)
    masks = {view.name: view.mask_path for view in load_survey(folder).views}
    assert [name for name, path in masks.items() if path is not None] == ["f1/0.jpg"]
    write_mask(folder / "masks" / "1.png", black=20)
    with pytest.raises(ImageError, match=r"1\.png: 1 fits f0/1\.jpg and f1/1\.jpg"):
        load_survey(folder)


def test_a_mask_of_another_size_is_refused_before_anything_is_computed(tmp_path):
    folder = small_survey(tmp_path / "s")
    Image.new("L", (32, 24)).save(folder / "images" / "0002_mask.png")
    with pytest.raises(ImageError, match=r"0002_mask\.png has 32 x 24 pixels, expected 64 x 48"):
        load_survey(folder)


def test_masks_that_leave_out_nearly_all_are_doubtful(tmp_path):
    folder = small_survey(tmp_path / "s")
    for i in range(4):
        write_mask(folder / "images" / f"{i:04d}_mask.png", black=60)
    (warning,) = load_survey(folder).findings.warnings
    assert "masks leave out 94% of their photographs" in warning
    assert "invert them" in warning


def test_two_cameras_have_a_lens_each(tmp_path):
    folder = small_survey(tmp_path / "s", toml=NO_LENS)
    for i, (size, film, model) in enumerate(
        [(SIZE, 24, "A"), (SIZE, 24, "A"), ((96, 64), 35, "B"), ((96, 64), 35, "B")]
    ):
        write_image(folder / "images" / f"{i:04d}.jpg", size=size, FocalLengthIn35mmFilm=film, Model=model)
    survey = load_survey(folder)
    lenses = [view.lens for view in survey.views]
    assert [(lens.width, round(lens.focal[0], 6)) for lens in lenses] == [
        (64, round(24 / 36 * 64, 6)),
        (64, round(24 / 36 * 64, 6)),
        (96, round(35 / 36 * 96, 6)),
        (96, round(35 / 36 * 96, 6)),
    ]
    assert any(text.startswith("B, 2 images: the focal length is 93.3 px") for text in survey.findings.assumptions)


def test_two_cameras_cannot_share_one_focal_length_of_the_settings(tmp_path):
    folder = small_survey(
        tmp_path / "s", toml=replaced(("size_px = [64, 48]", ""), ("principal_point_px = [32.0, 24.0]", ""))
    )
    write_image(folder / "images" / "0003.jpg", size=(96, 64))
    with pytest.raises(ConfigError, match="images have different sizes"):
        load_survey(folder)


def test_pages_and_rotation_are_said(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(('poses = "cameras.csv"', 'poses = "cameras.csv"')))
    write_image(folder / "images" / "0000.jpg", Orientation=3)
    first = Image.new("RGB", SIZE)
    first.save(folder / "images" / "0001.tif", save_all=True, append_images=[first])
    (folder / "images" / "0001.jpg").unlink()
    warnings = load_survey(folder).findings.warnings
    assert any("EXIF marks 1 of 4 images as rotated; pixels and poses are taken as stored" in text for text in warnings)
    assert any("1 of 4 images have several pages, of which the first is used" in text for text in warnings)


def test_heic_without_poses_is_refused_with_what_to_do(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    folder = unposed(tmp_path / "s")
    heif.register_heif_opener()
    path = folder / "images" / "0000.jpg"
    with Image.open(path) as image:
        image.save(path.with_suffix(".heic"), exif=image.getexif())
    path.unlink()
    with pytest.raises(
        ImageError, match="is HEIC, which structure from motion does not read; convert the images to JPEG"
    ):
        require_processable(folder)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_check_decodes_no_photograph(tmp_path, monkeypatch, suffix):
    """But for the grey levels of a JPEG at an eighth of its size, for libjpeg's warnings."""
    folder = small_survey(tmp_path / "s")
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as image:
            image.save(path.with_suffix(f".{suffix}"))
        if suffix != "jpg":
            path.unlink()
    cameras = folder / "cameras.csv"
    cameras.write_text(cameras.read_text().replace(".jpg", f".{suffix}"))
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda image: pytest.fail("decoded"))
    sections = check_survey(folder, chosen=Choices(device="cpu"))
    assert rows_of(sections, "Found")["images"].startswith("4 with a pose, of 4")


START = datetime(2026, 6, 1, 10, 30)
WATER = "[water]\nlevel_m = 2.0\n"


@pytest.fixture
def header(tmp_path):
    write_image(tmp_path / "a.jpg")
    return read_exif(tmp_path / "a.jpg")


def shots(header, endings, *, num=6, clocks=True, lag_s=0.2):
    found = {}
    for number in range(num):
        for order, (ending, size) in enumerate(endings.items()):
            clock = START + timedelta(seconds=3.0 * number + lag_s * order) if clocks else None
            found[f"DJI_20260601_{number:04d}{ending}.JPG"] = replace(header, size_px=size, clock=clock)
    return found


def at_place(header, second, degree):
    """A photograph of a time [s], so far north [degree]."""
    return replace(header, clock=START + timedelta(seconds=second), lat_lon_height=(48.0 + degree, 11.0, 30.0))


def test_photographs_of_one_place_in_ten_seconds_are_a_burst(header):
    # Four each over three places 5 m apart, three seconds between them, by names in another order.
    hovers = {
        f"{7 * k % 12}.jpg": at_place(header, 30.0 * (k // 4) + 3.0 * (k % 4), 4.5e-5 * (k // 4)) for k in range(12)
    }
    (note,) = burst_notes(hovers)
    assert note.startswith("3 bursts of up to 4 images, each of one place")
    # A flight on which no two are of one place, and the same place again, later.
    line = {f"{k}.jpg": at_place(header, 3.0 * k, 4.5e-5 * k) for k in range(6)}
    assert burst_notes(line | {"again.jpg": at_place(header, 300.0, 0.0)}) == ()
    assert burst_notes({name: replace(each, clock=None) for name, each in hovers.items()}) == ()
    # Nor are five cameras of a rig, two photographs between fixes, places apart without heights, one position for all.
    rig = {
        f"{k}{camera}.jpg": at_place(header, 3.0 * k + 0.4 * (camera > "c"), 4.5e-5 * k + 1e-6 * (camera > "c"))
        for k in range(6)
        for camera in "abcde"
    }
    fixes = {f"{k}.jpg": at_place(header, k, 4.5e-5 * (k // 2)) for k in range(6)}
    flat = {name: replace(each, lat_lon_height=(*each.lat_lon_height[:2], np.nan)) for name, each in line.items()}
    void = {name: at_place(header, 3.0 * k, 0.0) for k, name in enumerate(line)}
    assert [burst_notes(each) for each in (rig, fixes, flat, void)] == [()] * 4


@pytest.mark.parametrize("clocks", [True, False])
@pytest.mark.parametrize(
    ("endings", "words"),
    [
        ({"_V": (4000, 3000), "_T": (640, 512)}, ["6 of 4000 x 3000 px (*_V)", "6 of 640 x 512 px (*_T)"]),
        ({"_W": (8000, 6000), "_T": (1280, 1024)}, ["(*_W)", "(*_T)"]),
        ({"_D": (5280, 3956), "_MS_G": (2592, 1944), "_MS_R": (2592, 1944)}, ["(*_D)", "12 of 2592 x 1944 px"]),
        ({"": (4000, 3000), "_IR": (640, 512)}, ["(*_IR)"]),
    ],
)
def test_shots_of_several_cameras_are_named_with_their_endings(header, endings, words, clocks):
    (said,) = header_warnings(SurveyConfig(), shots(header, endings, clocks=clocks, lag_s=0.0))
    assert said.startswith("each shot has photographs of several cameras: ")
    for part in words:
        assert part in said


@pytest.mark.parametrize(
    "endings", [{"": (4000, 3000)}, {"_left": (4000, 3000), "_right": (4000, 3000)}]
)  # fmt: skip
def test_one_camera_and_rigs_of_equal_ones_are_not(header, endings):
    assert header_warnings(SurveyConfig(), shots(header, endings)) == []


def test_two_cameras_of_two_flights_are_not(header):
    first, second = shots(header, {"_A": (4000, 3000)}), shots(header, {"_B": (5000, 4000)})
    later = {name: replace(one, clock=one.clock + timedelta(hours=1)) for name, one in second.items()}
    assert header_warnings(SurveyConfig(), first | later) == []


@pytest.mark.parametrize(
    ("hours", "toml", "num_days"),
    [
        (24.0, WATER, 2),
        (9.0, WATER, 2),
        (24.0 * 40, WATER, 2),
        (24.0, '[water]\ngnss_points = "a.csv"\n', 2),
        (1.0, WATER, 0),
        (24.0, "dry = true", 0),
        (24.0, '[water]\ngauge = "a.csv"\n', 0),
        (24.0, '[water]\nimage_levels = "a.csv"\n', 0),
        (24.0, WATER + "level_rate_m_per_h = 0.3\nlevel_time = '2026-06-01T10:30:00Z'", 0),
    ],
)
def test_days_under_one_level_are_said(header, hours, toml, num_days):
    first = shots(header, {"": (4000, 3000)})
    second = {
        f"b/{name}": replace(one, clock=one.clock + timedelta(hours=hours)) for name, one in list(first.items())[:4]
    }
    said = header_warnings(parse_config(toml), first | second)
    assert len(said) == (num_days > 0)
    if said:
        day = (START + timedelta(hours=hours)).strftime("%Y-%m-%d")
        assert f"photographs of 2 days (2026-06-01: 6, {day}: 4) have one level" in said[0]
