"""Clouds as LAS 1.4 and LAZ: results written, results and references read.

Sources: ASPRS LAS 1.4 R16 and its topo-bathy profile (classes 40 and up).
"""

import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import laspy
import numpy as np
from laspy.errors import LaspyException
from laspy.vlrs.known import WktCoordinateSystemVlr
from lazrs import LazrsError
from pyproj import CRS

from geo import copc
from geo.crs import is_geographic, wkt1
from geo.errors import GeoError, UnreadableFile, UnwritableFile, first_line
from geo.files import existing_file, write_whole
from geo.las_header import add_extra_bytes, crs_of_header, extra_of, length_fault, stored_extra
from geo.shapes import Cloud, ComputedColumn, portions

POINT_FORMAT = 7
CLASS_GROUND, CLASS_NOISE, CLASS_BATHYMETRIC, CLASS_WATER_SURFACE, CLASS_NO_BOTTOM = 2, 7, 40, 41, 45
# Points with a larger std are kept, but flagged as withheld so that other programs leave them out.
WITHHELD_STD_M = 1.0
SCALE_LENGTH = 0.001
SCALE_ANGLE = 1e-8
# Points that are made into records at a time, of 60 bytes and more each.
_PORTION = 100_000
_SUFFIXES = (".las", ".laz")

# laspy logs damage as well; the user sees the error raised below, which names the file.
logging.getLogger("laspy").addHandler(logging.NullHandler())


