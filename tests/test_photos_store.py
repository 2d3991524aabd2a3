"""Photographs that several stages use: decoded once while memory lasts, and the same to the last bit."""

import numpy as np
import pytest
from small_survey import replaced, small_survey

from survey.folder.survey import load_survey
from survey.photos import images
from survey.photos.images import ImageStore, load_image
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.sweep_block import _read_ahead, load_block

BYTES = 64 * 48 * 3


@pytest.fixture
def survey(tmp_path):
    lens = replaced(('"PINHOLE"', '"OPENCV"'), ("focal_px", "distortion = [-0.1, 0.02, 0.001, 0.0]\nfocal_px"))
    return load_survey(small_survey(tmp_path / "s", toml=lens))


@pytest.fixture
def decoded(monkeypatch) -> list[str]:
    """Names of the files that were decoded."""
    names, decode = [], images.read_rgb

    def counting(path):
        names.append(path.name)
        return decode(path)

    monkeypatch.setattr(images, "read_rgb", counting)
    return names


def test_stages_that_share_a_store_decode_each_photograph_once(survey, decoded):
    plan, store = make_plan(survey, Choices(device="cpu")), ImageStore(100 * BYTES)
    load_block(survey, plan, lambda _share: None, store)
    for _stage in range(3):
        for view in survey.views:
            store.load(view, scale=plan.image_scale)
    assert sorted(decoded) == [view.name for view in survey.views]


def test_a_store_that_was_cleared_keeps_what_comes_next(survey, decoded):
    first, second = survey.views[:2]
    store = ImageStore(BYTES)
    for view in (first, first, second, second):
        store.load(view)
    store.clear()
    for view in (second, second):
        store.load(view)
    assert decoded == [view.name for view in (first, second, second, second)]


def test_a_block_is_the_same_with_a_store_and_without(survey):
    plan = make_plan(survey, Choices(device="cpu"))
    blocks = [load_block(survey, plan, lambda _share: None, store) for store in (None, ImageStore(2 * BYTES))]
    for without, with_store in zip(*(block.images for block in blocks), strict=True):
        np.testing.assert_array_equal(without, with_store)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_kept_images_are_those_of_load_image_and_cannot_be_written_to(survey, scale):
    store, view = ImageStore(100 * BYTES), survey.views[0]
    expected = load_image(view, scale=scale)
    for _time in range(2):
        image = store.load(view, scale=scale)
        np.testing.assert_array_equal(image, expected)
        with pytest.raises(ValueError, match="read-only"):
            image[0, 0] = 0


def test_images_beyond_the_budget_are_decoded_again_and_the_first_ones_stay(survey, decoded):
    store = ImageStore(2 * BYTES)
    for _stage in range(2):
        for view in survey.views:
            store.load(view)
    names = [view.name for view in survey.views]
    assert decoded == names + names[2:]


def test_photographs_are_read_ahead_in_their_order_and_as_many_as_memory_allows(monkeypatch):
    monkeypatch.setattr("survey.machine.num_cores", lambda: 8)
    begun = []
    found = _read_ahead(lambda view: begun.append(view) or view, range(9), 3)
    assert next(found) == 0
    assert set(begun) <= {0, 1, 2}
    assert list(found) == list(range(1, 9))
    assert list(_read_ahead(lambda view: view, range(4), 0)) == [0, 1, 2, 3]
