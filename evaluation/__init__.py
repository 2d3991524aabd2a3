"""Accuracy measures of clouds and images: numpy arrays in, numbers out, no files.

| measure | files |
|---|---|
| signed distance to a mesh (C2M), **positive above the mesh**; completeness, statistical outliers | `c2m` |
| height over a mesh or a cloud, positive above it; height of a cloud at places; M3C2 | `vertical` |
| bias, spread and scores, also of parts as by depth; Huber's weights | `summary`; by blocks: `bootstrap` |
| IHO S-44 and ASPRS | `standards` |
| quality of images | `images` |
"""

# Part of bathynerf.

from evaluation.bootstrap import Blocks, mean_interval, spatial_blocks
from evaluation.c2m import distance_to_cloud, distance_to_mesh, f_score, is_outlier, is_reached, sample_mesh, weld
from evaluation.images import image_quality, psnr, ssim
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
from evaluation.vertical import LocalSurface, height_at, local_surface, m3c2_distances, vertical_difference
