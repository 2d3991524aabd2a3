"""Incremental mapping by pycolmap: images are added to a block one by one.

COLMAP's pipeline solves bundle adjustments of more than 1,000 images by conjugate gradients, and has no setting for
another solver: of 2,080 images it did not end in 27 minutes (docs/decisions.md). Larger blocks are therefore built
here from the steps of its mapper (J. Schoenberger and J.-M. Frahm, Structure-from-motion revisited, 2016), with sparse
Cholesky factors at every size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from survey.sfm.settings import MIN_IMAGES, SEED, THREADS, solver

if TYPE_CHECKING:
    import pycolmap

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


def pipeline_options(num: int) -> pycolmap.IncrementalPipelineOptions:
    """Options of COLMAP's pipeline for a number of images."""
    options = solver().IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = THREADS, SEED, MIN_IMAGES
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWN
    options.mapper.ba_global_ignore_redundant_points3D = True
    options.extract_colors = False
    if num == 2:
        _for_a_pair(options)
    return options


def _for_a_pair(options: pycolmap.IncrementalPipelineOptions) -> None:
    """Allow a block of two photographs; over flat ground they do not determine their focal length, which is held."""
    options.min_model_size = 2
    options.ba_refine_focal_length = False
    options.mapper.init_min_tri_angle = options.mapper.filter_min_tri_angle = _PAIR_ANGLE_DEG
    options.mapper.init_min_num_inliers = _PAIR_MATCHES
    options.triangulation.min_angle = _PAIR_ANGLE_DEG
    options.triangulation.ignore_two_view_tracks = False


def map_directly(
    database: Path, options: pycolmap.IncrementalPipelineOptions, advance: Callable[[], None]
) -> list[pycolmap.Reconstruction]:
    """Blocks by incremental mapping whose bundle adjustments have direct solvers.

    Parameters
    ----------
    database : Path
        With verified matches.
    advance : callable
        Called whenever an image is added.
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
    """Reconstruction of blocks, image by image.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    options : pycolmap.IncrementalPipelineOptions
    advance : callable
        Called whenever an image is added.
    """

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
