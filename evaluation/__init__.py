"""How far a result is from the truth: numpy arrays in, numbers out, no files."""

from evaluation.c2m import MeshDistances, distance_to_mesh
from evaluation.completeness import distance_to_cloud, f_score, is_reached, sample_mesh
from evaluation.summary import by_depth, distance_statistics, summarise
from evaluation.triangles import weld

__all__ = [
    "MeshDistances",
    "by_depth",
    "distance_statistics",
    "distance_to_cloud",
    "distance_to_mesh",
    "f_score",
    "is_reached",
    "sample_mesh",
    "summarise",
    "weld",
]
