"""Blocks of photographs by pycolmap: a database of features and verified matches, and what mapping makes of them.

Pixels are those of the stored image, whatever its EXIF orientation, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.frames import Similarity
from refract.lens import Lens
from survey import machine
from survey.photos.poses import TiePoints, least_track
from survey.progress import current
from survey.sfm.distributed import Workers, workers
from survey.sfm.features import ImageFeatures, PairsToMatch, features_of
from survey.sfm.incremental import DIRECT_UP_TO, map_directly, pipeline_options
from survey.sfm.pairs import VOTING, Place, image_pairs, similar_images
from survey.sfm.settings import ALL_PAIRS_UP_TO, MIN_IMAGES, SEED, THREADS, solver
from survey.words import Mapper

if TYPE_CHECKING:
    import pycolmap

# f, cx, cy, k1, k2. With one coefficient a real block is bent by decimetres; more than two gain nothing (see tests).
MODEL = "RADIAL"
# Most features of an image. The adjustment uses a few hundred of them (`survey.adjust.block.observed`), and twice
# as many take four times as long to match.
_MOST_FEATURES = 2048
# Pairs of a part, whose features are in memory together: some 100 images, of 0.3 MB each.
_PAIRS_AT_ONCE = 100
# Of a photograph while its features are looked for.
_BYTES_OF_FEATURES = 2.0e9


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
    """Features of an image in a database."""
    keypoints, descriptors = opened.read_keypoints(image.image_id), opened.read_descriptors(image.image_id)
    return ImageFeatures(opened.read_camera(image.camera_id), keypoints[:, :2], descriptors.data)


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
