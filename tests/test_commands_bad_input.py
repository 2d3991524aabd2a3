"""Input that is wrong: exit code 2 and one sentence that names it and the remedy."""

import re
from pathlib import Path

import pytest
from command_line import bathynerf
from small_survey import LEVEL, camera_lines, replaced, small_survey, write_image, write_poses


def spoil_toml(*pairs):
    return lambda folder: (folder / "survey.toml").write_text(replaced(*pairs))


def spoil_poses(old: str, new: str):
    lines = [line.replace(old, new) for line in camera_lines()]
    assert lines != camera_lines()
    return lambda folder: write_poses(folder, lines)


def remove_toml(folder: Path):
    (folder / "survey.toml").unlink()


def remove_images(folder: Path):
    for image in (folder / "images").iterdir():
        image.unlink()


def cut_image(folder: Path):
    path = folder / "images" / "0003.jpg"
    path.write_bytes(path.read_bytes()[:1200])


BAD_INPUT = {
    "no survey.toml": (remove_toml, ["neither the photographs nor their poses tell", '--crs "EPSG']),
    "unknown key": (spoil_toml(("level_m", "levl_m")), ["survey.toml", "unknown key levl_m", "[water] level_m"]),
    "no images": (remove_images, ["no images in", "images"]),
    "truncated JPEG": (cut_image, ["0003.jpg", "damaged or cut off", "copy it again"]),
    "wrong image size": (
        lambda folder: write_image(folder / "images" / "0002.jpg", size=(60, 48)),
        ["0002.jpg has 60 x 48 pixels, expected 64 x 48", "use the images that the poses were made from"],
    ),
    "NaN pose": (spoil_poses(",0,0,20", ",0,0,nan"), ["cameras.csv, line 4: kappa is nan", "correct it"]),
    "camera under the water": (
        spoil_poses("589018.000,5194732.000,2125", "589018.000,5194732.000,2104"),
        ["0002.jpg at 2104.00 m lies 1.00 m under the water", "correct its pose"],
    ),
    "level too high": (spoil_toml((str(LEVEL), "2605")), ["level_m is 2605 m", "2125.0", "same vertical datum"]),
    "two levels": (spoil_toml(("level_at", "gauge = 'g.csv'\nlevel_at")), ["level_m and gauge", "keep one"]),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_ends_with_code_2_and_one_sentence_that_names_it_and_the_mend(tmp_path, case):
    spoil, words = BAD_INPUT[case]
    folder = small_survey(tmp_path / "s")
    spoil(folder)
    result = bathynerf("check", folder)
    assert result.exit_code == 2
    assert result.stdout == ""
    first, line = result.stderr.splitlines()
    assert first.endswith(f"reading {folder}")
    assert line.startswith("error: ")
    assert "Traceback" not in line
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "nowhere"),
        ("process", "nowhere"),
        ("export", "nowhere", "--las", "a.las"),
        ("compare", "no.las", "no.ply"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_path_that_does_not_exist_ends_with_code_2_and_is_named(tmp_path, arguments):
    command, *paths = arguments
    result = bathynerf(command, *[p if p.startswith("--") else tmp_path / p for p in paths])
    assert result.exit_code == 2
    assert re.search(r"error: .*(nowhere|no\.las|no\.ply)", result.stderr)
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "s", "--quality", "high"), "invalid value for '--quality': 'high' is not one of 'draft'"),
        (("check",), "missing argument 'SURVEY|PLAN'"),
        (("check", "s", "--colour"), "no such option: --colour"),
        (("chek",), "no such command 'chek'"),
    ],
)
def test_an_error_of_usage_is_one_sentence_like_every_other(arguments, words):
    result = bathynerf(*arguments)
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"error: {words}")
