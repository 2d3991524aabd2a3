"""Image-based rendering: photographs of a known bed, seen from elsewhere, through the water and without it."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, ring

from fields import image_based
from fields.image_based import ImageBasedField, Source
from refract import FlatWater, PinholeCamera

BED = {"wet": PlaneBed(TILTED, -2.0, 0.1), "dry": PlaneBed(None, -2.0, 0.1)}
# The plate over the bed: its height, and half of its side [m].
PLATE, HALF = -1.0, 0.25
RED, GREEN = (200, 40, 40), (40, 200, 40)


def pattern(points: np.ndarray) -> np.ndarray:
    """Colours (..., 3), 60 to 180, of places (..., 2 or more) [m]; long against a pixel of 1.5 cm."""
    x, y = points[..., 0], points[..., 1]
    waves = np.stack([np.sin(9.0 * x) * np.cos(7.0 * y), np.cos(8.0 * x + y), np.sin(6.0 * y - x)], axis=-1)
    return 120.0 + 60.0 * waves


def seen_points(bed: PlaneBed, camera: PinholeCamera, optics: FlatWater | None) -> tuple[np.ndarray, np.ndarray]:
    """Heights (height, width) and points (height, width, 3) at which a camera sees the bed."""
    through = replace(bed, water=optics)
    height = through.true_height(camera)
    return height, camera.paths(camera.pixel_centres(), optics).at_height(height, optics)


def source_of(bed: PlaneBed, camera: PinholeCamera, exposure: float = 1.0) -> Source:
    height, points = seen_points(bed, camera, bed.water)
    rgb = np.clip(np.round(exposure * pattern(points)), 0, 255).astype(np.uint8)
    return Source(camera, rgb, None, 1.0, height.astype(np.float32))


def field_of(cameras: list[PinholeCamera], sources: list[Source], water, **parts) -> ImageBasedField:
    level = float(np.nanmedian(sources[0].heights))
    gains = parts.get("gains", np.ones((len(sources), 3)))
    mapped = frozenset(n for n, source in enumerate(sources) if source.heights is not None)
    return ImageBasedField(cameras, water, sources.__getitem__, mapped, level, 0.05, gains)


def novel_camera() -> PinholeCamera:
    return look((1.1, -0.8, 9.0), (0.0, 0.1, -2.0), heading=0.8)


@pytest.mark.parametrize("kind", ["wet", "dry"])
def test_a_bed_is_seen_where_it_is_and_in_its_colours(kind):
    bed, camera = BED[kind], novel_camera()
    cameras = ring()
    view = field_of(cameras, [source_of(bed, c) for c in cameras], bed.water).render(camera)
    height, points = seen_points(bed, camera, bed.water)
    assert view.seen.mean() > 0.99
    seen = view.seen
    assert np.abs(view.bed_height - height)[seen].max() < 1e-3
    # Rounding of the photographs to whole grey levels, and cubic interpolation.
    assert np.sqrt(np.mean((view.rgb - pattern(points))[seen] ** 2)) < 1.0
    path = camera.paths(camera.pixel_centres(), bed.water)
    np.testing.assert_allclose(path.at(view.distance.astype(np.float64))[seen], points[seen], atol=5e-3)
    normal = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    inner = np.isfinite(view.normal).all(axis=-1)
    assert np.median(np.linalg.norm(view.normal[inner] - normal, axis=-1)) < 0.01


def test_a_dry_view_looks_straight_at_what_is_under_the_water():
    bed, camera = BED["wet"], novel_camera()
    cameras = ring()
    view = field_of(cameras, [source_of(bed, c) for c in cameras], bed.water).render(camera, dry=True)
    straight = replace(bed.water, n_water=1.0)
    height, points = seen_points(bed, camera, straight)
    assert np.abs(view.bed_height - height)[view.seen].max() < 1e-3
    assert np.sqrt(np.mean((view.rgb - pattern(points))[view.seen] ** 2)) < 1.0
    wet = seen_points(bed, camera, bed.water)[1]
    assert np.sqrt(np.mean((view.rgb - pattern(wet))[view.seen] ** 2)) > 10.0


def test_the_water_is_taken_out_of_colours_by_depth_and_incidence_of_the_photographs():
    bed, cameras = BED["wet"], ring()
    asked = []

    def without_water(rgb, depth, incidence):
        asked.append((depth, incidence))
        return rgb + 20.0

    field = field_of(cameras, [source_of(bed, c) for c in cameras], bed.water)
    view, plain = (field.render(novel_camera(), dry=True, without_water=w) for w in (without_water, None))
    np.testing.assert_allclose(view.rgb[view.seen].astype(float) - plain.rgb[view.seen], 20.0, atol=1.0)
    depth, incidence = (np.concatenate(each) for each in zip(*asked, strict=True))
    # Down to 2.2 m under the tilted plane at local z = 0.1; cameras look down within 30 degrees.
    assert 1.8 < depth.min() < depth.max() < 2.4
    assert 0.0 <= incidence.min() < incidence.max() < 0.52


def plate_and_bed(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Heights (height, width), and whether the plate is seen, over a level bed in a dry survey."""
    path = camera.paths(camera.pixel_centres(), None)
    on_plate = (np.abs(path.at_height(np.full((camera.height, camera.width), PLATE), None)[..., :2]) < HALF).all(
        axis=-1
    )
    return np.where(on_plate, PLATE, -2.0), on_plate


