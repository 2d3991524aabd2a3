"""What `check` says of sun, glitter, motion and sharpness, against closed forms and images that were blurred."""

import math
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from small_survey import TOML, camera_lines, rows_of, small_survey, write_image

from refract import PinholeCamera
from survey.photos.exif import read_exif
from survey.photos.texture import detail_of, image_detail, relative_sharpness
from survey.plan.check import require_processable
from survey.plan.light import (
    LEAST_SHARP,
    GlitterOfFlight,
    glitter_text,
    glitters,
    largest_facet_slope,
    light_section,
    motion_text,
    sharpness_text,
    slope_variance,
    times_of,
)

UP = np.array([0.0, 0.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0])


def nadir(width: int = 1200, height: int = 1200, focal: float = 600.0) -> PinholeCamera:
    return PinholeCamera([0.0, 0.0, 30.0], DOWN, focal, focal, 0.5 * width, 0.5 * height, width, height)


def sun(elevation_deg: float, azimuth_deg: float = 0.0) -> np.ndarray:
    level = math.cos(math.radians(elevation_deg))
    azimuth = math.radians(azimuth_deg)
    return np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(math.radians(elevation_deg))])


def test_slopes_are_those_that_cox_and_munk_measured():
    # Their table: 10 m/s have a mean square slope of 0.054.
    assert slope_variance(10.0) == pytest.approx(0.054, abs=5e-4)
    lean = largest_facet_slope(5.0)
    assert math.exp(-(math.tan(lean) ** 2) / slope_variance(5.0)) == pytest.approx(0.1)


def test_glitter_of_a_sun_overhead_is_a_disc_about_the_nadir_twice_as_wide_as_facets_lean():
    found = GlitterOfFlight([nadir()], UP).under(sun(90.0), 2.0)
    assert found.num_mirrored == 1
    # The disc has the radius f tan(2 lean) in the frame; the frame is looked at in squares of 50 pixels.
    radius = 600.0 * math.tan(2.0 * largest_facet_slope(2.0))
    assert found.share[0] == pytest.approx(math.pi * radius**2 / 1200.0**2, rel=0.1)
    assert found.views is None


def test_the_mirror_image_leaves_the_frame_of_a_low_sun():
    flight = GlitterOfFlight([nadir()], UP)
    # The frame reaches 45 degrees off nadir at the middle of its sides: a sun lower than 45 degrees leaves it.
    assert flight.under(sun(46.0), 0.0).num_mirrored == 1
    assert flight.under(sun(44.0), 0.0).num_mirrored == 0
    assert flight.under(sun(-10.0), 8.0).share == (0.0, 0.0)
    highest = math.degrees(flight.highest_sun(3.0))
    assert flight.under(sun(highest - 1.0, 45.0), 3.0).share[1] == 0.0
    assert flight.under(sun(highest + 5.0, 45.0), 3.0).share[1] > 0.0


def test_only_rays_that_go_down_glitter():
    rays = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    assert glitters(rays, sun(90.0), UP, 3.0).tolist() == [True, False]


def test_the_advice_on_glitter_says_how_high_the_sun_may_stand():
    flight = GlitterOfFlight([nadir(800, 600, 1000.0)], UP)
    text = glitter_text(flight.under(sun(85.0), 3.0), flight.highest_sun(3.0), 3.0, is_flown=True)
    assert text.startswith("poor: the sun's mirror image lies in 1 of 1 photographs")
    assert "a sun lower than" in text
    low = glitter_text(flight.under(sun(20.0), 3.0), flight.highest_sun(3.0), 3.0, is_flown=True)
    assert low.startswith("good: ")
    assert "lower than" not in low


