"""Features of photographs (SIFT by OpenCV), and their matches, verified by the epipolar geometry of each pair.

D. G. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 60, 2004. Pixels are those of the stored
image, whatever its EXIF orientation, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Protocol, TypeVar

import cv2
import numpy as np

from survey import machine
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.progress import current
from survey.sfm.pairs import ALL_PAIRS_UP_TO, VOTING, Place, image_pairs, similar_images

if TYPE_CHECKING:
    import pycolmap

# Longest side [px] of a photograph for the detection of features; larger ones are reduced.
FEATURES_PX = 3200
SEED = 0
_ERRORS_ONLY = 2
# f, cx, cy, k1, k2. With one coefficient a real block is bent by decimetres; more than two gain nothing (see tests).
MODEL = "RADIAL"
# Most features of an image. The adjustment uses a few hundred of them (`survey.adjust.block.observed`), and twice
# as many take four times as long to match.
_MOST_FEATURES = 2048
# Pairs of a part, whose features are in memory together: some 100 images, of 0.3 MB each.
_PAIRS_AT_ONCE = 100
# Of a photograph while its features are looked for.
_BYTES_OF_FEATURES = 2.0e9
# Extrema of less contrast are noise; the limit is that of pycolmap.
_CONTRAST = 0.02
# A descriptor's numbers are shares of its whole, of which a byte has so many steps.
_STEPS = 512.0
# Angle [rad] between the descriptors of a match at most, and as a share of that to the second nearest (as COLMAP).
_MOST_ANGLE, _MOST_RATIO = 0.7, 0.8

Item = TypeVar("Item")
Result = TypeVar("Result")


def solver() -> ModuleType:
    """pycolmap, which prints errors only."""
    import pycolmap

    pycolmap.logging.minloglevel = _ERRORS_ONLY
    return pycolmap


class Workers(Protocol):
    """Workers that compute a function of many items."""

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items."""


_WORKERS: ContextVar[Callable[[], AbstractContextManager[Workers]] | None] = ContextVar("workers", default=None)


@contextmanager
def computing_on(start: Callable[[], AbstractContextManager[Workers]]) -> Iterator[None]:
    """Within it, features and matches are computed on workers, which ``start`` gives when they are needed."""
    token = _WORKERS.set(start)
    try:
        yield
    finally:
        _WORKERS.reset(token)


def workers() -> AbstractContextManager[Workers] | None:
    """The workers to compute on; None where this process computes all itself."""
    start = _WORKERS.get()
    return None if start is None else start()


@dataclass(frozen=True)
class CameraBody:
    """A camera body with one lens at one zoom, and its photographs."""

    names: tuple[str, ...]  # of its images in the folder; without spaces
    size_px: tuple[int, int]  # (width, height)
    focal_px: float | None  # To start from; None where nothing is known


@dataclass(frozen=True)
class MatchedPhotographs:
    """Photographs with verified matches."""

    database: Path
    folder: Path  # In which the images lie
    work: Path  # For files of the mapper
    num: int  # Of images


def match_photographs(
    folder: Path, sensors: Sequence[CameraBody], places: Mapping[str, Place], work: Path, report: Callable[[str], None]
) -> MatchedPhotographs:
    """Features and verified matches of the images in a folder, in a database in an empty folder ``work``.

    ``places`` of images whose position is known select the pairs to match.
    """
    colmap = solver()
    database, names = work / "database.db", sorted(name for sensor in sensors for name in sensor.names)
    colmap.set_random_seed(SEED)
    colmap.Database.open(database).close()
    for sensor in sensors:
        # Before the features, so that images have the same numbers however threads take turns.
        colmap.import_images(database, folder, colmap.CameraMode.SINGLE, list(sensor.names), _reader(sensor))
    with workers() or nullcontext() as pool:
        on = "" if pool is None else ", on workers"
        report(f"structure from motion: features of {len(names)} images{on}")
        _extract(database, folder, names, pool)
        pairs = image_pairs(names, places)
        lost = [name for name in names if name not in places]
        if lost and len(names) > ALL_PAIRS_UP_TO:
            report(f"structure from motion: {len(lost)} images without a position are matched by likeness")
            pairs = sorted({*pairs, *_similar_pairs(database, names, lost)})
        report(f"structure from motion: matches of {len(pairs)} pairs{on}")
        _match_all(database, pairs, pool)
    return MatchedPhotographs(database, folder, work, len(names))


def _extract(database: Path, folder: Path, names: Sequence[str], pool: Workers | None) -> None:
    colmap = solver()
    at_once = min(machine.num_cores(), int(machine.free_memory_bytes() / _BYTES_OF_FEATURES))
    find = partial(features_of, most=_MOST_FEATURES)
    with (
        colmap.Database.open(database) as opened,
        current().stage("Features", len(names)) as step,
        ThreadPoolExecutor(max(at_once, 1)) as threads,
    ):
        # Workers may not see the folder, which holds links; they see the photographs by the paths of the survey.
        paths = [folder / name for name in names]
        paths = [path.readlink() if path.is_symlink() else path for path in paths]
        found = (threads if pool is None else pool).map(find, paths)
        for name, (keypoints, descriptors) in zip(names, found, strict=True):
            number = opened.read_image_with_name(name).image_id
            opened.write_keypoints(number, keypoints)
            opened.write_descriptors(number, colmap.FeatureDescriptors(colmap.FeatureExtractorType.SIFT, descriptors))
            step.advance()


def _reader(sensor: CameraBody) -> pycolmap.ImageReaderOptions:
    options = solver().ImageReaderOptions()
    options.camera_model = MODEL
    if sensor.focal_px is not None:
        width, height = sensor.size_px
        options.camera_params = f"{sensor.focal_px!r},{0.5 * width!r},{0.5 * height!r},0,0"
    return options