@pytest.mark.parametrize("unmapped", [(), (1, 3, 4, 5, 7)])
def test_what_is_hidden_in_a_photograph_does_not_show_through(unmapped):
    cameras = ring(8, radius=5.0)
    sources = []
    for number, camera in enumerate(cameras):
        height, on_plate = plate_and_bed(camera)
        rgb = np.where(on_plate[..., None], RED, GREEN).astype(np.uint8)
        sources.append(Source(camera, rgb, None, 1.0, None if number in unmapped else height.astype(np.float32)))
    camera = look((2.5, 2.0, 9.0), (0.0, 0.0, -1.5))
    view = field_of(cameras, sources, None).render(camera)
    height, on_plate = plate_and_bed(camera)
    edge = np.zeros_like(on_plate)
    for shift in (-2, -1, 1, 2):
        for axis in (0, 1):
            edge |= np.roll(on_plate, shift, axis) != on_plate
    inner = view.seen & ~edge
    assert inner.mean() > 0.8
    right = np.abs(view.rgb.astype(int) - np.where(on_plate[..., None], RED, GREEN)).max(axis=-1) < 30
    assert right[inner].mean() > 0.995
    assert (np.abs(view.bed_height - height)[inner] < 0.01).mean() > 0.995


def test_gains_bring_photographs_to_one_exposure():
    bed, cameras = BED["wet"], ring()
    exposures = 1.0 - 0.06 * np.arange(len(cameras))
    sources = [source_of(bed, c, e) for c, e in zip(cameras, exposures, strict=True)]
    gains = np.repeat(1.0 / exposures[:, None], 3, axis=1)
    view = field_of(cameras, sources, bed.water, gains=gains).render(novel_camera())
    points = seen_points(bed, novel_camera(), bed.water)[1]
    assert np.sqrt(np.mean((view.rgb - pattern(points))[view.seen] ** 2)) < 1.2


def test_photographs_without_a_map_give_colours_too():
    bed, cameras = BED["wet"], ring()
    camera = novel_camera()
    sources = [source_of(bed, c) for c in cameras]
    sources[1] = replace(sources[1], rgb=np.zeros_like(sources[1].rgb), heights=None)
    view, points = field_of(cameras, sources, bed.water).render(camera), seen_points(bed, camera, bed.water)[1]
    darker = (view.rgb / pattern(points))[view.seen].mean()
    # One of six.
    assert 0.6 < darker < 0.95
    found = np.abs(view.bed_height - seen_points(bed, camera, bed.water)[0])[view.seen]
    # At the border, where no map is left, the height of the z-buffer is not averaged.
    assert np.quantile(found, 0.99) < 1e-3
    assert found.max() < 0.01


def test_no_more_photographs_are_held_than_a_tile_needs(monkeypatch):
    monkeypatch.setattr(image_based, "SOURCES", 2)
    bed, cameras = BED["wet"], ring(8)
    sources = [source_of(bed, c) for c in cameras]
    held, at_once, asked = [], [], set()

    def load(number):
        rgb = sources[number].rgb.copy()
        held.append(weakref.ref(rgb))
        at_once.append(sum(each() is not None for each in held))
        asked.add(number)
        return replace(sources[number], rgb=rgb, heights=sources[number].heights if number == 0 else None)

    field = replace(field_of(cameras, sources, bed.water), load=load, mapped=frozenset({0}))
    assert field.render(novel_camera()).seen.mean() > 0.5
    assert len(asked) > 3
    assert max(at_once) == 2


def test_masked_pixels_are_not_used():
    bed, cameras = BED["dry"], ring()
    sources = [source_of(bed, c) for c in cameras]
    spoiled = [replace(s, rgb=s.rgb.copy(), mask=np.ones(s.rgb.shape[:2], dtype=bool)) for s in sources]
    for each in spoiled[::2]:
        each.rgb[:, :40] = 255
        each.mask[:, :42] = False
    view = field_of(cameras, spoiled, None).render(novel_camera())
    points = seen_points(bed, novel_camera(), None)[1]
    assert np.sqrt(np.mean((view.rgb - pattern(points))[view.seen] ** 2)) < 1.0


def test_a_camera_that_looks_elsewhere_sees_nothing():
    bed, cameras = BED["wet"], ring()
    field = field_of(cameras, [source_of(bed, c) for c in cameras], bed.water)
    for camera in (look((500.0, 0.0, 9.0), (500.0, 0.1, -2.0)), look((0.0, 0.0, 9.0), (0.1, 0.0, 90.0))):
        view = field.render(camera)
        assert not view.seen.any()
        assert not view.rgb.any()
