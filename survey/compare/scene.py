"""Cloud, reference and visible points of a comparison, in one local frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evaluation import sample_mesh
from evaluation.completeness import NUM_SAMPLES
from geo import Cloud, Mesh
from geo.shapes import left_out, vertices_of
from survey.compare.area import Bounds, metres_in_crs, to_local, within
from survey.compare.inputs import Inputs


@dataclass(frozen=True)
class Scene:
    """What is compared, local [m].

    Attributes
    ----------
    inputs : Inputs
    bounds : (E0, N0, E1, N1) or None, in crs
    around : (A,) int
        Numbers in the file of the points within the bounds and the largest tolerance more.
    cloud : (A, 3)
        Those points.
    points : (N, 3)
        Those of them that are within the bounds: the compared points.
    reference : (V, 3)
        Vertices, or points.
    samples, targets : (K, 3), (M, 3)
        Points that a complete cloud would reach: of the reference, and those that cameras see, if known.
    """

    inputs: Inputs
    bounds: Bounds | None
    around: np.ndarray
    cloud: np.ndarray
    points: np.ndarray
    reference: np.ndarray
    samples: np.ndarray
    targets: np.ndarray

    @staticmethod
    def of(inputs: Inputs, bounds: Bounds | None, is_left: np.ndarray, largest_m: float) -> Scene:
        """Bring the points that are left (N,) bool, the reference and the visible points into the local frame."""
        near = within(inputs.cloud.points, bounds, metres_in_crs(inputs.frame, largest_m))
        around = near & is_left & ~left_out(inputs.cloud)[0]
        cloud = to_local(inputs.frame, inputs.cloud.points[around], inputs.paths.cloud)
        reference = to_local(inputs.frame, vertices_of(inputs.reference), inputs.paths.reference)
        samples = targets = _samples(reference, inputs.reference)
        if inputs.visible is not None and inputs.paths.visible is not None:
            visible = to_local(inputs.frame, vertices_of(inputs.visible), inputs.paths.visible)
            targets = _samples(visible, inputs.visible)
        points = cloud[inputs.inside[around]]
        return Scene(inputs, bounds, np.flatnonzero(around), cloud, points, reference, samples, targets)

    def extra(self, names: tuple[str, ...]) -> np.ndarray | None:
        """Values (N,) of the compared points that the cloud has under one of the names, else None."""
        name = next((name for name in names if name in self.inputs.cloud.extra), None)
        if name is None:
            return None
        return np.asarray(self.inputs.cloud.extra[name], dtype=np.float64)[self.inputs.inside]


def _samples(vertices: np.ndarray, shape: Mesh | Cloud) -> np.ndarray:
    """Points (M, 3) spread over a mesh by area; all points of a cloud."""
    return sample_mesh(vertices, shape.faces, NUM_SAMPLES) if isinstance(shape, Mesh) else vertices
