"""A reference beside the cloud: how far points are from it, and its heights along a line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo import Cloud, Mesh, read_reference, require_same_crs, require_same_place
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import in_height_unit, left_out, part_of, vertices_of
from survey.errors import SurveyError


@dataclass(frozen=True)
class Reference:
    """A mesh, or a cloud, in the local frame of a run.

    Attributes
    ----------
    path : Path
    points : (V, 3) float64 [m], local
        Vertices, or points.
    faces : (F, 3) int or None
        None of a cloud.
    """

    path: Path
    points: np.ndarray
    faces: np.ndarray | None

    def errors(self, points: np.ndarray) -> np.ndarray:
        """How far points (N, 3), local, are above it (N,) [m]: as `bathynerf compare` measures, nothing aligned."""
        # Imported where they are needed: they take a second, and most runs are shown without a reference.
        from evaluation import distance_to_mesh, local_surface

        if self.faces is not None:
            return distance_to_mesh(points, self.points, self.faces).signed
        return points[:, 2] - local_surface(self.points, points[:, :2]).height

    def heights(self, places: np.ndarray) -> np.ndarray:
        """Its heights (K,) [m] at places (K, 3), local; of several those nearest to the places; NaN where none is."""
        from evaluation import local_surface, vertical_difference

        if self.faces is not None:
            return places[:, 2] - vertical_difference(places, self.points, self.faces)
        return local_surface(self.points, places[:, :2]).height


def load_reference(path: Path, frame: LocalFrame, cloud_crs: np.ndarray) -> Reference:
    """The reference in a file.

    Parameters
    ----------
    path : Path
        Mesh, GeoTIFF or points in the CRS of the run, or without a CRS.
    frame : LocalFrame
        Of the run.
    cloud_crs : (N, 3), in crs
        Some points of the run, near which it has to lie.

    Raises
    ------
    GeoError, SurveyError
        If it cannot be read, is in another CRS or place, or no point of it is of the ground.
    """
    from evaluation import weld

    shape: Mesh | Cloud = read_reference(path)
    require_same_crs(frame.crs, shape.crs, "the run", str(path))
    shape = in_height_unit(shape, height_unit_m(frame.crs))
    require_same_place(cloud_crs, vertices_of(shape), "the run", str(path))
    if isinstance(shape, Mesh):
        vertices, faces = weld(shape.vertices, shape.faces)
        return Reference(path, frame.local_from_crs(vertices), faces)
    out, said = left_out(shape)
    if out.all():
        raise SurveyError(f"no point of {path} is of the ground: it holds {said}")
    return Reference(path, frame.local_from_crs(part_of(shape, ~out).points), None)
