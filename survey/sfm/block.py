"""Blocks of photographs by pycolmap: features, matches, poses, and their adjustment to GPS positions.

Nothing outside this file knows pycolmap's options. Pixels are those of the stored image, whatever its EXIF
orientation, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

# pycolmap 4.2.1 bundles its own zlib; if that is loaded before the system's, reading a PNG file corrupts the heap.
import zlib  # noqa: F401
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geo.similarity import Similarity
from refract.lens import Lens

if TYPE_CHECKING:
    import pycolmap

# More threads would be faster; with two, repeated runs agree in all significant digits.
_THREADS = 2
_SEED = 0
# f, cx, cy, k1, k2. With one coefficient a real block is bent by decimetres; more than two gain nothing (see tests).
MODEL = "RADIAL"
# Longest side [px] of an image for feature detection; larger images are reduced.
_FEATURE_SIZE_PX = 3200
# Up to this many images every pair is tried, beyond it each image with its nearest neighbours.
_ALL_PAIRS_UP_TO = 40
_NEIGHBOURS = 20
_MIN_IMAGES = 3
_ERRORS_ONLY = 2


@dataclass(frozen=True)
class Sensor:
    """A camera body with one lens at one zoom, and its photographs.

    Attributes
    ----------
    names : of its images in the folder; without spaces
    size_px : (width, height)
    focal_px : float or None
        To start from; None where nothing is known.
    """

    names: tuple[str, ...]
    size_px: tuple[int, int]
    focal_px: float | None


def solve_block(
    folder: Path,
    sensors: Sequence[Sensor],
    positions: Mapping[str, np.ndarray],
    work: Path,
    *,
    hold_focal: bool,
    say: Callable[[str], None],
) -> list[pycolmap.Reconstruction]:
    """Solve for poses and points, each block in a frame of its own; the largest block comes first.

    Parameters
    ----------
    folder : Path
        In which the images lie.
    sensors : of all images
    positions : mapping of name to (3,) [m]
        Of the cameras, in any one frame; they select the pairs to match. Images without one are paired with all.
    work : Path
        An empty folder for the database of features.
    hold_focal : bool
        Keep the focal lengths of the sensors.
    say : callable
        Called with a sentence on the progress.
    """
    colmap = _pycolmap()
    database, names = work / "database.db", sorted(name for sensor in sensors for name in sensor.names)
    colmap.set_random_seed(_SEED)
    colmap.Database.open(database).close()
    for sensor in sensors:
        # Before the features, so that images have the same numbers however threads take turns.
        colmap.import_images(database, folder, colmap.CameraMode.SINGLE, list(sensor.names), _reader(sensor))
    extraction = colmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu, extraction.max_image_size = _THREADS, False, _FEATURE_SIZE_PX
    say(f"structure from motion: features of {len(names)} images")
    colmap.extract_features(
        database, folder, names, colmap.CameraMode.AUTO, colmap.ImageReaderOptions(), extraction, colmap.Device.cpu
    )
    pairs = image_pairs(names, positions)
    say(f"structure from motion: matches of {len(pairs)} pairs")
    _match(database, pairs, work)
    return _map(database, folder, work, len(names), hold_focal, say)


def _pycolmap():
    import pycolmap

    pycolmap.logging.minloglevel = _ERRORS_ONLY
    return pycolmap


def _reader(sensor: Sensor) -> pycolmap.ImageReaderOptions:
    options = _pycolmap().ImageReaderOptions()
    options.camera_model = MODEL
    if sensor.focal_px is not None:
        width, height = sensor.size_px
        options.camera_params = f"{sensor.focal_px!r},{0.5 * width!r},{0.5 * height!r},0,0"
    return options


def image_pairs(names: Sequence[str], positions: Mapping[str, np.ndarray]) -> list[tuple[str, str]]:
    """Pairs of images that may overlap: all of a small survey, else neighbours by position."""
    if len(names) <= _ALL_PAIRS_UP_TO:
        return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    placed = [name for name in names if name in positions]
    points = np.array([positions[name][:2] for name in placed])
    _, nearest = cKDTree(points).query(points, k=min(_NEIGHBOURS + 1, len(placed)))
    pairs = {tuple(sorted((placed[i], placed[j]))) for i, row in enumerate(nearest) for j in row if i != j}
    lost = set(names) - set(placed)
    pairs |= {tuple(sorted((a, b))) for a in lost for b in names if a != b}
    return sorted(pairs)


def _match(database: Path, pairs: Sequence[tuple[str, str]], work: Path) -> None:
    colmap = _pycolmap()
    pairing, matching, verification = (
        colmap.ImportedPairingOptions(),
        colmap.FeatureMatchingOptions(),
        colmap.TwoViewGeometryOptions(),
    )
    pairing.match_list_path = work / "pairs.txt"
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    matching.num_threads, matching.use_gpu = _THREADS, False
    verification.ransac.random_seed = _SEED
    colmap.match_image_pairs(database, matching, pairing, verification, colmap.Device.cpu)


def _map(
    database: Path, folder: Path, work: Path, num: int, hold_focal: bool, say: Callable[[str], None]
) -> list[pycolmap.Reconstruction]:
    colmap = _pycolmap()
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = _THREADS, _SEED, _MIN_IMAGES
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not hold_focal
    options.extract_colors = False
    placed = Counter(images=2)

    def next_image() -> None:
        placed["images"] += 1
        if placed["images"] % max(5, num // 10) == 0:
            say(f"structure from motion: {placed['images']} of {num} images placed")

    say("structure from motion: poses")
    blocks = colmap.incremental_mapping(database, folder, work, options, next_image_callback=next_image)
    return sorted(blocks.values(), key=lambda block: (-block.num_reg_images(), -block.num_points3D()))


def focal_of(block: pycolmap.Reconstruction, name: str) -> float:
    """Focal length [px] of the camera of an image."""
    return float(block.camera(block.find_image_with_name(name).camera_id).focal_length)


def set_focal(block: pycolmap.Reconstruction, name: str, focal_px: float) -> None:
    """Give the camera of an image another focal length [px]."""
    block.camera(block.find_image_with_name(name).camera_id).focal_length = focal_px


def lens_of(block: pycolmap.Reconstruction, name: str) -> Lens:
    """The lens of the camera of an image."""
    camera = block.camera(block.find_image_with_name(name).camera_id)
    return Lens(camera.model_name, tuple(float(p) for p in camera.params), camera.width, camera.height)


def transform(block: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Take a block to another frame; in place."""
    colmap = _pycolmap()
    rotation = colmap.Rotation3d(similarity.rotation)
    block.transform(colmap.Sim3d(similarity.scale, rotation, similarity.shift))


