"""LAS header: length of the file, CRS, and extra bytes, values per point with a descriptor each (LAS 1.4)."""

import struct
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from geo.crs import checked_height_unit, has_height, horizontal_crs, unit_of_code, with_height_unit
from geo.shapes import ComputedColumn, portions

# Keys of GeoTIFF 1.1 (OGC 19-008r4).
_MODEL, _GEOGRAPHIC, _PROJECTED, _LINEAR_UNIT, _VERTICAL, _VERTICAL_UNIT = 1024, 2048, 3072, 3076, 4096, 4099
_EPSG_RANGE = range(1024, 32767)
# The vertical codes 5001 to 5033 of GeoTIFF 1.0 are ellipsoids, not EPSG vertical systems.
_OLD_VERTICAL = range(5001, 5034)
# Codes from 5101 on are datums; these are the EPSG systems of their heights, of 5102 in feet.
_VERTICAL_OF_DATUM = {5101: 5701, 5102: 5702, 5103: 5703, 5104: 5736, 5105: 5705, 5106: 5706}
_UNIT_TOLERANCE = 1e-9

_SHORTEST_HEADER, _HEADER_1_4 = 227, 375
_RECORD, _EXTENDED_RECORD = 54, 60
_LAZ_BIT = 0x80
# Mark of a writer to a stream that cannot seek: the offset of the chunk table is at the end of the file.
_TABLE_AT_END = -1
NO_DATA = -9999.0
# float32 rather than scaled integers: every reader shows its true values, also those that ignore scales.
# Names in lower case, as the registry of standard extra bytes has them; at most 32 characters each.
EXTRA_BYTES = (
    ("depth", np.dtype(np.float32), "true depth below the water, m"),
    ("std", np.dtype(np.float32), "random part of height, m"),
    ("std_common", np.dtype(np.float32), "part that all heights share, m"),
    ("num_views", np.dtype(np.uint16), "photographs that agree"),
    ("incidence", np.dtype(np.float32), "angle at the water in air, deg"),
    ("total_tvu", np.dtype(np.float32), "vertical uncertainty, 95 %, m"),
    ("total_thu", np.dtype(np.float32), "horizontal uncertainty, 95 %, m"),
)
_HAS_NO_DATA, _HAS_RANGE = 1, 2 | 4
# Reserved, type, options, name, unused, then three slots each for no data, minimum, maximum, scale, offset.
_DESCRIPTOR = "<2xBB32s4x8s16x8s16x8s16x48x32s"


def length_fault(path: Path) -> str | None:
    """Contradiction between a LAS header and the length of its file: damaged counts would keep laspy busy for hours."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_HEADER_1_4)
    if head[:4] != b"LASF":
        return 'it does not begin with "LASF"'
    if len(head) < _SHORTEST_HEADER:
        return "its header is not complete"
    header_size, start, records, point_format, length, count = struct.unpack_from("<HIIBHI", head, 94)
    if (head[24], head[25]) >= (1, 4) and len(head) == _HEADER_1_4:
        first_extended, extended, count = struct.unpack_from("<QIQ", head, 235)
        if extended and first_extended + extended * _EXTENDED_RECORD > size:
            return f"its header promises {extended} records after the points, for which it is too short"
    if header_size + records * _RECORD > start or start > size:
        return f"its header promises {records} records before the points, for which it is too short"
    if not point_format & _LAZ_BIT and start + count * length > size:
        return f"its header promises {count} points, of which it holds {max(size - start, 0) // max(length, 1)}"
    return _fault_of_chunks(path, start, count, size) if point_format & _LAZ_BIT else None


def _fault_of_chunks(path: Path, start: int, count: int, size: int) -> str | None:
    # The decoder allocates memory for as many chunks as the table says, and ends the process if that fails.
    with path.open("rb") as stream:
        stream.seek(start)
        table = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))[0]
        if table == _TABLE_AT_END:
            stream.seek(-8, 2)
            table = struct.unpack("<q", stream.read(8))[0]
        if not start + 8 <= table <= size - 8:
            return "its table of chunks lies outside of it"
        stream.seek(table + 4)
        chunks = struct.unpack("<I", stream.read(4))[0]
    # Each has a point at least, and takes a byte.
    if chunks > min(max(count, 1), size):
        return f"its table promises {chunks} chunks, for {count} points in {size} bytes"
    return None


def crs_of_header(header: laspy.LasHeader, path: Path) -> tuple[CRS | None, float | None, tuple[str, ...]]:
    """The CRS of a LAS file, the unit of heights [m] that its keys state separately, and notes on what is missing.

    Taken from OGC WKT, else from GeoTIFF keys.
    """
    records = [*header.vlrs, *(header.evlrs or [])]
    texts = [r.string for r in records if isinstance(r, WktCoordinateSystemVlr) and r.string.strip()]
    tables = [r for r in records if isinstance(r, GeoKeyDirectoryVlr)]
    if not texts and not tables:
        return None, None, (f"{path} states no CRS.",)
    try:
        crs = CRS.from_wkt(texts[0]) if texts else _crs_of_keys(tables[0])
        # Of a damaged compound CRS PROJ reads the parts only here.
        if not all(axis.unit_conversion_factor > 0.0 for axis in crs.axis_info):
            raise CRSError("a unit of its axes is not a length")
        notes = () if has_height(crs) else (f"{path} states the CRS {crs.name} without a vertical part.",)
    except CRSError as error:
        return None, None, (f"{path} states a CRS that is not understood ({str(error)[:120]}).",)
    stated = unit_of_code(_keys_of(tables[0]).get(_VERTICAL_UNIT, 0)) if tables else None
    return crs, checked_height_unit(crs, stated, path, "the unit of height of its GeoTIFF keys"), notes


def _keys_of(table: GeoKeyDirectoryVlr) -> dict[int, int]:
    return {key.id: key.value_offset for key in table.geo_keys}


def _crs_of_keys(table: GeoKeyDirectoryVlr) -> CRS:
    """The CRS of GeoTIFF keys; laspy's own reader takes user-defined projections for geographic coordinates."""
    keys = _keys_of(table)
    projected = keys.get(_MODEL, int(_PROJECTED in keys)) == 1
    code = keys.get(_PROJECTED if projected else _GEOGRAPHIC, 0)
    if code not in _EPSG_RANGE:
        raise CRSError(f"GeoTIFF keys with code {code}, which is user-defined")
    crs = CRS.from_epsg(code)
    unit = unit_of_code(keys.get(_LINEAR_UNIT, 0))
    own = horizontal_crs(crs).axis_info[0].unit_conversion_factor
    if projected and unit is not None and abs(unit - own) > _UNIT_TOLERANCE:
        raise CRSError(f"GeoTIFF keys with EPSG:{code} in another unit than its own")
    number = keys.get(_VERTICAL, 0)
    number = _VERTICAL_OF_DATUM.get(number, number)
    if number not in _EPSG_RANGE or number in _OLD_VERTICAL or has_height(crs):
        return crs
    vertical, unit = CRS.from_epsg(number), unit_of_code(keys.get(_VERTICAL_UNIT, 0))
    if unit is not None:
        # Files often name the datum by its system in metres, and state feet as the unit in another key.
        vertical = with_height_unit(vertical, unit)
    return CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])


