"""Windows in photographs with masked pixels and with lens distortion, and the water that they tell."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from drawn_runs import SMALL, drawn
from PIL import Image
from scipy.ndimage import gaussian_filter

from refract.lens import Lens
from survey.adjust import refine
from survey.adjust.block.windows import RADIUS, match, measure_windows, prepare_image, window
from survey.adjust.waterline import WaterEstimate, calibrate_water
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import TiePoints
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.writing import write_survey
from tests.changed_survey import changed

SCENE = DrawnScene(**SMALL)
PINCUSHION = (0.15, 0.02, 1e-3, -1e-3)


def draw_distorted(folder: Path, distortion: tuple[float, ...]) -> None:
    """Draw the scene through a lens with distortion."""
    (width, height), focal = SCENE.image_px, SCENE.focal_px
    lens = Lens("OPENCV", (focal, focal, width / 2, height / 2, *distortion), width, height)
    settings = {**asdict(SCENE), "distortion": distortion}
    write_survey(folder, settings, lambda: replace(stage_drawing(SCENE), lens=lens))


def loaded(folder: Path) -> Survey:
    """The survey of a folder, with known heights and without bounds."""
    survey = load_survey(folder)
    area = replace(survey.config.area, heights=(SCENE.level_m - 2.0, SCENE.level_m + 0.3))
    return changed(survey, bounds=None, config=replace(survey.config, area=area))


def measured(survey: Survey):
    return measure_windows(survey, device="cpu", advance=lambda share: None)


def water_of(survey: Survey, ties) -> WaterEstimate:
    """The water that measured windows tell."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refine, "measure_windows", lambda *_arguments, **_options: ties)
        return calibrate_water(survey)


@pytest.fixture(scope="module")
def pinhole(tmp_path_factory):
    """A survey without distortion and masks, and its estimate."""
    survey = loaded(drawn(tmp_path_factory.mktemp("pinhole") / "survey").folder)
    return survey, water_of(survey, measured(survey))


@pytest.fixture(scope="module")
def pincushion(tmp_path_factory) -> Survey:
    """The same through a lens with distortion."""
    folder = tmp_path_factory.mktemp("pincushion") / "survey"
    draw_distorted(folder, PINCUSHION)
    return loaded(folder)


def require_as_good(found, survey: Survey, pinhole) -> None:
    """The same verdicts as of the pinhole survey, the truth as near as said, and hardly less certain."""
    truth = survey.config.water
    for mine, theirs in zip(found.estimates, pinhole[1].estimates, strict=True):
        assert mine.is_observable == theirs.is_observable
        # Both surveys show the same bed from the same places, and what small blocks err by is common to them.
        assert abs(mine.value - theirs.value) < 3.0 * np.hypot(mine.std, theirs.std)
    level, theirs = found.estimates[0], pinhole[1].estimates[0]
    assert level.is_observable
    assert abs(level.value - truth.level_m) < 3.0 * level.std
    assert level.std < 1.5 * theirs.std


@pytest.mark.slow
def test_a_lens_with_distortion_ends_in_verdicts_as_good_as_those_of_a_pinhole(pincushion, pinhole):
    survey = pincushion
    ties = measured(survey)
    require_as_good(water_of(survey, ties), survey, pinhole)
    # They are measured in the photograph as it was taken, where the lens bends by up to 1.7 px.
    cameras = [view.camera for view in survey.views]
    straight = [replace(camera, distortion=None) for camera in cameras]
    off, beside = (np.abs(misses(c, ties, survey.water)) for c in (cameras, straight))
    assert np.quantile(off, 0.95) < 0.3
    assert np.quantile(beside, 0.95) > 0.6


def misses(cameras, ties: TiePoints, water) -> np.ndarray:
    """Measured minus predicted pixels (N, 2) of tie points at their approximate places."""
    found = [cameras[v].project(ties.start[p], water) for p, v in zip(ties.point, ties.view, strict=True)]
    return ties.pixel - np.array(found)


@pytest.mark.slow
def test_masked_photographs_end_in_verdicts_as_good_and_no_window_touches_a_mask(tmp_path, pinhole):
    masks = tmp_path / "masks"
    masks.mkdir()
    for i, view in enumerate(pinhole[0].views):
        mask = np.full((150, 200), 255, dtype=np.uint8)
        mask[:, 20 * i : 20 * i + 12] = 0
        Image.fromarray(mask).save(masks / f"{Path(view.name).stem}.png")
    views = tuple(replace(view, mask_path=masks / f"{Path(view.name).stem}.png") for view in pinhole[0].views)
    survey = replace(pinhole[0], views=views)
    ties = measured(survey)
    require_as_good(water_of(survey, ties), survey, pinhole)
    for i in range(len(survey.views)):
        across = ties.pixel[ties.view == i, 0]
        # Windows of 13 pixels a side, warped and shrunk to 10 at least by the views of this survey.
        assert not ((across > 20 * i - 5) & (across < 20 * i + 12 + 5)).any()


def test_windows_beside_a_mask_are_found_where_they_are_without_it_and_refused_where_they_touch_it(rng):
    image = (40.0 * gaussian_filter(rng.normal(size=(150, 200)), 1.5) / 0.19).astype(np.float32)
    masked = image.copy()
    masked[60:80, 90:120] = np.nan
    x, y = window()
    middles = np.stack(np.meshgrid(np.arange(20, 180, 4), np.arange(20, 130, 4)), axis=-1).reshape(-1, 2)
    at = (middles[:, 1, None] + y, middles[:, 0, None] + x)
    dy, dx = np.gradient(image)
    slopes = np.stack([dx[at], dy[at]], axis=-1).astype(float)
    offsets = np.broadcast_to(np.stack([x, y]).astype(float), (len(middles), 2, len(x)))
    expected = middles + 0.5 + [0.7, -0.4]
    whole, was = match(prepare_image(image), image[at].astype(float), slopes, expected, offsets)
    found, is_found = match(prepare_image(masked), image[at].astype(float), slopes, expected, offsets)
    gap = np.maximum(
        np.maximum(90 - middles[:, 0], middles[:, 0] - 119), np.maximum(60 - middles[:, 1], middles[:, 1] - 79)
    )
    assert was.all()
    assert not is_found[gap <= RADIUS].any()
    assert is_found[gap > RADIUS + 6].all()
    np.testing.assert_allclose(found[is_found], middles[is_found] + 0.5, atol=0.01)
    np.testing.assert_allclose(found[is_found], whole[is_found], atol=0.002)


@pytest.mark.slow
def test_a_photograph_without_a_window_is_no_hindrance(pincushion, monkeypatch):
    ties = TiePoints(np.zeros((1, 3)), np.zeros(3, dtype=int), np.arange(3), np.full((3, 2), 90.0))
    monkeypatch.setattr("survey.adjust.block.windows.measure_tie_points", lambda *_arguments: ties)
    assert np.isfinite(measured(pincushion).pixel).all()


def test_a_photograph_that_is_masked_whole_has_no_place_for_a_window():
    assert not prepare_image(np.full((20, 30), np.nan, dtype=np.float32)).clear.any()