def test_motion_is_speed_times_exposure_over_the_pixel():
    assert motion_text(4.0, 0.002, 0.02).startswith("good: blurs by 0.40 px at most")
    poor = motion_text(10.0, 0.004, 0.02)
    assert poor.startswith("poor: blurs by 2.00 px")
    # Half a pixel: 0.01 m in 4 ms, or at 10 m/s in 1 ms.
    assert poor.endswith("fly at 2.5 m/s or slower, or open the shutter for 1 ms or less")
    assert motion_text(None, 0.004, 0.02) == "unknown: the speed is not given"


def textured(seed: int) -> np.ndarray:
    """Grey levels of a bed with detail of all sizes."""
    rng = np.random.default_rng(seed)
    grey = sum(
        sigma * cv2.GaussianBlur(rng.standard_normal((300, 400)), (0, 0), sigma) for sigma in (0.8, 1.6, 3.2, 6.4)
    )
    return np.clip(128.0 + 40.0 * grey / grey.std() + rng.normal(0.0, 1.0, grey.shape), 0.0, 255.0)


@pytest.mark.parametrize("kernel", [np.full((1, 5), 0.2), np.full((5, 1), 0.2), np.eye(5) / 5.0, np.full((5, 5), 0.04)])
def test_an_image_that_moved_or_lost_its_focus_is_less_sharp_than_its_neighbours(kernel):
    images = [textured(seed) for seed in range(6)]
    images[3] = cv2.filter2D(images[3], -1, kernel)
    found = relative_sharpness([detail_of(image) for image in images])
    assert int(np.argmin(found)) == 3
    assert found[3] < LEAST_SHARP
    assert (np.delete(found, 3) > LEAST_SHARP).all()


def test_a_photograph_that_is_mostly_white_is_called_white_and_not_blurred(tmp_path):
    images = {f"{seed}.png": textured(seed) for seed in range(6)}
    images["2.png"][100:] = 255.0
    images["4.png"] = cv2.filter2D(images["4.png"], -1, np.full((5, 5), 0.04))
    paths = {name: tmp_path / name for name in images}
    for name, image in images.items():
        cv2.imwrite(str(paths[name]), image)
    found = SimpleNamespace(images=paths, headers={name: SimpleNamespace(size_px=(400, 300)) for name in paths})
    text = sharpness_text(found)
    assert text.startswith(
        "poor: 1 of 6 photographs is more than half white by glint of the sun or exposure: 2.png (67"
    )
    blurred = text.partition("usual detail in some direction: ")[2].partition(";")[0]
    assert blurred.startswith("4.png")
    assert "2.png" not in blurred
    del found.images["4.png"]
    assert "none of 5 photographs is blurred" in sharpness_text(found)
    assert "take those that are blurred" not in sharpness_text(found)


def test_times_without_a_zone_are_those_of_the_longitude(tmp_path):
    clock = {"DateTimeOriginal": "2026:06:21 12:00:00"}
    write_image(tmp_path / "a.jpg", **clock, OffsetTimeOriginal="+02:00")
    write_image(tmp_path / "b.jpg", **clock, ExposureTime=0.002)
    told, bare = (read_exif(tmp_path / name) for name in ("a.jpg", "b.jpg"))
    assert times_of({"a": told}, 10.0) == ([datetime(2026, 6, 21, 10, tzinfo=UTC)], "")
    times, assumed = times_of({"b": bare}, -92.0)
    assert times == [datetime(2026, 6, 21, 18, tzinfo=UTC)]
    assert "UTC-6 by the longitude" in assumed
    assert times_of({"a": told, "c": replace(bare, clock=None)}, 10.0) == (None, "")
    # One of two tells its zone, which the longitude does not.
    times, assumed = times_of({"a": told, "b": bare}, -92.0)
    assert times == [datetime(2026, 6, 21, 10, tzinfo=UTC)] * 2
    assert "that of the others" in assumed