def write_cloud(
    path: str | Path,
    points_crs: np.ndarray,
    crs: CRS,
    *,
    rgb: np.ndarray,
    depth_m: np.ndarray,
    std_m: np.ndarray,
    num_views: np.ndarray,
    incidence_deg: np.ndarray | ComputedColumn,
    is_wet: np.ndarray,
    std_common_m: np.ndarray | None = None,
    classification: np.ndarray | None = None,
    user_data: np.ndarray | None = None,
    total_uncertainty_m: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Write a cloud as LAS 1.4, point format 7, whole or not at all: .las, .laz, or .copc.laz (`geo.copc`).

    Coordinates are rounded to 0.001 of the unit of crs (1e-8 for longitude and latitude); offsets are whole units. An
    empty cloud is written as a valid file without points, except as COPC. Values that are NaN (no water, a single view)
    are written as the declared "no data" value, which `read_cloud` turns back into NaN. The CRS is written as WKT 1.
    Raises GeoError if the suffix is another, the cloud is too wide for the format, or the file cannot be written.

    Parameters
    ----------
    points_crs : (N, 3) float64, in crs
        Finite: the caller leaves points without coordinates out and counts them.
    depth_m, std_m : (N,) [m]
        True depth below the water surface (negative above it) and standard deviation. Points whose standard deviation
        is over `WITHHELD_STD_M` are flagged as withheld.
    incidence_deg : (N,) [deg]
        Angle between ray and surface normal in air.
    is_wet : (N,) bool
        Class 40 (bathymetric) where true, else 2 (ground).
    std_common_m : (N,) [m], optional
        Standard deviation of the height from errors that all points share (water, lens, poses), which ``std_m`` does
        not include.
    classification : (N,) uint8, optional
        Classes to write instead of those by ``is_wet``, e.g. with 45 (no bottom found) among them.
    user_data : (N,) uint8, optional
        How each point was found, written to the field "user data".
    total_uncertainty_m : vertical and horizontal (N,) [m], optional
        At 95 %, as "total_tvu" and "total_thu".
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise UnwritableFile(f"cannot write {path}: its suffix must be .las or .laz.")
    points = np.asarray(points_crs, dtype=np.float64)
    if not len(points) and path.name.lower().endswith(copc.SUFFIX):
        raise GeoError(f"cannot write {path}: COPC needs one point at least; write LAZ.")
    common = np.full(len(points), np.nan) if std_common_m is None else std_common_m
    extra = {
        "depth": depth_m, "std": std_m, "std_common": common, "num_views": num_views, "incidence": incidence_deg,
    }  # fmt: skip
    if total_uncertainty_m is not None:
        extra |= dict(zip(("total_tvu", "total_thu"), total_uncertainty_m, strict=True))
    _require_sound(points, {"rgb": rgb, "is_wet": is_wet if classification is None else classification} | extra)

    header = _header(points, crs, path)
    add_extra_bytes(header, extra)

    def records(part: slice | np.ndarray) -> laspy.LasData:
        las = laspy.LasData(header)
        las.points = laspy.ScaleAwarePointRecord.zeros(len(points[part]), header=header)
        las.x, las.y, las.z = points[part].T
        las.return_number[:] = 1
        las.number_of_returns[:] = 1
        las.synthetic[:] = 1
        las.classification[:] = classes_of(is_wet[part]) if classification is None else classification[part]
        las.withheld[:] = is_withheld(np.asarray(std_m)[part])
        if user_data is not None:
            las.user_data[:] = user_data[part]
        # 257 maps 0..255 onto the whole of 0..65535.
        las.red, las.green, las.blue = np.asarray(rgb[part], dtype=np.uint16).T * np.uint16(257)
        for name, values in stored_extra(extra, part).items():
            las[name] = values
        return las

    _write(records, len(points), header, path)


def is_withheld(std_m: np.ndarray) -> np.ndarray:
    """Whether points (N,) of these standard deviations (N,) [m] are too uncertain to be used; an unknown one is not."""
    return np.asarray(std_m) > WITHHELD_STD_M


def classes_of(is_wet: np.ndarray) -> np.ndarray:
    """Class (N,) uint8 of points of the bed: bathymetric where wet, else ground."""
    return np.where(np.asarray(is_wet, dtype=bool), CLASS_BATHYMETRIC, CLASS_GROUND).astype(np.uint8)


def _write(records: copc.Records, count: int, header: laspy.LasHeader, path: Path) -> None:
    with write_whole(path) as stream:
        try:
            if path.name.lower().endswith(copc.SUFFIX):
                copc.write_copc(header, records, count, stream)
                return
            compress = path.suffix.lower() == ".laz"
            with laspy.open(stream, mode="w", header=header, do_compress=compress, closefd=False) as writer:
                for part in portions(max(count, 1), _PORTION):
                    writer.write_points(records(part).points)
            stream.flush()
            # A device or a pipe cannot be read back.
            if count and stream.seekable() and stream.readable():
                stream.seek(0)
                with laspy.open(stream, closefd=False) as reader:
                    reader.seek(count - 1)
                    if not len(reader.read_points(1)):
                        raise IndexError("it ends early")
        except (LazrsError, LaspyException, IndexError) as error:
            # The LAZ encoder hides the system's error.
            raise UnwritableFile(
                f"cannot write {path} ({first_line(error)}); most likely no space is left on the disk: free "
                "some or write elsewhere."
            ) from error


def _require_sound(points: np.ndarray, others: dict) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"expected points of shape (N, 3), got {points.shape}")
    for name, values in others.items():
        expected = points.shape if name == "rgb" else points.shape[:1]
        shape = (len(values),) if isinstance(values, ComputedColumn) else np.shape(values)
        if shape != expected:
            raise ValueError(f"{name} has shape {shape}, expected {expected}")
    bad = sum(int((~np.isfinite(points[part]).all(axis=1)).sum()) for part in portions(len(points), _PORTION))
    if bad:
        raise ValueError(f"{bad} of {len(points)} points have coordinates that are not finite; leave them out")


