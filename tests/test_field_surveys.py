"""Random surveys as they come from the field: what their folders state agrees with their truth."""

import dataclasses
import tomllib

import field_scenes
import field_settings
import field_surveys
import numpy as np
import pytest
from PIL import Image

from refract.lens import distorted
from survey.settings.config import read_config


def small(**changes):
    """The settings of a survey with a bank in a few small photographs."""
    sizes = {
        "size_m": (3.0, 3.0), "size_px": (160, 120), "stated_focal_px": 200.0, "focal_px": 201.0,
        "principal_px": (81.0, 59.5), "height_m": 6.0, "depth_m": 0.8, "dry_share": 0.45, "bare_share": 0.1,
        "num_nadir": 4, "num_oblique": 2, "wave_m": 0.01,
    }  # fmt: skip
    return dataclasses.replace(field_settings.draw_settings(1), **(sizes | changes))


def test_the_settings_can_be_read_and_marks_lie_where_the_true_cameras_see_their_points(tmp_path):
    settings = small()
    field_surveys.draw_field_survey(tmp_path / "01", settings)
    scene = field_scenes.stage(settings)
    assert len(list((tmp_path / "01" / "images").iterdir())) == 6
    assert read_config(tmp_path / "01" / "survey_plain.toml").water.level_m == settings.stated_level_m
    head, *lines = (tmp_path / "01" / "gcp_list.txt").read_text(encoding="utf-8").splitlines()
    assert head == settings.crs.split("+")[0]
    off = []
    for line in lines:
        e, n, h, u, v, image, _ = line.split()
        point = scene.frame.local_from_crs(np.array([[float(e), float(n), float(h)]]))
        seen = distorted(scene.lens, scene.cameras[int(image[:4])].project(point, scene.still.water))[0]
        # OpenDroneMap counts from the centre of the first pixel.
        off.append(seen - (float(u) + 0.5, float(v) + 0.5))
    # A centimetre across, at 6 m and 201 px, is a third of a pixel; the marks have 0.4 px.
    assert len(off) >= 5
    assert np.abs(off).max() < 4.0 * np.hypot(0.4, 0.35)


def test_rods_stand_on_the_wet_bed(tmp_path):
    settings = small()
    scene = field_scenes.stage(settings)
    table = field_surveys._rods(scene, np.random.default_rng(1)).split()[1:]
    rods = scene.frame.local_from_crs(np.array([[float(v) for v in line.split(",")[1:]] for line in table]))
    assert len(rods) == field_surveys.NUM_RODS
    assert (rods[:, 2] < -0.05).all()
    assert np.abs(rods[:, 2] - scene.still.ground.bed.height(*rods.T[:2])).max() < 0.06


def test_waves_move_between_photographs():
    settings = small(noise=0.0, exposure_std=0.0, dry_share=0.0)
    scene = field_scenes.stage(settings)
    later = dataclasses.replace(scene, times=scene.times + 0.4)
    assert np.abs(scene.photograph(0).astype(int) - later.photograph(0)).mean() > 0.5
    still = dataclasses.replace(settings, wave_m=0.0)
    calm = field_scenes.stage(still)
    calm_later = dataclasses.replace(calm, times=calm.times + 0.4)
    np.testing.assert_array_equal(calm.photograph(0), calm_later.photograph(0))


def test_what_the_surveyor_states_is_off_by_no_more_than_its_errors():
    drawn = [field_settings.draw_settings(seed) for seed in range(200)]
    levels = [(s.stated_level_m - s.level_m) / s.level_std_m for s in drawn]
    focal = [abs(s.focal_px / s.stated_focal_px - 1.0) for s in drawn]
    assert np.std(levels) == pytest.approx(1.0, abs=0.2)
    assert 0.0009 < min(focal) < max(focal) < 0.0101
    assert all(abs(s.stated_index - s.index) < 0.005 for s in drawn)


def test_the_truth_names_the_true_lens_and_water(tmp_path):
    settings = small(dry_share=0.0)
    field_surveys.draw_field_survey(tmp_path / "01", settings)
    true = tomllib.loads((tmp_path / "01" / "truth" / "truth.toml").read_text(encoding="utf-8"))
    assert true["focal_px"] == settings.focal_px
    assert true["level_m"] == settings.level_m
    assert not (tmp_path / "01" / "gcp_list.txt").exists()
    with Image.open(tmp_path / "01" / "images" / "0000.jpg") as image:
        assert image.size == settings.size_px