@pytest.mark.parametrize("posed", [True, False])
def test_the_heads_of_photographs_tell_sun_glitter_and_motion(tmp_path, posed):
    folder = small_survey(tmp_path / "s", num=6, gps=True)
    for number, line in enumerate(camera_lines(6)):
        name, e, n, h, *_ = line.split(",")
        write_image(
            folder / "images" / name,
            gps=(float(e), float(n) + 4.0 * (number == 0 and not posed), float(h)),
            DateTimeOriginal=f"2026:06:21 13:00:{number:02d}",
            OffsetTimeOriginal="+02:00",
            ExposureTime=0.01,
        )
    if not posed:
        (folder / "cameras.csv").unlink()
        (folder / "survey.toml").write_text(TOML.replace('poses = "cameras.csv"', ""))
    rows = rows_of([light_section(require_processable(folder), wind_m_s=3.0)], "Light and sharpness")
    # 46.9 north, 10.2 east, at the solstice 19 minutes before noon.
    assert rows["sun"].startswith("66 degrees high in the south (azimuth 1")
    assert "2026-06-21 11:00 to 11:00 UTC" in rows["sun"]
    assert "in 0 of 6 photographs" in rows["glitter"]
    # 3.6 m in a second, 10 ms, 20 cm.
    assert rows["motion"].startswith("good: blurs by 0.18 px at most (3.6 m/s, open for 10 ms")
    assert rows["sharpness"].startswith("good: ")


def test_a_survey_without_times_says_so(tmp_path):
    rows = rows_of([light_section(require_processable(small_survey(tmp_path / "s")))], "Light and sharpness")
    assert rows["sun"] == "unknown: EXIF has no times"
    assert "glitter" not in rows


@pytest.mark.parametrize("colour", [0.0, 3.0, 128.0, 255.0])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("num", [6, 30])
def test_a_photograph_that_is_black_or_of_one_colour_is_named(tmp_path, colour, suffix, num):
    """With the noise of a sensor, and of many photographs, of which a sample is decoded."""
    rng, lively = np.random.default_rng(1), (textured(0), textured(1))
    paths = {f"{i:02d}.{suffix}": tmp_path / f"{i:02d}.{suffix}" for i in range(num)}
    for i, path in enumerate(paths.values()):
        plain = np.clip(colour + rng.normal(0.0, 1.0, (300, 400)), 0, 255)
        cv2.imwrite(str(path), plain if i == 4 else lively[i % 2])
    # So large that a sample has a few of them.
    found = SimpleNamespace(images=paths, headers={name: SimpleNamespace(size_px=(4000, 3000)) for name in paths})
    assert f"black or of one colour all over, and show nothing: 04.{suffix}" in sharpness_text(found)


def test_sixteen_bits_have_the_detail_of_eight(tmp_path, rng):
    pixels = cv2.GaussianBlur(rng.integers(0, 240, (256, 256, 3), dtype=np.uint8), (0, 0), 1.0)
    pixels[:16] = 255
    cv2.imwrite(str(tmp_path / "8.png"), pixels)
    cv2.imwrite(str(tmp_path / "16.png"), pixels.astype(np.uint16) * 257)
    eight, sixteen = (image_detail(tmp_path / name) for name in ("8.png", "16.png"))
    assert not sixteen.is_plain
    assert 16 / 256 <= sixteen.white == eight.white < 0.1
    # Grey of 8 bits is rounded.
    np.testing.assert_allclose(sixteen.detail, eight.detail, rtol=0.02)


@pytest.mark.parametrize("times", [8, 16])
def test_twelve_bits_in_files_of_sixteen_are_not_called_black(tmp_path, times):
    paths = {name: tmp_path / name for name in ("a.png", "b.png")}
    for seed, path in enumerate(paths.values()):
        cv2.imwrite(str(path), textured(seed).astype(np.uint16) * times)
    found = SimpleNamespace(images=paths, headers={name: SimpleNamespace(size_px=(400, 300)) for name in paths})
    said = sharpness_text(found)
    assert said.startswith("poor: photographs of 16 bits hold numbers of 12 bits")
    assert "multiply their pixels by 16" in said