def _similar_pairs(database: Path, names: Sequence[str], lost: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of images without a position with those that look like them, and with the next in order of names."""
    at = {name: k for k, name in enumerate(names)}
    of = [at[name] for name in lost]
    with solver().Database.open(database) as opened:
        numbers = (opened.read_image_with_name(name).image_id for name in names)
        descriptors = (opened.read_descriptors(number).data[:VOTING] for number in numbers)
        found = [*similar_images(descriptors, len(names), of), *((k, k + step) for k in of for step in (-2, -1, 1, 2))]
    return [(names[min(i, j)], names[max(i, j)]) for i, j in found if min(i, j) >= 0 and max(i, j) < len(names)]


def _match_all(database: Path, pairs: Sequence[tuple[str, str]], pool: Workers | None) -> None:
    """Verified matches of pairs, part by part."""
    parts = [pairs[first : first + _PAIRS_AT_ONCE] for first in range(0, len(pairs), _PAIRS_AT_ONCE)]
    with solver().Database.open(database) as opened, current().stage("Matches", len(pairs)) as step:
        images = {image.name: image for image in opened.read_all_images()}
        to_match = (
            PairsToMatch(part, {name: _features_in(opened, images[name]) for name in sorted(set(chain(*part)))})
            for part in parts
        )
        match = partial(PairsToMatch.matched, threads=machine.num_cores() if pool is None else 1)
        for part, found in zip(parts, map(match, to_match) if pool is None else pool.map(match, to_match), strict=True):
            for (one, other), (matches, geometry) in zip(part, found, strict=True):
                numbers = images[one].image_id, images[other].image_id
                opened.write_matches(*numbers, matches)
                opened.write_two_view_geometry(*numbers, geometry)
            step.advance(len(part))


def _features_in(opened: pycolmap.Database, image: pycolmap.Image) -> ImageFeatures:
    keypoints, descriptors = opened.read_keypoints(image.image_id), opened.read_descriptors(image.image_id)
    return ImageFeatures(opened.read_camera(image.camera_id), keypoints[:, :2], descriptors.data)


def features_of(path: Path, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Features of a photograph as it is stored, those of the largest scale first, and no more than ``most``.

    (N, 4) float32, x, y, scale [px] and orientation [rad], and (N, 128) uint8, roots of the shares as pycolmap has them
    (R. Arandjelovic and A. Zisserman, Three things everyone should know to improve object retrieval, 2012).
    """
    pixels = cv2.cvtColor(eight_bits(read_rgb(path)), cv2.COLOR_RGB2GRAY)
    whole = min(1.0, FEATURES_PX / max(pixels.shape))
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    # The largest are kept, and most photographs have enough of them at half the size, at a quarter of the cost.
    for shrunk in (0.5 * whole, whole):
        reduced = cv2.resize(pixels, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
        found = sift.detect(reduced, None)
        if len(found) >= most:
            break
    # A large feature is found again from further off, and in worse photographs.
    found = sorted(found, key=lambda each: (-each.size, -each.response, each.pt))[:most]
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    found, descriptors = sift.compute(reduced, found)
    at = (np.array([each.pt for each in found]) + 0.5) / shrunk
    size = np.array([[0.5 * each.size / shrunk, np.radians(each.angle)] for each in found])
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    rooted = np.clip(np.rint(_STEPS * np.sqrt(share)), 0, 255).astype(np.uint8)
    return np.column_stack([at, size]).astype(np.float32), rooted


@dataclass(frozen=True)
class ImageFeatures:
    camera: pycolmap.Camera
    pixels: np.ndarray  # (N, 2) float32 [px]
    descriptors: np.ndarray  # (N, 128) uint8


@dataclass(frozen=True)
class PairsToMatch:
    """Pairs of images, and the features of these images by name."""

    pairs: Sequence[tuple[str, str]]
    features: Mapping[str, ImageFeatures]

    def matched(self, threads: int = 1) -> list[tuple[np.ndarray, pycolmap.TwoViewGeometry]]:
        """Matches (K, 2) uint32 of each pair, by numbers of features, and what its epipolar geometry keeps of them.

        Each pair has its own random numbers, so that threads change nothing.
        """
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(lambda pair: _verified(*(self.features[name] for name in pair)), self.pairs))


def _verified(one: ImageFeatures, other: ImageFeatures) -> tuple[np.ndarray, pycolmap.TwoViewGeometry]:
    matches, options = mutual_matches(one.descriptors, other.descriptors), solver().TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return matches, solver().estimate_two_view_geometry(
        one.camera, one.pixels, other.camera, other.pixels, matches, options
    )


def mutual_matches(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Matches (K, 2) uint32 of descriptors (N, 128) and (M, 128) uint8 that are nearest to each other.

    Either is clearly nearer to the other than to any second one. Products of bytes of this length are whole in
    float32, so that no order of summation changes a match.
    """
    if not len(one) or not len(other):
        return np.zeros((0, 2), np.uint32)
    alike = one.astype(np.float32) @ other.astype(np.float32).T
    nearest = alike.argmax(axis=1)
    best = alike[np.arange(len(one)), nearest]
    mutual = np.flatnonzero(best >= alike.max(axis=0)[nearest])
    nearest, best = nearest[mutual], best[mutual]
    alike[mutual, nearest] = 0.0
    second = np.maximum(alike.max(axis=1)[mutual], alike.max(axis=0)[nearest])
    angle, to_second = (np.arccos(np.minimum(each / _STEPS**2, 1.0)) for each in (best, second))
    is_clear = (angle <= _MOST_ANGLE) & (angle < _MOST_RATIO * to_second)
    return np.column_stack([mutual, nearest])[is_clear].astype(np.uint32)
