"""ICESat-2 ATL24: photons of a lidar in space that the bed of coastal water reflected, with their uncertainty (HDF5).

A group for each beam has an array for each quantity, a value for each photon: ``lon_ph`` and ``lat_ph`` [deg] and
``ellipse_h`` [m] in WGS 84, ``ortho_h`` [m] over the geoid EGM2008, ``class_ph`` (40: bed, 41: sea surface),
``low_confidence_flag``, and one sigma of height and place, ``sigma_tvu`` and ``sigma_thu`` [m], after refraction.

Source: L. Magruder, C. Parrish et al., ATLAS/ICESat-2 L3A Global Bathymetry (ATL24), National Snow and Ice Data Center.
"""

from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.compatibility import Reprojection
from geo.crs import has_height, vertical_crs
from geo.errors import GeoError, UnreadableFile, first_line
from geo.files import existing_file, library_for
from geo.grid import plan_box
from geo.shapes import Cloud
from geo.transformation import WGS84, Transformation

SUFFIXES = (".h5", ".hdf5")
_BEAMS = tuple(f"gt{pair}{side}" for pair in (1, 2, 3) for side in "lr")
_NAMES = ("lon_ph", "lat_ph", "ellipse_h", "ortho_h", "class_ph", "low_confidence_flag", "sigma_tvu", "sigma_thu")
_BED = 40
_ELLIPSOIDAL, _EGM2008, _GEOID = CRS("EPSG:4979"), CRS("EPSG:4326+3855"), "EGM2008 height"


def read_atl24(path: str | Path, crs: CRS | None, places: np.ndarray) -> Cloud:
    """Photons of the bed in the box of places (N, 2 or more), both in a CRS with heights; see `photons_between`."""
    if crs is None or not has_height(crs):
        raise GeoError(f"the cloud names no CRS with heights, to which the photons of {path} could be transformed.")
    over = plan_box(places)
    corners = np.array([[east, north] for east in over[:, 0] for north in over[:, 1]])
    return photons_between(path, crs, plan_box(np.column_stack(Transformation.between(crs, WGS84, places)(*corners.T))))


def photons_between(path: str | Path, crs: CRS, box: np.ndarray, box_is: str = "") -> Cloud:
    """Photons of the bed, none of low confidence, in a CRS with heights, in a box (2, 2) of longitude and latitude.

    ``extra`` has their standard deviations ``std`` in height and ``std_plan`` in place [m]. Heights are those over
    EGM2008 where the CRS has these, else ellipsoidal ones, for which PROJ needs the grid of its vertical datum. Raises
    UnreadableFile if the file is no ATL24, or has no such photon there, naming what the box is; GeoError without that
    grid.
    """
    columns, (low, high), vertical = _columns(existing_file(path)), box, vertical_crs(crs)
    plan = np.column_stack([columns["lon_ph"], columns["lat_ph"]]).astype(np.float64)
    is_bed = (columns["class_ph"] == _BED) & (columns["low_confidence_flag"] == 0)
    used = is_bed & ((plan >= low) & (plan <= high)).all(axis=1)
    if not used.any():
        raise UnreadableFile(
            f"none of the {int(is_bed.sum())} photons of the bed in {path} lies over the survey, at longitude "
            f"{low[0]:.4f} to {high[0]:.4f} and latitude {low[1]:.4f} to {high[1]:.4f}{box_is}; "
            "get the granule of that place"
        )
    is_geoid = vertical is not None and vertical.name == _GEOID
    source, height = (_EGM2008, "ortho_h") if is_geoid else (_ELLIPSOIDAL, "ellipse_h")
    points = np.column_stack([plan, columns[height]])[used]
    to_crs = Reprojection.between(source, crs, where=f"the CRS of the survey, for {path}", places=points)
    extra = {name: columns[given][used].astype(np.float64) for name, given in
             (("std", "sigma_tvu"), ("std_plan", "sigma_thu"))}  # fmt: skip
    notes = (
        f"{Path(path).name}: {int(used.sum())} photons of the bed, {height} (heights of the bed, not depths: no tide "
        f"enters), of a standard deviation of {np.median(extra['std']):.2f} m in height and "
        f"{np.median(extra['std_plan']):.1f} m in place (medians): on slopes the latter counts too",
        *([] if to_crs.warning is None else [to_crs.warning]),
    )
    return Cloud(to_crs(points), crs=to_crs.crs, extra=extra, notes=notes)


def _columns(path: Path) -> dict[str, np.ndarray]:
    """The arrays of all beams, one after the other."""
    h5py = library_for(path, "h5py", "atl24")
    try:
        with h5py.File(path) as file:
            beams = [file[name] for name in _BEAMS if name in file and "class_ph" in file[name]]
            return {name: np.concatenate([beam[name][:] for beam in beams]) for name in _NAMES}
    except (OSError, KeyError, ValueError) as error:
        raise UnreadableFile(
            f"{path} cannot be read as ATL24 ({first_line(error)}), expected HDF5 with {', '.join(_NAMES)} in "
            "gt1l to gt3r; download the granule again"
        ) from error