def _header(points: np.ndarray, crs: CRS, path: Path) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    horizontal = SCALE_ANGLE if is_geographic(crs) else SCALE_LENGTH
    header.scales = np.array([horizontal, horizontal, SCALE_LENGTH])
    if len(points):
        low, high = points.min(axis=0), points.max(axis=0)
        header.offsets = np.floor(0.5 * (low + high))
        if (np.maximum(high - header.offsets, header.offsets - low) / header.scales).max() >= 2**31 - 1:
            raise GeoError(
                f"cannot write {path}: the cloud reaches from {low} to {high}, more than LAS holds in steps "
                f"of {header.scales}; some points lie far off, give [area] bounds to leave them out."
            )
    # LAS 1.4 counts days in UTC (GMT).
    header.creation_date = datetime.now(UTC).date()
    header.global_encoding.wkt = True
    # Not header.add_crs, which writes WKT 2; LAS 1.4 asks for WKT 1.
    header.vlrs.append(WktCoordinateSystemVlr(wkt1(crs)))
    header.system_identifier = "bathynerf"
    header.generating_software = f"bathynerf {version('bathynerf')}"[:32]
    return header


def read_cloud(path: str | Path) -> Cloud:
    """Read LAS or LAZ, version 1.0 to 1.4, any point format; colours come as 8 bits.

    The CRS and the unit of heights are taken from WKT, else from GeoTIFF keys; where there is none, or none that is
    understood, it is None and `Cloud.notes` says so. Raises UnreadableFile if the file has no points, does not
    exist, is cut short, is not LAS, or has coordinates that are not finite.
    """
    path = existing_file(path)
    fault = length_fault(path)
    if fault:
        raise UnreadableFile(f"{path} cannot be read as LAS or LAZ: {fault}; copy or export it again.")
    # laspy and its LAZ decoder raise errors of many kinds for damaged files (UnicodeDecodeError, IndexError,
    # RuntimeError, MemoryError, ...). All of them mean a damaged file here.
    try:
        with path.open("rb") as stream, laspy.open(stream, closefd=False) as reader:
            header = reader.header
            las = reader.read() if header.point_count else None
    except BaseException as error:
        # A panic of the decoder (Rust) is not an Exception; an interrupt by the user is passed on.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise UnreadableFile(
            f"{path} cannot be read as LAS or LAZ ({first_line(error)}); it is damaged or cut short: copy or "
            "export it again."
        ) from error
    if las is None:
        raise UnreadableFile(f"{path} has no points; expected a cloud with at least one.")
    return _cloud_of(las, path)


def read_window(path: str | Path, bounds: Sequence[float]) -> Cloud:
    """The points of a COPC file in bounds (E0, N0, E1, N1) in its CRS; only nodes that meet these are read."""
    with laspy.CopcReader.open(str(existing_file(path))) as reader:
        window = laspy.copc.Bounds(mins=np.array(bounds[:2], dtype=float), maxs=np.array(bounds[2:], dtype=float))
        return _cloud_of(laspy.LasData(reader.header, reader.query(window)), Path(path))


def _cloud_of(las: laspy.LasData, path: Path) -> Cloud:
    header = las.header
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([las.x, las.y, las.z], axis=-1)
    if not np.isfinite(points).all():
        raise UnreadableFile(
            f"{path} gives coordinates that are not finite (scales {header.scales}, offsets {header.offsets}); it is "
            "damaged: copy or export it again."
        )
    crs, height_unit, notes = crs_of_header(header, path)
    return Cloud(
        points=points,
        rgb=_rgb(las),
        crs=crs,
        classification=np.asarray(las.classification, dtype=np.uint8),
        withheld=np.asarray(las.withheld, dtype=bool),
        overlap=np.asarray(las.overlap, dtype=bool) if "overlap" in las.point_format.dimension_names else None,
        height_unit_m=height_unit,
        extra=extra_of(las),
        notes=notes,
    )


def _rgb(las: laspy.LasData) -> np.ndarray | None:
    if "red" not in las.point_format.dimension_names:
        return None
    rgb = np.stack([las.red, las.green, las.blue], axis=-1)
    # The upper byte is the colour, whether the writer multiplied by 256 or by 257.
    return (rgb >> 8 if rgb.max(initial=0) > 255 else rgb).astype(np.uint8)
