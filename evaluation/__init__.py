"""How far a result is from the truth: numpy arrays in, numbers out, no files."""

from evaluation.bootstrap import Blocks, mean_interval, spatial_blocks
from evaluation.c2m import MeshDistances, distance_to_mesh
from evaluation.completeness import distance_to_cloud, f_score, is_reached, sample_mesh
from evaluation.strata import by_band, by_depth
from evaluation.summary import distance_statistics, scores, summarise
from evaluation.triangles import weld

__all__ = [
    "Blocks",
    "MeshDistances",
    "by_band",
    "by_depth",
    "distance_statistics",
    "distance_to_cloud",
    "distance_to_mesh",
    "f_score",
    "is_reached",
    "mean_interval",
    "sample_mesh",
    "scores",
    "spatial_blocks",
    "summarise",
    "weld",
]
