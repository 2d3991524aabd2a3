"""A terrain model of a run in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rasterio
from pyproj import CRS

from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.registry import PRODUCTS

# Of the product, in the order of its bands.
_BANDS = ("height", "std", "std_common", "num_points", "depth", "origin")


@dataclass(frozen=True)
class Dem:
    """Heights of the bed in cells, the first row in the north; NaN where nothing is known.

    ``numpy.asarray(dem)`` are its heights.

    Attributes
    ----------
    height : (rows, columns) float32, in the heights of crs
    std, std_common : (rows, columns) float32 [m]
        Standard deviation of the height by errors of its own, and by what all heights have in common.
    num_points : (rows, columns) int
    depth : (rows, columns) float32 [m]
        Below the water, negative above it; NaN for a dry survey.
    east, north : (columns,), (rows,), in crs
        Middles of the cells.
    crs : pyproj.CRS
        Of heights too.
    """

    height: np.ndarray
    std: np.ndarray
    std_common: np.ndarray
    num_points: np.ndarray
    depth: np.ndarray
    east: np.ndarray
    north: np.ndarray
    crs: CRS

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The heights."""
        return np.array(self.height, dtype=dtype, copy=copy)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` of all layers, with the CRS as rioxarray and CF have it (``spatial_ref``).

        Raises
        ------
        SurveyError
            If xarray is not installed.
        """
        try:
            import xarray
        except ModuleNotFoundError as error:
            raise SurveyError("xarray is not installed: pip install 'bathynerf[xarray]'") from error
        layers = ("height", "std", "std_common", "num_points", "depth")
        values = {name: (("y", "x"), getattr(self, name), {"grid_mapping": "spatial_ref"}) for name in layers}
        place = ((), 0, {"crs_wkt": self.crs.to_wkt()})
        return xarray.Dataset(values, coords={"x": self.east, "y": self.north, "spatial_ref": place})


def dem_of(path: Path, options: ExportOptions) -> Dem:
    """The terrain model of a run folder, as ``export --dem`` makes it.

    Raises
    ------
    SurveyError, GeoError
        See `survey.export.export.export`.
    """
    (product,) = (each for each in PRODUCTS if each.option == "dem")
    with LoadedRun(path) as run, TemporaryDirectory(prefix="bathynerf-dem-") as folder:
        file = Path(folder) / "dem.tif"
        product.write(file, run, options)
        crs = run.place.crs if options.crs is None else run.way_to(options.crs).crs
        with rasterio.open(file) as raster:
            layers = dict(zip(_BANDS, raster.read(masked=True).filled(np.nan), strict=True))
            transform, (rows, columns) = raster.transform, raster.shape
    return Dem(
        height=layers["height"],
        std=layers["std"],
        std_common=layers["std_common"],
        num_points=np.nan_to_num(layers["num_points"]).astype(np.int64),
        depth=layers["depth"],
        east=transform.c + transform.a * (np.arange(columns) + 0.5),
        north=transform.f + transform.e * (np.arange(rows) + 0.5),
        crs=crs,
    )
