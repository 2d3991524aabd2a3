"""Blocks of photographs by pycolmap: poses and points that mapping makes of verified matches.

COLMAP's pipeline solves bundle adjustments of more than 1,000 images by conjugate gradients, and has no setting for
another solver: of 2,080 images it did not end in 27 minutes (docs/decisions.md). Larger blocks are therefore built
here from the steps of its mapper (J. Schoenberger and J.-M. Frahm, Structure-from-motion revisited, 2016), with sparse
Cholesky factors at every size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.frames import Similarity
from refract.lens import Lens
from survey.photos.poses import TiePoints, least_track
from survey.progress import current
from survey.sfm.features import SEED, MatchedPhotographs, solver

if TYPE_CHECKING:
    import pycolmap

# More threads would be faster; with two, most repeated runs of a block agree in all significant digits.
_THREADS = 2
# Images of a block, at least, but for those of two photographs.
_MIN_IMAGES = 3
# Up to so many images COLMAP's pipeline has direct solvers.
DIRECT_UP_TO = 1000
# All images are adjusted whenever their number, or that of the points, has grown by this factor.
_GROWN = 1.3
# Of two photographs: the least angle [deg] at which their rays meet, and the least number of matches, to start from.
_PAIR_ANGLE_DEG, _PAIR_MATCHES = 1.0, 30
# Factors on the least number of matches and on the least angle of the initial pair, tried in turn, as by COLMAP.
_INITIAL_PAIR_FACTORS = ((1.0, 1.0), (0.5, 1.0), (0.5, 0.5), (0.25, 0.5), (0.25, 0.25))
# Images that are tried as the third before other two are.
_TRIED_AS_THIRD = 30


def camera_of(block: pycolmap.Reconstruction, name: str) -> pycolmap.Camera:
    """The camera of an image, whose parameters may be set."""
    return block.camera(block.find_image_with_name(name).camera_id)


def lens_of(block: pycolmap.Reconstruction, name: str) -> Lens:
    camera = camera_of(block, name)
    return Lens(camera.model_name, tuple(float(p) for p in camera.params), camera.width, camera.height)


def transform(block: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Transform a block into another frame; in place."""
    colmap = solver()
    rotation = colmap.Rotation3d(similarity.rotation)
    block.transform(colmap.Sim3d(similarity.scale, rotation, similarity.shift))


def adjust_with_focals(block: pycolmap.Reconstruction) -> None:
    """Adjust a block with its focal lengths as they are; in place."""
    options = solver().BundleAdjustmentOptions()
    options.refine_focal_length, options.print_summary = False, False
    options.ceres.solver_options.num_threads = _THREADS
    solver().bundle_adjustment(block, options)


def points_of(block: pycolmap.Reconstruction) -> np.ndarray:
    """Points (N, 3) in the frame of the block."""
    return np.array([block.points3D[number].xyz for number in sorted(block.points3D)]).reshape(-1, 3)


def tracks_of(block: pycolmap.Reconstruction, names: Sequence[str]) -> TiePoints:
    """Points that three photographs or more see, of two both, and where; views are numbered as in `names`."""
    least, at = least_track(len(names)), {name: k for k, name in enumerate(names)}
    number = {image.image_id: at[image.name] for image in block.images.values() if image.has_pose}
    start: list[np.ndarray] = []
    rows: list[tuple[int, int, np.ndarray]] = []
    # Numbers of points differ from run to run: in the order of their tracks.
    tracks = {
        tuple(sorted((number[e.image_id], e.image_id, e.point2D_idx) for e in point.track.elements)): point.xyz
        for point in block.points3D.values()
    }
    for track, place in sorted(tracks.items(), key=lambda item: item[0]):
        # A photograph may show a point twice, where two of its features were taken for one.
        seen = {view: block.images[image].points2D[feature].xy for view, image, feature in track}
        if len(seen) >= least:
            rows += [(len(start), view, xy) for view, xy in seen.items()]
            start.append(place)
    numbers = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2)
    pixel = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 2)
    numbered, view = numbers.T
    return TiePoints(np.array(start, dtype=np.float64).reshape(-1, 3), numbered, view, pixel, least)


def poses_of(block: pycolmap.Reconstruction) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Camera centres (3,) and rotations (3, 3) from the frame of the block to cam, by name, in order of names."""
    images = sorted((image for image in block.images.values() if image.has_pose), key=lambda image: image.name)
    return {image.name: (image.projection_center(), image.cam_from_world().rotation.matrix()) for image in images}


def reconstruct(matched: MatchedPhotographs, *, direct_up_to: int = DIRECT_UP_TO) -> list[pycolmap.Reconstruction]:
    """Reconstructions of poses and points, each in a frame of its own; the largest first."""
    options = pipeline_options(matched.num)
    with current().stage("Structure from motion", matched.num) as step:
        # The first two come together.
        step.advance(2.0)
        if matched.num > direct_up_to:
            blocks = map_directly(matched.database, options, step.advance)
        else:
            folders = matched.database, matched.folder, matched.work
            blocks = [*solver().incremental_mapping(*folders, options, next_image_callback=step.advance).values()]
    return sorted(blocks, key=lambda block: (-block.num_reg_images(), -block.num_points3D()))


def pipeline_options(num: int) -> pycolmap.IncrementalPipelineOptions:
    """Options of COLMAP's pipeline for a number of images."""
    options = solver().IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = _THREADS, SEED, _MIN_IMAGES
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWN
    options.mapper.ba_global_ignore_redundant_points3D = True
    options.extract_colors = False
    if num == 2:
        # Over flat ground two do not determine their focal length, which is held.
        options.min_model_size = 2
        options.ba_refine_focal_length = False
        options.mapper.init_min_tri_angle = options.mapper.filter_min_tri_angle = _PAIR_ANGLE_DEG
        options.mapper.init_min_num_inliers = _PAIR_MATCHES
        options.triangulation.min_angle = _PAIR_ANGLE_DEG
        options.triangulation.ignore_two_view_tracks = False
    return options


