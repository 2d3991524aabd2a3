"""The sweep on a device with a memory of its own: the same heights, and images that stay there between the passes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from apart_device import device_apart
from plane_survey import PlaneBed, ring, texture
from slow_cases import slow

from fields.device import choose_device
from fields.sweep import device_filters, images_device
from fields.sweep.block import Block
from fields.sweep.kernels import arrays
from fields.sweep.maps import HeightMap
from fields.sweep.passes import DiscontinuitySearch, Pass
from fields.sweep.sweep import device_map_store, sweep
from fields.sweep.view_pass import SweepSettings
from refract import FlatWater

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
LOW, HIGH = -2.0, -1.7
# Each view is matched with all others; a ring of more adds time alone.
VIEWS = tuple(range(5))
PASSES = (
    Pass(0.5, 2, None, 0.5, 6, False, DiscontinuitySearch(2, 0.5, 16, 2.0, 5, 0.05)),
    Pass(1.0, 2, 7, 0.4, 6, True, DiscontinuitySearch(1, 0.75, 8, 1.6, 3, 0.5, walls=True)),
    Pass(1.0, 1, 3, 0.25, 8, True, points_only=True),
)
# Heights are the same but for rounding, which decides where two score alike [m]; a pixel is 1.5 cm.
SAME_M, OTHERS = 2e-4, 0.01
PLENTY = 10**9


@dataclass(frozen=True)
class Terrace:
    """A bed with a step of 0.3 m, high in the west."""

    def photograph(self, camera) -> np.ndarray:
        path = camera.paths(camera.pixel_centres(), WATER)
        height = np.where(path.at_height(HIGH, WATER)[..., 0] < 0.1, HIGH, LOW)
        points = path.at_height(height.astype(np.float32), WATER)
        return texture(points[..., 0], points[..., 1]).astype(np.float32)


def block_of(device, *, holes: bool = False) -> Block:
    """Five views of the terrace; with ``holes`` each photograph has masked pixels."""
    cameras = ring(4)
    images = [Terrace().photograph(camera) for camera in cameras]
    for number, image in enumerate(images if holes else []):
        image[20 + number : 32 + number, 30:44] = np.nan
        image[50, 60 + number] = np.nan
    return PlaneBed(WATER, LOW).block(device, cameras, images)


def swept(device, *, holes: bool = False, room: int = PLENTY, passes=PASSES, area=None, **options) -> list[HeightMap]:
    """Maps of all views, by a device whose memory has so many bytes."""
    block = block_of(device, holes=holes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fields.sweep.sweep.memory_bytes", lambda device: room)
        return list(sweep(block, list(VIEWS), SweepSettings((-2.4, -1.4), passes, area), lambda share: None, **options))


def plain(apart):
    """The same device with its images on the host between the kernels."""
    return choose_device("torch" if apart.module is None else "cpu")


def assert_same(maps: list[HeightMap], others: list[HeightMap]) -> None:
    """That two sweeps give the same maps but for rounding."""
    assert [m.view for m in maps] == [m.view for m in others]
    for m, other in zip(maps, others, strict=True):
        for name in ("height", "score", "agreeing", "spread"):
            assert getattr(m, name).dtype == getattr(other, name).dtype
        assert np.mean(np.abs(m.height - other.height) > SAME_M) < OTHERS
        assert np.mean(m.agreeing != other.agreeing) < OTHERS
        assert np.mean(np.abs(m.score.astype(np.float32) - other.score) > 1e-3) < OTHERS
        assert np.mean(np.abs(m.spread.astype(np.float32) - other.spread) > SAME_M) < OTHERS


@pytest.fixture(
    scope="module",
    params=["cpu", pytest.param("torch", marks=pytest.mark.slow), pytest.param("cuda", marks=pytest.mark.gpu)],
)
def apart(request):
    """Torch takes several times as long."""
    return device_apart(request.param)


@pytest.fixture(scope="module")
def beside(apart) -> list[HeightMap]:
    """Maps by a device with its images in its own memory."""
    return swept(apart)


@pytest.mark.parametrize("options", [{}, {"holes": True}, {"area": (-0.25, -0.3, 0.35, 0.2)}], ids=str)
def test_heights_are_those_of_images_on_the_host(apart, beside, options):
    assert_same(swept(apart, **options) if options else beside, swept(plain(apart), **options))


def test_between_the_passes_the_host_is_told_numbers_and_tiles_alone(apart, monkeypatch):
    told = []

    def listening(fetch):
        def told_of(*arguments):
            found = fetch(*arguments)
            told.append(found.size)
            return found

        return told_of

    for module, name in (
        (arrays, "as_numpy"),
        (images_device, "as_numpy"),
        (device_filters, "as_numpy"),
        (arrays, "host"),
    ):
        monkeypatch.setattr(module, name, listening(getattr(module, name)))
    in_the_end = images_device.download

    def left(m):
        before = len(told)
        found = in_the_end(m)
        del told[before:]
        return found

    monkeypatch.setattr(images_device, "download", left)
    maps = swept(apart)
    # Parts of four by four pixels become points; tiles have more.
    assert len(told) > 20
    assert max(told) <= maps[0].height.size / 16


@pytest.mark.parametrize("room", [slow(0), 6 * 16 * 96 * 72])
def test_maps_for_which_the_device_has_no_room_wait_on_the_host(apart, beside, room):
    assert_same(swept(apart, room=room), beside)


def test_a_place_for_maps_takes_and_gives_room(apart, rng):
    shape = (4, 6)
    nothing = (np.zeros(shape, kind) for kind in (np.float16, np.uint8, np.float16))
    m = HeightMap(2, rng.random(shape).astype(np.float32), *nothing)
    aside = {}
    maps = device_map_store(apart, lambda: aside, 16 * 24)()
    for view in (2, 5):
        maps[view] = images_device.upload(apart, replace(m, view=view))
    assert sorted(aside) == [5]
    assert list(maps) == [2, 5]
    assert 5 in maps
    for view in (2, 5):
        np.testing.assert_array_equal(images_device.download(maps[view]).height, m.height)
    maps[2] = images_device.upload(apart, m)
    assert sorted(aside) == [5]
    del maps[2]
    maps[5] = images_device.upload(apart, replace(m, view=5))
    assert not aside
    assert len(maps) == 1