def add_extra_bytes(header: laspy.LasHeader, values: dict[str, np.ndarray | ComputedColumn]) -> None:
    """Declare those of `EXTRA_BYTES` that have values (N,), by name, in a header.

    laspy 2.7 derives the minimum and maximum in the descriptors from the first point alone: they are made here and
    stored as a plain record, which laspy does not change.
    """
    descriptors = []
    for name, dtype, description in (each for each in EXTRA_BYTES if each[0] in values):
        header.add_extra_dim(laspy.ExtraBytesParams(name, dtype, description))
        descriptors.append(_descriptor(name, dtype, description, _range(values[name], dtype)))
    header.vlrs.extract("ExtraBytesVlr")
    header.vlrs.append(laspy.VLR("LASF_Spec", 4, "Extra Bytes Record", b"".join(descriptors)))


def _range(values: np.ndarray | ComputedColumn, dtype: np.dtype) -> np.ndarray:
    """Lowest and highest (2,) of values (N,), as they are stored; (0,) where all are "no data"."""
    ends = []
    for part in portions(len(values)):
        raw = np.asarray(values[part])
        known = raw[np.isfinite(raw)].astype(dtype)
        ends += [known.min(), known.max()] if len(known) else []
    return np.array([min(ends), max(ends)] if ends else [], dtype=dtype)


def stored_extra(values: dict[str, np.ndarray | ComputedColumn], part: slice | np.ndarray) -> dict[str, np.ndarray]:
    """A part of values (N,), by name, as they are to be stored."""
    dtypes = {name: dtype for name, dtype, _ in EXTRA_BYTES if name in values}
    raw = {name: np.asarray(values[name][part]) for name in dtypes}
    return {name: np.where(np.isfinite(raw[name]), raw[name], NO_DATA).astype(dtypes[name]) for name in dtypes}


def _descriptor(name: str, dtype: np.dtype, description: str, known: np.ndarray) -> bytes:
    is_float = dtype.kind == "f"
    code, slot, number = (9, "<d", float) if is_float else (3, "<Q", int)
    low, high = (number(known.min()), number(known.max())) if len(known) else (number(0), number(0))
    return struct.pack(
        _DESCRIPTOR,
        code,
        (_HAS_NO_DATA if is_float else 0) | (_HAS_RANGE if len(known) else 0),
        name.encode(),
        struct.pack(slot, NO_DATA) if is_float else bytes(8),
        struct.pack(slot, low),
        struct.pack(slot, high),
        description.encode(),
    )


def extra_of(las: laspy.LasData) -> dict[str, np.ndarray]:
    """Extra bytes of a file by name, scaled as the file says, NaN where it declares "no data"."""
    # laspy 2.7 reads the "no data" values of the descriptors but does not pass them on to the dimensions.
    records = [r for record in las.header.vlrs.get("ExtraBytesVlr") for r in record.extra_bytes_structs]
    with np.errstate(over="ignore", invalid="ignore"):  # a value beyond the type of its column matches nothing
        no_data = {r.format_name(): r.no_data for r in records if r.data_type != 0}
    extra = {}
    for name in las.point_format.extra_dimension_names:
        values = np.array(las[name])
        if no_data.get(name) is not None and len(values):
            raw = las.points.array[name]
            missing = (raw.reshape(len(raw), -1) == no_data[name]).reshape(values.shape)
            values = np.where(missing, np.nan, values) if missing.any() else values
        extra[name] = values
    return extra
