"""Accuracy measures of clouds and images: numpy arrays in, numbers out, no files.

| measure | files |
|---|---|
| signed distance to a mesh (C2M), **positive above the mesh** | `c2m` |
| vertical difference, positive above the mesh; share of errors within 1.96 std | `vertical` |
| height over a reference of points, with its uncertainty; M3C2, positive above the reference | `local_surface` |
| distance to a cloud, completeness, F-score, statistical outliers | `completeness` |
| bias, spread and scores, also of parts as by depth; Huber's weights | `summary`; by blocks: `bootstrap` |
| IHO S-44 and ASPRS | `standards` |
| what straight rays would give | `baselines` |
| quality of images | `images` |
"""

# Part of bathynerf.

from evaluation.baselines import apparent_points, per_camera, times_index
from evaluation.bootstrap import Blocks, mean_interval, spatial_blocks
from evaluation.c2m import MeshDistances, distance_to_mesh, weld
from evaluation.completeness import distance_to_cloud, f_score, is_outlier, is_reached, sample_mesh
from evaluation.images import image_quality, psnr, ssim
from evaluation.local_surface import LocalSurface, M3C2Distances, local_surface, m3c2_distances
from evaluation.standards import AsprsAccuracy, IhoS44, asprs_vertical, iho_s44
from evaluation.summary import (
    Band,
    DepthParts,
    DistanceStatistics,
    ReachedBand,
    Scores,
    by_band,
    by_depth,
    distance_statistics,
    reached_by_slope,
    scores,
)
from evaluation.vertical import Coverage, coverage_by_class, height_at, slope_below, vertical_difference

__all__ = [
    "AsprsAccuracy",
    "Band",
    "Blocks",
    "Coverage",
    "DepthParts",
    "DistanceStatistics",
    "IhoS44",
    "LocalSurface",
    "M3C2Distances",
    "MeshDistances",
    "ReachedBand",
    "Scores",
    "apparent_points",
    "asprs_vertical",
    "by_band",
    "by_depth",
    "coverage_by_class",
    "distance_statistics",
    "distance_to_cloud",
    "distance_to_mesh",
    "f_score",
    "height_at",
    "iho_s44",
    "image_quality",
    "is_outlier",
    "is_reached",
    "local_surface",
    "m3c2_distances",
    "mean_interval",
    "per_camera",
    "psnr",
    "reached_by_slope",
    "sample_mesh",
    "scores",
    "slope_below",
    "spatial_blocks",
    "ssim",
    "times_index",
    "vertical_difference",
    "weld",
]
