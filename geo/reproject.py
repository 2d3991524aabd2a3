"""Reprojection of points from the CRS of a survey into another.

Horizontal coordinates are transformed by PROJ, heights stay as they are where both systems count them from the same
datum; between two vertical datums the grid of one of them is needed, and without it an error is raised.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from geo.antimeridian import crosses
from geo.area_of_use import require_in_area
from geo.crs import crs_of, has_height, horizontal_crs, is_geographic, parse_crs, vertical_crs
from geo.errors import UnknownCRS, UnsupportedCRS
from geo.projection import nan_unless_finite
from geo.transformation import Transformation, best_operation

_MEND = "or name a horizontal CRS alone, which keeps the heights as they are."


@dataclass(frozen=True)
class Reprojection:
    """Transformation from one CRS with heights to another."""

    crs: CRS  # In which points come out, with a vertical part
    keeps_height: bool  # Whether heights stay as they are
    _transformer: Transformer = field(repr=False, compare=False)
    _changes_plan: bool = field(repr=False, compare=False)
    _where: str = field(repr=False, compare=False)
    doubt: str | None = None  # a sentence, or None: where places or heights are less well known in it, as PROJ states

    @staticmethod
    def between(
        source: CRS, target: str | CRS, *, where: str = "crs", places: np.ndarray | None = None
    ) -> Reprojection:
        """Transformation from a CRS with heights to one with heights, or to a horizontal one, which keeps the heights.

        Parameters
        ----------
        target : str or pyproj.CRS
            EPSG code, WKT or PROJ string, e.g. "EPSG:32632" or "EPSG:4326+5773".
        where : str
            What errors name.
        places : (N, 2 or 3), optional
            In the source, of the survey: which of regional operations it is.

        Raises
        ------
        UnknownCRS, UnsupportedCRS
            If PROJ does not know the target, or it does not suit a survey; see `geo.crs.parse_crs`.
        MissingGrid
            If a grid that the transformation needs is not there.
        """
        wanted = _with_height(source, target, where)
        keeps_height = _same_heights(source, wanted)
        ends = (horizontal_crs(source), horizontal_crs(wanted)) if keeps_height else (source, wanted)
        changes_plan = not horizontal_crs(source).equals(horizontal_crs(wanted), ignore_axis_order=True)
        operation = best_operation(*ends, where, _MEND, places)
        doubt = None if places is None else _doubt(source, wanted, operation, where, places)
        return Reprojection(wanted, keeps_height, operation, changes_plan, where, doubt)

    @property
    def height_std_m(self) -> float:
        """Accuracy of heights that PROJ states for the operation; 0 where they stay, or nothing is stated."""
        return 0.0 if self.keeps_height else max(self._transformer.accuracy, 0.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the source CRS as points (N, 3) float64 in `crs`; NaN where PROJ has no answer.

        Raises
        ------
        UnsupportedCRS
            If longitudes jump among them.
        PlaceMismatch
            If they lie far outside the area that the CRS is made for.
        """
        points = np.asarray(points, dtype=np.float64)
        if self.keeps_height:
            east, north = self._transformer.transform(points[:, 0], points[:, 1])
            height = points[:, 2]
        else:
            east, north, height = self._transformer.transform(*points.T)
        turned = nan_unless_finite(np.stack([east, north, height], axis=-1))
        if is_geographic(self.crs) and crosses(turned):
            raise UnsupportedCRS(
                f"the survey lies on the meridian of 180 degrees, where the longitudes of {self.crs.name} jump; choose "
                "a projected CRS of the place, e.g. UTM zone 1 or 60; GeoJSON of lines and areas is cut there."
            )
        if self._changes_plan:
            require_in_area(self.crs, turned, "the points", self._where)
        return turned


def _doubt(source: CRS, wanted: CRS, way: Transformer, where: str, places: np.ndarray) -> str | None:
    """A warning where places or heights are less well known after an operation, as PROJ states."""
    in_plan = Transformation.between(source, wanted, places)
    if in_plan.accuracy_m == 0.0 and not _same_heights(source, wanted) and way.accuracy > 0.0:
        return (
            f"{where}: heights are transformed by {way.description}, which PROJ states to {way.accuracy:.2g} m: an "
            "error common to all of them"
        )
    return in_plan.doubt(f"{where}: places")


def _with_height(source: CRS, target: str | CRS, where: str) -> CRS:
    """The target as a CRS with heights: its own, else those of the source."""
    try:
        wanted = crs_of(target)
    except CRSError as error:
        raise UnknownCRS(
            f'{where} is "{str(target)[:80]}", which is not a known coordinate reference system; give an EPSG code '
            'such as "EPSG:32632", WKT or a PROJ string.'
        ) from error
    if has_height(wanted) or not (wanted.is_projected or wanted.is_geographic):
        return parse_crs(wanted, where=where)
    vertical = vertical_crs(source)
    whole = wanted.to_3d() if vertical is None else CompoundCRS(f"{wanted.name} + {vertical.name}", [wanted, vertical])
    return parse_crs(whole, where=where)


def _same_heights(source: CRS, wanted: CRS) -> bool:
    """Whether both count heights from the same surface and in the same unit."""
    before, after = vertical_crs(source), vertical_crs(wanted)
    if before is None or after is None:
        same_ellipsoid = horizontal_crs(source).geodetic_crs == horizontal_crs(wanted).geodetic_crs
        same_unit = source.axis_info[2].unit_conversion_factor == wanted.axis_info[2].unit_conversion_factor
        return before is after is None and same_ellipsoid and same_unit
    return before.equals(after)
