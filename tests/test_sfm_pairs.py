"""Pairs of photographs that are matched: by footprints of positions, or by likeness where there are none."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from survey.photos.exif import Exif
from survey.sfm.features import _similar_pairs
from survey.sfm.pairs import LEAST_HEIGHT_M, NEIGHBOURS, VOTING, Place, image_pairs, pairs_about, similar_images
from survey.sfm.solve import Photographs

# A lens of 28 mm on full frame from 50 m: 64 x 43 m of the ground.
_SPREAD, _HEIGHT_M, _LONG_M, _SHORT_M = 0.643, 50.0, 64.3, 42.9


def strips(along: float, across: float, per_strip: int, num: int) -> dict[str, Place]:
    """Photographs that look straight down, by name."""
    at = [np.array([along * k, across * line, 50.0]) for line in range(num) for k in range(per_strip)]
    return {f"{number:05d}": Place(position, None, _SPREAD, _HEIGHT_M) for number, position in enumerate(at)}


def pairs_of(places: dict[str, Place]) -> list[tuple[str, str]]:
    return image_pairs(list(places), places)


def test_few_photographs_are_matched_in_all_pairs_wherever_they_are():
    names = [f"{i}.jpg" for i in range(8)]
    assert len(image_pairs(names, {})) == 28


def test_the_number_of_pairs_grows_with_the_number_of_photographs():
    counts = [len(pairs_of(strips(0.2 * _SHORT_M, 0.3 * _LONG_M, 20, num))) for num in (10, 20, 40)]
    assert counts[2] - counts[1] == pytest.approx(2.0 * (counts[1] - counts[0]), rel=0.05)
    assert counts[2] <= NEIGHBOURS * 800
    assert counts[2] == pytest.approx(pairs_about(800), rel=0.2)


@pytest.mark.parametrize(("overlap", "per_strip"), [(0.7, 40), (0.9, 40), (0.97, 40), (0.995, 700)])
def test_however_dense_a_strip_is_each_photograph_is_tied_to_the_strips_beside_it(overlap, per_strip):
    places = strips((1.0 - overlap) * _SHORT_M, 0.4 * _LONG_M, per_strip, 4)
    pairs = pairs_of(places)
    assert len(set(pairs)) == len(pairs)
    assert all(a < b for a, b in pairs)
    tied = Counter(name for pair in pairs for name in pair if int(pair[0]) // per_strip != int(pair[1]) // per_strip)
    assert min(tied[name] for name in places) >= 2


def test_footprints_that_do_not_touch_are_not_matched_beyond_the_nearest():
    far = strips(2.0 * _LONG_M, 2.0 * _LONG_M, 10, 10)
    by_name = Counter(name for pair in pairs_of(far) for name in pair)
    # Six of each, and those that have it among their six.
    assert max(by_name.values()) <= 12
    unknown = {name: Place(place.position) for name, place in far.items()}
    assert len(pairs_of(unknown)) > 1.5 * len(pairs_of(far))


def test_oblique_photographs_are_matched_where_they_look_and_not_where_they_stand():
    down = strips(0.3 * _SHORT_M, 0.4 * _LONG_M, 12, 5)
    # Those of a second flight look north by 45 degrees, and see what lies a height before them.
    ahead = Rotation.from_euler("x", 135.0, degrees=True).as_matrix()
    assert np.allclose(ahead[2], [0.0, math.sqrt(0.5), -math.sqrt(0.5)])
    oblique = {
        f"o{name}": Place(place.position - [0.0, 50.0, 0.0], ahead, _SPREAD, _HEIGHT_M) for name, place in down.items()
    }
    back = {f"b{name}": Place(place.position, ahead * [[1.0], [-1.0], [1.0]], None) for name, place in down.items()}
    pairs = pairs_of(down | oblique)
    across = [(a, b[1:]) for a, b in pairs if b.startswith("o") and not a.startswith("o")]
    assert len(across) > 60
    away = [np.hypot(*(down[a].position - down[b].position)[:2]) for a, b in across]
    assert np.quantile(away, 0.9) < _LONG_M
    # Without a height an attitude tells nothing of the place.
    assert pairs_of(down | back) == pairs_of(down | {name: Place(place.position) for name, place in back.items()})


def test_a_photograph_without_a_place_is_left_to_its_likeness():
    places = strips(0.3 * _SHORT_M, 0.4 * _LONG_M, 12, 5)
    lost = "00030"
    pairs = image_pairs(list(places), {name: place for name, place in places.items() if name != lost})
    assert pairs
    assert not [pair for pair in pairs if lost in pair]


@pytest.mark.parametrize("lost", [range(60), [7, 33]])
def test_photographs_look_like_those_that_show_the_same_ground(rng, lost):
    # Places along a line, of which each photograph shows a hundred: half of them are those of the next but four.
    ground = rng.gamma(0.5, 20.0, (1400, 128))
    shown = [ground[20 * k : 20 * k + 100] + rng.normal(0.0, 3.0, (100, 128)) for k in range(60)]
    descriptors = [np.clip(np.rint(own), 0, 255).astype(np.uint8) for own in shown]
    descriptors[5] = descriptors[5][:0]
    found = list(similar_images(iter(descriptors), len(descriptors), lost))
    assert {a for a, _ in found} <= set(lost)
    assert max(Counter(a for a, _ in found).values()) <= NEIGHBOURS
    for number in set(lost) - {5}:
        best = [b for a, b in found if a == number][:4]
        assert all(abs(b - number) <= 5 for b in best), (number, best)
    assert not [b for a, b in found if a == 5 or b == a]


def test_photographs_without_a_position_are_paired_by_the_features_of_the_database_and_by_their_names(tmp_path, rng):
    descriptors = [rng.integers(0, 120, (VOTING + 50, 128), dtype=np.uint8) for _ in range(12)]
    # The last looks like the third.
    descriptors[11][:VOTING] = descriptors[2][:VOTING]
    names = [f"{k:06d}.jpg" for k in range(12)]
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        camera = opened.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=8, height=8, params=[8.0, 4.0, 4.0]))
        for name, own in zip(names, descriptors, strict=True):
            number = opened.write_image(pycolmap.Image(name=name, camera_id=camera))
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, own))
    found = _similar_pairs(tmp_path / "database.db", names, [names[11], names[0]])
    voted = similar_images(iter(descriptors), 12, [11, 0])
    of_names = [(9, 11), (10, 11), (0, 1), (0, 2)]
    expected = [*(tuple(sorted(pair)) for pair in voted), *of_names]
    assert sorted(found) == sorted((names[a], names[b]) for a, b in expected)
    assert found[0] == (names[2], names[11])


def photographs(**headers) -> Photographs:
    """Ten photographs that look down from 60 m, with these in their headers."""
    names = [f"{k}.jpg" for k in range(10)]
    head = {"size_px": (4000, 3000), "lat_lon_height": None, "focal_px": 3000.0, "orientation": 1, "camera": ""}
    each = Exif(**{**head, "above_start_m": None, **headers})
    positions = {name: np.array([10.0 * k, 0.0, 60.0]) for k, name in enumerate(names)}
    return Photographs({}, dict.fromkeys(names, each), positions, None)


def test_footprints_are_those_of_the_larger_height_that_is_known():
    given = photographs()
    assert given.places["3.jpg"].height_m is None
    assert given.places["3.jpg"].spread == pytest.approx(2.0 / 3.0)
    started = photographs(above_start_m=40.0).places["3.jpg"].height_m
    assert started == 40.0
    levels = [Photographs({}, given.headers, given.positions, None, level) for level in (0.0, 0.5, -200.0)]
    heights = [each.places["3.jpg"].height_m for each in levels]
    assert heights[0] == heights[1]
    # Rounded up, by a tenth at most.
    assert 60.0 <= heights[0] < 66.1
    assert heights[2] >= 260.0
    under = Photographs({}, given.headers, given.positions, None, 80.0)
    assert under.places["3.jpg"].height_m is None


def flown(low_m: float, high_m: float) -> dict[str, np.ndarray]:
    """Positions of 280 photographs from one height and 24 from another over the same 180 m by 160 m, ground at 100 m.

    Names begin with `l` or `h`; each flight overlaps by 80 % along its strips and by 60 % across.
    """
    found = {}
    for name, height, (num, strips_) in (("l", low_m, (20, 14)), ("h", high_m, (6, 4))):
        along, across = 180.0 / (num - 1), 160.0 / (strips_ - 1)
        for k in range(num * strips_):
            found[f"{name}{k:03d}"] = np.array([along * (k % num), across * (k // num), 100.0 + height])
    return found


@pytest.mark.parametrize("told_by", ["level", "start", "start of half"])
def test_photographs_of_two_heights_are_tied_to_those_of_their_own_height_first(told_by):
    positions = flown(30.0, 120.0)
    one = photographs().headers["3.jpg"]
    above = {name: float(at[2]) - 100.0 for name, at in positions.items()}
    told = {"level": [], "start": list(positions), "start of half": list(positions)[::2]}[told_by]
    headers = {name: replace(one, above_start_m=above[name] if name in told else None) for name in positions}
    given = Photographs({}, headers, positions, None, 100.0 if told_by == "level" else None)
    places = given.places
    # A level's height is rounded up, by a tenth of that of most at most.
    assert all(above[name] - 1e-9 <= place.height_m < above[name] + 3.1 for name, place in places.items())
    pairs = pairs_of(places)
    own = Counter(name for pair in pairs if pair[0][0] == pair[1][0] for name in pair)
    # Those at a corner have five beside them.
    assert min(own[name] for name in places) >= 5
    # The two flights are one block.
    assert any(a[0] != b[0] for a, b in pairs)


def test_a_photograph_of_the_take_off_does_not_touch_all_others():
    given = photographs(above_start_m=40.0)
    headers = {**given.headers, "0.jpg": replace(given.headers["0.jpg"], above_start_m=0.1)}
    places = Photographs({}, headers, given.positions, None).places
    assert places["0.jpg"].height_m == LEAST_HEIGHT_M
    assert places["1.jpg"].height_m == 40.0


def test_a_focal_length_of_a_calibration_counts_before_that_of_exif():
    given = photographs()
    calibrated = Photographs({}, given.headers, given.positions, 1500.0)
    assert calibrated.places["3.jpg"].spread == pytest.approx(4.0 / 3.0)
