"""Mapping: poses and points from verified matches, by one of pycolmap's three mappers.

Why incremental mapping is used where none is set: `survey.sfm.settings.mapper_of`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from survey.progress import current
from survey.sfm.settings import solver
from survey.words import Mapper

if TYPE_CHECKING:
    import pycolmap

# More threads would be faster; with two, repeated runs agree in all significant digits.
_THREADS = 2
SEED = 0
# All images are adjusted whenever their number, or that of the points, has grown by this factor.
_GROWN = 1.3
_MIN_IMAGES = 3
# Mappers that do not tell their progress.
UNTOLD = (Mapper.hierarchical, Mapper.global_)
# Of two photographs: the least angle [deg] at which their rays meet, and the least number of matches, to start from.
_PAIR_ANGLE_DEG, _PAIR_MATCHES = 1.0, 30


@dataclass(frozen=True)
class Matched:
    """Photographs with verified matches."""

    database: Path
    folder: Path  # In which the images lie
    work: Path  # For files of the mapper
    num: int  # Of images


def mapped(matched: Matched, mapper: str) -> list[pycolmap.Reconstruction]:
    """Blocks of poses and points, each in a frame of its own; the largest comes first."""
    run = {Mapper.global_: _global, Mapper.hierarchical: _hierarchical}.get(Mapper(mapper), _incremental)
    with current().stage("Structure from motion", matched.num) as step:
        blocks = run(matched, step.advance)
    return sorted(blocks.values(), key=lambda block: (-block.num_reg_images(), -block.num_points3D()))


def _incremental(matched: Matched, advance: Callable[..., None]) -> dict[int, pycolmap.Reconstruction]:
    options = _incremental_options()
    if matched.num == 2:
        _for_a_pair(options)
    # The first two come together.
    advance(2.0)
    return solver().incremental_mapping(
        matched.database, matched.folder, matched.work, options, next_image_callback=advance
    )


def _incremental_options() -> pycolmap.IncrementalPipelineOptions:
    options = solver().IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = _THREADS, SEED, _MIN_IMAGES
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWN
    options.mapper.ba_global_ignore_redundant_points3D = True
    options.extract_colors = False
    return options


def _for_a_pair(options: pycolmap.IncrementalPipelineOptions) -> None:
    """Let two photographs alone make a block; over flat ground they do not tell their focal length, which stays."""
    options.min_model_size = 2
    options.ba_refine_focal_length = False
    options.mapper.init_min_tri_angle = options.mapper.filter_min_tri_angle = _PAIR_ANGLE_DEG
    options.mapper.init_min_num_inliers = _PAIR_MATCHES
    options.triangulation.min_angle = _PAIR_ANGLE_DEG
    options.triangulation.ignore_two_view_tracks = False


def _hierarchical(matched: Matched, _advance: Callable[..., None]) -> dict[int, pycolmap.Reconstruction]:
    options = solver().HierarchicalPipelineOptions()
    options.num_threads, options.num_workers = _THREADS, 1
    options.incremental_options = _incremental_options()
    return solver().hierarchical_mapping(matched.database, matched.folder, matched.work, options)


def _global(matched: Matched, _advance: Callable[..., None]) -> dict[int, pycolmap.Reconstruction]:
    options = solver().GlobalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = _THREADS, SEED, _MIN_IMAGES
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    return solver().global_mapping(matched.database, matched.folder, matched.work, options)
