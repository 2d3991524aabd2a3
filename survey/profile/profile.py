"""Heights of the bed, the water and a reference along lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.spatial import cKDTree

from evaluation import vertical_difference
from geo import Cloud, Mesh, read_cloud
from geo.crs import has_height, height_unit_m
from geo.lines import Line
from geo.projection import ground_units_m
from geo.shapes import in_height_unit, left_out, part_of
from survey.compare.inputs import InputPaths, load_inputs
from survey.errors import SurveyError
from survey.export.bed_cells import LevelFit
from survey.run.folder import RunDir

# A height is the median of the points within so many spacings of its place.
_SPACINGS = 2.0
# Between places along a line, where no distance is asked for, in spacings; at most so many places.
_STEP_SPACINGS, _MOST_PLACES = 4.0, 200_000
# Points whose neighbours tell the spacing.
_SAMPLE = 2000


class ProfileError(SurveyError):
    """A profile that cannot be computed."""


@dataclass(frozen=True)
class Profile:
    """Heights along a line; arrays are over its places, NaN where nothing is known.

    Attributes
    ----------
    name : str
    crs : pyproj.CRS
        Of places and heights.
    distance : (K,) [m]
        From the start of the line.
    places : (K, 2), in crs
    bed : (K,), in the heights of crs
        Median of the points near the place.
    std, std_common : (K,) [m]
        Of a point there by errors of its own, and of what all heights have in common; NaN where the cloud has none.
    num_points : (K,) int
    water, reference : (K,), in the heights of crs
        NaN for a dry survey, and without a reference.
    """

    name: str
    crs: CRS
    distance: np.ndarray
    places: np.ndarray
    bed: np.ndarray
    std: np.ndarray
    std_common: np.ndarray
    num_points: np.ndarray
    water: np.ndarray
    reference: np.ndarray

    @property
    def depth(self) -> np.ndarray:
        """Depth of the bed below the water (K,) [m], negative above it."""
        return (self.water - self.bed) * height_unit_m(self.crs)

    @property
    def error(self) -> np.ndarray:
        """Bed above the reference (K,) [m]."""
        return (self.bed - self.reference) * height_unit_m(self.crs)


class Bed:
    """A cloud of the bed, looked up by place, and the reference beside it.

    Parameters
    ----------
    path : Path
        Run folder, LAS, LAZ or COPC with a CRS.
    reference : Path, optional
        Mesh or cloud in the same CRS.

    Raises
    ------
    GeoError, SurveyError
        If a file cannot be read, or is of another place.
    """

    def __init__(self, path: Path, reference: Path | None = None):
        run = RunDir(path)
        if path.is_dir():
            run.require_run()
        file = run.cloud_path if path.is_dir() else path
        self._reference: Mesh | Cloud | None = None
        if reference is None:
            cloud = read_cloud(file)
            out, said = left_out(cloud)
            if out.all():
                raise ProfileError(f"no point of {file} is of the ground: it holds {said}")
            self._cloud = part_of(cloud, ~out)
            crs = cloud.crs
        else:
            inputs = load_inputs(InputPaths(file, reference), None)
            self._cloud, self._reference, crs = part_of(inputs.cloud, inputs.inside), inputs.reference, inputs.crs
        if crs is None:
            raise ProfileError(f"{file} does not say its CRS, in which lines are looked up; give a run folder")
        self.crs = crs if has_height(crs) else crs.to_3d()
        # A file alone may give its heights in another unit than metres beside its CRS.
        shape = in_height_unit(self._cloud, height_unit_m(self.crs))
        self._cloud = shape if isinstance(shape, Cloud) else self._cloud
        self._middle = self._cloud.points[:, :2].mean(axis=0)
        self._metres = ground_units_m(self.crs, self._middle)
        self._tree = cKDTree(self._plan(self._cloud.points[:, :2]))

    def _plan(self, places: np.ndarray) -> np.ndarray:
        """Places (N, 2) in metres on the ground from the middle of the cloud."""
        return (places - self._middle) * self._metres

    @cached_property
    def spacing_m(self) -> float:
        """Distance of neighbouring points [m], median."""
        some = self._tree.data[:: len(self._tree.data) // _SAMPLE + 1]
        nearest = self._tree.query(some, k=2)[0][:, 1] if self._tree.n > 1 else np.array([np.inf])
        spacing = float(np.median(nearest[nearest > 0.0])) if (nearest > 0.0).any() else np.inf
        if not np.isfinite(spacing):
            raise ProfileError("the cloud has a single place, expected a bed to look along")
        return spacing

    @cached_property
    def _level(self) -> LevelFit | None:
        depth = self._cloud.extra.get("depth")
        points = self._cloud.points * [1.0, 1.0, height_unit_m(self.crs)]
        return None if depth is None else LevelFit.of(points, np.asarray(depth, dtype=np.float64))

    def along(self, line: Line, step_m: float | None = None) -> Profile:
        """The profile of a line, at places ``step_m`` apart; by default some spacings of the points."""
        corners = self._plan(line.corners)
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        if not lengths[-1] > 0.0:
            raise ProfileError(f"the line {line.name} has no length, expected two places at least")
        step = step_m if step_m is not None else max(_STEP_SPACINGS * self.spacing_m, lengths[-1] / _MOST_PLACES)
        if not step > 0.0 or lengths[-1] / step > _MOST_PLACES:
            raise ProfileError(
                f"a step of {step:g} m along the {lengths[-1]:.0f} m of the line {line.name} is too small; give more"
            )
        # The last place is the end of the line.
        distance = np.append(np.arange(0.0, lengths[-1] - 1e-9 * step, step), lengths[-1])
        plan = np.column_stack([np.interp(distance, lengths, corner) for corner in corners.T])
        places = plan / self._metres + self._middle
        rows = self._tree.query_ball_point(plan, _SPACINGS * self.spacing_m)
        water = np.full(len(places), np.nan) if self._level is None else self._level(places)
        profile = Profile(
            name=line.name,
            crs=self.crs,
            distance=distance,
            places=places,
            bed=_medians(self._cloud.points[:, 2], rows),
            std=_medians(self._cloud.extra.get("std"), rows),
            std_common=_medians(self._cloud.extra.get("std_common"), rows),
            num_points=np.array([len(near) for near in rows]),
            water=water / height_unit_m(self.crs),
            reference=np.full(len(places), np.nan),
        )
        return profile if self._reference is None else replace(profile, reference=self._heights(profile, plan))

    def _heights(self, profile: Profile, plan: np.ndarray) -> np.ndarray:
        """Heights of the reference (K,) at the places of a profile: of a mesh where it is, of points their median."""
        shape = self._reference
        if isinstance(shape, Cloud):
            tree = cKDTree(self._plan(shape.points[:, :2]))
            near = tree.query_ball_point(plan, _SPACINGS * self.spacing_m)
            return _medians(shape.points[:, 2], near)
        if shape is None:
            return np.full(len(plan), np.nan)
        unit_m = height_unit_m(self.crs)
        # Where a mesh has several heights, that near the bed counts.
        near_bed = np.where(np.isfinite(profile.bed), profile.bed, np.nanmedian(self._cloud.points[:, 2]))
        vertices = np.column_stack([self._plan(shape.vertices[:, :2]), shape.vertices[:, 2] * unit_m])
        above = vertical_difference(np.column_stack([plan, near_bed * unit_m]), vertices, shape.faces)
        return near_bed - above / unit_m


def _medians(values: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    """Median of the values in each list of rows (K,); NaN where there is none."""
    if values is None:
        return np.full(len(rows), np.nan)
    found = [values[near] for near in rows]
    return np.array([np.nan if not np.isfinite(some).any() else float(np.nanmedian(some)) for some in found])
