"""Blocks of photographs by pycolmap: features (SIFT by OpenCV), verified matches, and what mapping makes of them.

Nothing outside this file knows pycolmap's options. Pixels are those of the stored image,
whatever its EXIF orientation, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from geo.similarity import Similarity
from refract.lens import Lens
from survey import machine
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.photos.poses import TiePoints, least_track
from survey.progress import current
from survey.sfm.distributed import Workers, add_rows, part_of, rows_of, workers
from survey.sfm.incremental import DIRECT_UP_TO, map_directly, pipeline_options
from survey.sfm.pairs import VOTING, Place, image_pairs, similar_images
from survey.sfm.settings import ALL_PAIRS_UP_TO, FEATURES_PX, MIN_IMAGES, SEED, THREADS, solver
from survey.words import Mapper

if TYPE_CHECKING:
    import pycolmap

# Extrema of less contrast are noise; the limit is that of pycolmap.
_CONTRAST = 0.02
# A descriptor's numbers are shares of its whole, of which a byte has so many steps.
_STEPS = 512.0
# f, cx, cy, k1, k2. With one coefficient a real block is bent by decimetres; more than two gain nothing (see tests).
MODEL = "RADIAL"
# Most features of an image. The adjustment uses a few hundred of them (`survey.adjust.block.observed`), and twice
# as many take twice the time.
_MOST_FEATURES = 4096
# Pairs that are matched between two words on the progress, at least.
_PAIRS_AT_ONCE = 100
# Of a photograph while its features are looked for.
_BYTES_OF_FEATURES = 2.0e9


def features_of(path: Path, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Features of a photograph, those of the largest scale first.

    Parameters
    ----------
    path : Path
        EXIF orientation is not applied.
    most : int
        No more than these are kept.

    Returns
    -------
    (N, 4) float32
        x, y, scale [px] and orientation [rad], in the stored photograph.
    (N, 128) uint8
        Roots of the shares (R. Arandjelovic and A. Zisserman, Three things everyone should know to improve object
        retrieval, 2012), as pycolmap has them.
    """
    pixels = cv2.cvtColor(eight_bits(read_rgb(path)), cv2.COLOR_RGB2GRAY)
    shrunk = min(1.0, FEATURES_PX / max(pixels.shape))
    if shrunk < 1.0:
        pixels = cv2.resize(pixels, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    found = sift.detect(pixels, None)
    # A large feature is found again from further off, and in worse photographs.
    found = sorted(found, key=lambda each: (-each.size, -each.response, each.pt))[:most]
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    found, descriptors = sift.compute(pixels, found)
    at = (np.array([each.pt for each in found]) + 0.5) / shrunk
    size = np.array([[0.5 * each.size / shrunk, np.radians(each.angle)] for each in found])
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    rooted = np.clip(np.rint(_STEPS * np.sqrt(share)), 0, 255).astype(np.uint8)
    return np.column_stack([at, size]).astype(np.float32), rooted


@dataclass(frozen=True)
class CameraBody:
    """A camera body with one lens at one zoom, and its photographs."""

    names: tuple[str, ...]  # of its images in the folder; without spaces
    size_px: tuple[int, int]  # (width, height)
    focal_px: float | None  # To start from; None where nothing is known


def match_photographs(
    folder: Path, sensors: Sequence[CameraBody], places: Mapping[str, Place], work: Path, report: Callable[[str], None]
) -> MatchedPhotographs:
    """Features and verified matches of images.

    Parameters
    ----------
    folder : Path
        In which the images lie.
    sensors : of all images
    places : mapping of name to Place
        Of images whose position is known; they select the pairs to match.
    work : Path
        An empty folder for the database of features.
    report : callable
        Called with a sentence on the progress.
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
        _match_all(database, pairs, work, pool)
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


def _match_all(database: Path, pairs: Sequence[tuple[str, str]], work: Path, pool: Workers | None) -> None:
    """Matches of pairs, part by part."""
    at_once = _PAIRS_AT_ONCE if pool is not None else max(_PAIRS_AT_ONCE, len(pairs) // 20)
    parts = [pairs[first : first + at_once] for first in range(0, len(pairs), at_once)]
    with current().stage("Matches", len(pairs)) as step:
        if pool is None:
            for some in parts:
                _match(database, some, work, machine.num_cores())
                step.advance(len(some))
            return
        found = pool.map(partial(rows_of, match=_match), (part_of(database, some) for some in parts))
        for some, rows in zip(parts, found, strict=True):
            add_rows(database, rows)
            step.advance(len(some))


def _match(database: Path, pairs: Sequence[tuple[str, str]], work: Path, threads: int) -> None:
    """Matches of pairs, verified; each pair has its own random numbers, so that threads change nothing."""
    colmap = solver()
    pairing, matching, verification = (
        colmap.ImportedPairingOptions(),
        colmap.FeatureMatchingOptions(),
        colmap.TwoViewGeometryOptions(),
    )
    pairing.match_list_path = work / "pairs.txt"
    matching.num_threads, matching.use_gpu = threads, False
    verification.ransac.random_seed = SEED
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    colmap.match_image_pairs(database, matching, pairing, verification, colmap.Device.cpu)


def camera_of(block: pycolmap.Reconstruction, name: str) -> pycolmap.Camera:
    """The camera of an image, whose parameters may be set."""
    return block.camera(block.find_image_with_name(name).camera_id)


def lens_of(block: pycolmap.Reconstruction, name: str) -> Lens:
    """The lens of the camera of an image."""
    camera = camera_of(block, name)
    return Lens(camera.model_name, tuple(float(p) for p in camera.params), camera.width, camera.height)


def drop_images(block: pycolmap.Reconstruction, names: Collection[str]) -> None:
    """Remove images, and points that then one image alone sees, from a block; in place."""
    for image in [image for image in block.images.values() if image.has_pose and image.name in names]:
        block.deregister_frame(image.frame_id)


def transform(block: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Transform a block into another frame; in place."""
    colmap = solver()
    rotation = colmap.Rotation3d(similarity.rotation)
    block.transform(colmap.Sim3d(similarity.scale, rotation, similarity.shift))


def adjust_with_focals(block: pycolmap.Reconstruction) -> None:
    """Adjust a block with its focal lengths as they are; in place."""
    options = solver().BundleAdjustmentOptions()
    options.refine_focal_length, options.print_summary = False, False
    options.ceres.solver_options.num_threads = THREADS
    solver().bundle_adjustment(block, options)


def points_of(block: pycolmap.Reconstruction) -> np.ndarray:
    """Points (N, 3) in the frame of the block."""
    return np.array([block.points3D[number].xyz for number in sorted(block.points3D)]).reshape(-1, 3)


def tracks_of(block: pycolmap.Reconstruction, names: Sequence[str]) -> TiePoints:
    """Points that three photographs or more see, of two both, and where; views are numbered as in `names`."""
    least = least_track(len(names))
    at = {name: k for k, name in enumerate(names)}
    number = {image.image_id: at[image.name] for image in block.images.values() if image.has_pose}
    start: list[np.ndarray] = []
    pixel: list[np.ndarray] = []
    point: list[int] = []
    view: list[int] = []
    for key in sorted(block.points3D):
        found = block.points3D[key]
        # A photograph may show a point twice, where two of its features were taken for one.
        seen = {number[e.image_id]: block.images[e.image_id].points2D[e.point2D_idx].xy for e in found.track.elements}
        if len(seen) < least:
            continue
        for placed, xy in sorted(seen.items()):
            point.append(len(start))
            view.append(placed)
            pixel.append(xy)
        start.append(found.xyz)
    return TiePoints(
        np.array(start, dtype=np.float64).reshape(-1, 3),
        np.array(point, dtype=np.int64),
        np.array(view, dtype=np.int64),
        np.array(pixel, dtype=np.float64).reshape(-1, 2),
        least,
    )


def poses_of(block: pycolmap.Reconstruction) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Camera centres (3,) and rotations (3, 3) from the frame of the block to cam, by name, in order of names."""
    images = sorted((image for image in block.images.values() if image.has_pose), key=lambda image: image.name)
    return {image.name: (image.projection_center(), image.cam_from_world().rotation.matrix()) for image in images}


@dataclass(frozen=True)
class MatchedPhotographs:
    """Photographs with verified matches."""

    database: Path
    folder: Path  # In which the images lie
    work: Path  # For files of the mapper
    num: int  # Of images


def reconstruct(matched: MatchedPhotographs, mapper: str) -> list[pycolmap.Reconstruction]:
    """Reconstructions of poses and points, each in a frame of its own; the largest first."""
    run = _global if mapper == Mapper.global_ else _incremental
    with current().stage("Structure from motion", matched.num) as step:
        blocks = run(matched, step.advance)
    return sorted(blocks.values(), key=lambda block: (-block.num_reg_images(), -block.num_points3D()))


def _incremental(matched: MatchedPhotographs, advance: Callable[..., None]) -> dict[int, pycolmap.Reconstruction]:
    options = pipeline_options(matched.num)
    # The first two come together.
    advance(2.0)
    if matched.num > DIRECT_UP_TO:
        return dict(enumerate(map_directly(matched.database, options, advance)))
    return solver().incremental_mapping(
        matched.database, matched.folder, matched.work, options, next_image_callback=advance
    )


def _global(matched: MatchedPhotographs, _advance: Callable[..., None]) -> dict[int, pycolmap.Reconstruction]:
    options = solver().GlobalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = THREADS, SEED, MIN_IMAGES
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    return solver().global_mapping(matched.database, matched.folder, matched.work, options)
