"""How wide windows are: as before on quiet images, wider where each photograph has light or noise of its own."""

from __future__ import annotations

import cv2
import numpy as np
import plane_survey
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep.images import image_backend
from fields.sweep.kernels.backend import run_job
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.matching import RADII, Reference, match_view, match_with_adaptive_windows, radius_for

BED, OTHERS, STEP, NUM_HYPOTHESES = PlaneBed(TILTED, -2.0), [1, 2, 3, 4, 5, 6], 0.04, 41


@pytest.fixture(autouse=True)
def fine_texture(monkeypatch):
    """Waves of 3 to 10 px: windows hold as many independent values as pixels, nearly."""
    monkeypatch.setattr(plane_survey, "SHORTEST", 0.04)
    monkeypatch.setattr(plane_survey, "LONGEST", 0.15)


def matched(device, images, match):
    """What matching with windows of 5 px finds, the last radius [px], and the errors of its heights [m]."""
    cameras = ring(6)
    truth = BED.true_height(cameras[0]).astype(np.float32)
    start = np.full_like(truth, truth.mean() - 0.5 * STEP * (NUM_HYPOTHESES - 1))
    stack = BED.block(device, cameras, images).stack(1.0)
    backend = image_backend(device)
    hypotheses = Hypotheses(backend.to_device(device, start), STEP, NUM_HYPOTHESES)
    found = run_job(device, match(Reference(stack, 0, OTHERS, 2), hypotheses))
    images, radius = found if match is match_with_adaptive_windows else (found, 2)
    images = [backend.to_host(each) for each in images]
    return images, radius, np.abs(images[0] - truth)[8:-8, 8:-8]


def lit(rng, contrast: float) -> list[np.ndarray]:
    """The photographs, the light on each of which has a pattern of its own."""
    found = []
    for camera in ring(6):
        pattern = cv2.GaussianBlur(rng.normal(size=(camera.height, camera.width)), (0, 0), 0.7)
        found.append((128.0 + BED.photograph(camera)) * np.exp(contrast * pattern / pattern.std()) - 128.0)
    return [image.astype(np.float32) for image in found]


def test_quiet_images_keep_their_windows(device):
    found, radius, _ = matched(device, None, match_with_adaptive_windows)
    assert radius == 2
    for each, narrow in zip(found, matched(device, None, match_view)[0], strict=True):
        np.testing.assert_array_equal(each, narrow)


def test_light_that_differs_in_each_photograph_gets_wider_windows_and_these_find_the_bed(device, rng):
    images = lit(rng, 0.4)
    _, radius, wide = matched(device, images, match_with_adaptive_windows)
    _, _, narrow = matched(device, images, match_view)
    assert radius >= 4
    assert (wide < STEP).mean() > (narrow < STEP).mean() + 0.2


def test_windows_between_many_missing_pixels_stay_narrow(device, rng):
    images = lit(rng, 0.4)
    hole = (np.arange(72)[:, None] % 13 < 5) & (np.arange(96) % 13 < 5)
    images = [np.where(hole, np.float32(np.nan), image) for image in images]
    _, radius, _ = matched(device, images, match_with_adaptive_windows)
    assert radius == 2


@pytest.mark.parametrize("count", [3, 40, 400])
def test_lower_scores_and_more_hypotheses_ask_for_wider_windows(count):
    radii = [radius_for(score, (300, 400), 2, count) for score in (0.95, 0.7, 0.5, 0.3, 0.1)]
    longer = [radius_for(score, (300, 400), 2, 10 * count) for score in (0.95, 0.7, 0.5, 0.3, 0.1)]
    assert radii == sorted(radii)
    assert (radii[0], radii[-1]) == (2, RADII[-1])
    assert all(a <= b for a, b in zip(radii, longer, strict=True))


def test_windows_stay_a_small_part_of_the_image():
    assert radius_for(0.1, (24, 32), 2, 40) == 2