def map_directly(
    database: Path, options: pycolmap.IncrementalPipelineOptions, advance: Callable[[], None]
) -> list[pycolmap.Reconstruction]:
    """Blocks by incremental mapping whose bundle adjustments have direct solvers.

    ``advance`` is called whenever an image is added.
    """
    colmap, cache_options = solver(), solver().DatabaseCacheOptions()
    cache_options.min_num_matches = options.min_num_matches
    with colmap.Database.open(database) as opened:
        cache = colmap.DatabaseCache.create(opened, cache_options)
    reconstruction = _IncrementalReconstruction(cache, options, advance)
    settings = options.get_mapper()
    matches, angle = settings.init_min_num_inliers, settings.init_min_tri_angle
    for of_matches, of_angle in _INITIAL_PAIR_FACTORS:
        settings.init_min_num_inliers, settings.init_min_tri_angle = int(of_matches * matches), of_angle * angle
        reconstruction.mapper.reset_initialization_stats()
        blocks = list(reconstruction.blocks(settings))
        if blocks:
            return blocks
    return []


class _IncrementalReconstruction:
    """Reconstruction of blocks, image by image."""

    def __init__(
        self,
        cache: pycolmap.DatabaseCache,
        options: pycolmap.IncrementalPipelineOptions,
        advance: Callable[[], None],
    ):
        self.mapper = solver().IncrementalMapper(cache)
        self._pipeline = solver().IncrementalPipeline(options, cache, solver().ReconstructionManager())
        self._options, self._advance, self._num_images = options, advance, cache.num_images()
        self._triangulation = options.get_triangulation()

    def blocks(self, settings: pycolmap.IncrementalMapperOptions) -> Iterator[pycolmap.Reconstruction]:
        """Blocks until all images are in one, or no two images are left to start from."""
        status, mapper = solver().IncrementalPipelineStatus, self.mapper
        for _ in range(self._options.max_num_models):
            block = solver().Reconstruction()
            mapper.begin_reconstruction(block)
            begun = self._pipeline.initialize_reconstruction(mapper, settings, block)
            if begun == status.NO_INITIAL_PAIR:
                mapper.end_reconstruction(True)
                return
            if begun != status.BAD_INITIAL_PAIR:
                self._grow(block, settings)
            is_block = block.num_reg_images() >= self._options.min_model_size
            mapper.end_reconstruction(not is_block)
            if is_block:
                yield block
            if mapper.num_total_reg_images() >= self._num_images - 1:
                return

    def _grow(self, block: pycolmap.Reconstruction, settings: pycolmap.IncrementalMapperOptions) -> None:
        """Add images while any can be added to a block, or could before all were adjusted."""
        options, mapper = self._options, self.mapper
        sizes = block.num_reg_images(), block.num_points3D()
        is_added = was_added = True
        while is_added or was_added:
            was_added, image = is_added, self._add(block, settings)
            is_added = image is not None
            if image is not None:
                mapper.triangulate_image(self._triangulation, image)
                mapper.iterative_local_refinement(
                    options.ba_local_max_refinements, options.ba_local_max_refinement_change, settings,
                    options.get_local_bundle_adjustment(), self._triangulation, image,
                )  # fmt: skip
                self._advance()
            if mapper.num_shared_reg_images() >= options.max_model_overlap:
                break
            if self._pipeline.check_run_global_refinement(block, *sizes) or (was_added and not is_added):
                self._adjust(settings)
                sizes = block.num_reg_images(), block.num_points3D()
        if block.num_reg_images() != sizes[0]:
            self._adjust(settings)

    def _add(self, block: pycolmap.Reconstruction, settings: pycolmap.IncrementalMapperOptions) -> int | None:
        """Number of an image that was added to the block, by its points or else by other images; None if none was."""
        mapper = self.mapper
        registrations = (mapper.register_next_image, mapper.register_next_structure_less_image)
        for without_points, register in enumerate(registrations):
            for trial, image in enumerate(mapper.find_next_images(settings, bool(without_points))):
                if register(settings, image):
                    return image
                if trial >= _TRIED_AS_THIRD and block.num_reg_images() < self._options.min_model_size:
                    break
        return None

    def _adjust(self, settings: pycolmap.IncrementalMapperOptions) -> None:
        """Bundle adjustment of all images, with a direct solver at every size, and tracks completed and filtered."""
        adjustment = self._options.get_global_bundle_adjustment()
        adjustment.ceres.max_num_images_direct_sparse_cpu_solver = max(self._num_images, DIRECT_UP_TO)
        self.mapper.iterative_global_refinement(
            self._options.ba_global_max_refinements, self._options.ba_global_max_refinement_change, settings,
            adjustment, self._triangulation,
        )  # fmt: skip