def points_of(block: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) in the frame of the block, the number of images (N,) that see each, and errors (N,) [px]."""
    points = [block.points3D[number] for number in sorted(block.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    num_views = np.array([point.track.length() for point in points], dtype=np.int64)
    return xyz, num_views, np.array([point.error for point in points], dtype=np.float64)


def copy_of(block: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A deep copy of a block."""
    return _pycolmap().Reconstruction(block)


def write_block(block: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a block as a binary COLMAP model into an existing folder."""
    block.write_binary(folder)


def read_block(folder: Path) -> pycolmap.Reconstruction:
    """A block that `write_block` wrote, to the last bit."""
    return _pycolmap().Reconstruction(folder)


def poses_of(block: pycolmap.Reconstruction) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Camera centres (3,) and rotations (3, 3) from the frame of the block to cam, by name, in order of names."""
    images = sorted((image for image in block.images.values() if image.has_pose), key=lambda image: image.name)
    return {image.name: (image.projection_center(), image.cam_from_world().rotation.matrix()) for image in images}


def adjust(
    block: pycolmap.Reconstruction,
    positions: Mapping[str, np.ndarray],
    std: np.ndarray,
    *,
    hold_focal: bool,
) -> None:
    """Adjust poses, points and lenses of a block to its matches and to GPS positions; in place.

    Parameters
    ----------
    block : pycolmap.Reconstruction
        Already near its place in local.
    positions : mapping of name to (3,) [m], local
        Free of outliers: they enter by their squares.
    std : (3,) [m], local
        Standard deviation of a position, against 1 px for a match.
    hold_focal : bool
        Keep the focal lengths.

    Raises
    ------
    RuntimeError
        If the adjustment gives no usable solution.
    """
    colmap = _pycolmap()
    options, config = colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
    options.refine_focal_length, options.print_summary = not hold_focal, False
    options.ceres.loss_function_type = colmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = _THREADS
    options.ceres.solver_options.max_num_iterations = 200
    priors = []
    for image in block.images.values():
        if not image.has_pose:
            continue
        config.add_image(image.image_id)
        if image.name in positions:
            priors.append(_prior(image, positions[image.name], std))
    prior_options = colmap.PosePriorBundleAdjustmentOptions()
    # pycolmap first fits a similarity of its own; ours has already removed the outliers.
    distances = [np.linalg.norm(poses_of(block)[name][0] - p) for name, p in positions.items()]
    prior_options.alignment_ransac.max_error = 2.0 * max(distances) + 1.0
    prior_options.alignment_ransac.random_seed = _SEED
    adjuster = colmap.create_pose_prior_bundle_adjuster(options, prior_options, config, priors, block)
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise RuntimeError(f"the bundle adjustment ended with {summary.termination_type}")
    block.update_point_3d_errors()


def _prior(image: pycolmap.Image, position: np.ndarray, std: np.ndarray) -> pycolmap.PosePrior:
    colmap = _pycolmap()
    prior = colmap.PosePrior()
    prior.pose_prior_id, prior.corr_data_id = image.image_id, image.data_id
    prior.position, prior.position_covariance = position, np.diag(np.square(std))
    prior.coordinate_system = colmap.PosePriorCoordinateSystem.CARTESIAN
    return prior
