"""Points from the CRS of a survey into another one that a user asks for.

Horizontal coordinates are transformed by PROJ, heights stay as they are where both systems count them from the same
datum; between two vertical datums the grid of one of them is needed, and without it the way is refused.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from geo.crs import has_height, horizontal_crs, parse_crs, vertical_crs
from geo.errors import MissingGrid, UnknownCRS, UnsupportedCRS
from geo.projection import nan_unless_finite


@dataclass(frozen=True)
class Reprojection:
    """The way from one CRS with heights to another.

    Attributes
    ----------
    crs : pyproj.CRS
        In which points come out, with a vertical part.
    keeps_height : bool
        Whether heights stay as they are.
    """

    crs: CRS
    keeps_height: bool
    _transformer: Transformer = field(repr=False, compare=False)

    @staticmethod
    def between(source: CRS, target: str | CRS, *, where: str = "crs") -> Reprojection:
        """The way from a CRS with heights to one with heights, or to a horizontal one, which keeps the heights.

        Parameters
        ----------
        source : pyproj.CRS
        target : str or pyproj.CRS
            EPSG code, WKT or PROJ string, e.g. "EPSG:32632" or "EPSG:4326+5773".
        where : str
            What errors name.

        Raises
        ------
        UnknownCRS, UnsupportedCRS
            If PROJ does not know the target, or it does not suit a survey; see `geo.crs.parse_crs`.
        MissingGrid
            If a grid that the way needs is not there.
        """
        wanted = _with_height(source, target, where)
        keeps_height = _same_heights(source, wanted)
        ends = (horizontal_crs(source), horizontal_crs(wanted)) if keeps_height else (source, wanted)
        return Reprojection(wanted, keeps_height, _best(*ends, where))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the source CRS as points (N, 3) float64 in `crs`; NaN where PROJ has no answer."""
        points = np.asarray(points, dtype=np.float64)
        if self.keeps_height:
            east, north = self._transformer.transform(points[:, 0], points[:, 1])
            height = points[:, 2]
        else:
            east, north, height = self._transformer.transform(*points.T)
        return nan_unless_finite(np.stack([east, north, height], axis=-1))


def _with_height(source: CRS, target: str | CRS, where: str) -> CRS:
    """The target as a CRS with heights: its own, else those of the source."""
    try:
        wanted = CRS.from_user_input(target)
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


def _best(source: CRS, target: CRS, where: str) -> Transformer:
    """PROJ's best transformation, if all grids that it needs are there.

    Raises
    ------
    MissingGrid
        If the best one needs a grid that is not installed.
    UnsupportedCRS
        If there is none.
    """
    said = f"{where}: the way from {source.name} to {target.name}"
    mend = "or name a horizontal CRS alone, which keeps the heights as they are."
    try:
        with warnings.catch_warnings():
            # pyproj warns of missing grids, which end in the error below.
            warnings.simplefilter("ignore", UserWarning)
            group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise UnsupportedCRS(f"{said} is not known to PROJ ({str(error)[:80]}); choose another CRS, {mend}") from error
    if group.best_available and group.transformers:
        return group.transformers[0]
    missing = [grid.short_name for op in group.unavailable_operations[:1] for grid in op.grids if not grid.available]
    if missing:
        raise MissingGrid(
            f"{said} needs {' and '.join(missing)}, which PROJ does not have; fetch it into its data folder (projsync "
            f"--file {missing[0]}), {mend}"
        )
    raise UnsupportedCRS(f"{said} is not known to PROJ; choose another CRS, {mend}")
