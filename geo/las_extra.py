"""Extra bytes: values per point beyond those that LAS knows, with a descriptor each (LAS 1.4)."""

from __future__ import annotations

import struct

import laspy
import numpy as np

NO_DATA = -9999.0
# float32 rather than scaled integers: every reader shows its true values, also those that ignore scales.
# Names in lower case, as the registry of standard extra bytes has them; at most 32 characters each.
EXTRA_BYTES = (
    ("depth", np.dtype(np.float32), "true depth below the water, m"),
    ("std", np.dtype(np.float32), "height, less what lifts all, m"),
    ("std_common", np.dtype(np.float32), "height, by water, lens, poses, m"),
    ("num_views", np.dtype(np.uint16), "photographs that agree"),
    ("incidence", np.dtype(np.float32), "angle at the water in air, deg"),
)
_HAS_NO_DATA, _HAS_RANGE = 1, 2 | 4
# Reserved, type, options, name, unused, then three slots each for no data, minimum, maximum, scale, offset.
_DESCRIPTOR = "<2xBB32s4x8s16x8s16x8s16x48x32s"


def add_extra_bytes(header: laspy.LasHeader, values: dict[str, np.ndarray]) -> None:
    """Declare `EXTRA_BYTES` in a header, for values (N,) by name.

    Notes
    -----
    laspy 2.7 derives the minimum and maximum in the descriptors from the first point alone, so they are made
    here and stored as a plain record, which laspy does not change.
    """
    descriptors = []
    for name, dtype, description in EXTRA_BYTES:
        raw = np.asarray(values[name])
        header.add_extra_dim(laspy.ExtraBytesParams(name, dtype, description))
        descriptors.append(_descriptor(name, dtype, description, raw[np.isfinite(raw)].astype(dtype)))
    header.vlrs.extract("ExtraBytesVlr")
    header.vlrs.append(laspy.VLR("LASF_Spec", 4, "Extra Bytes Record", b"".join(descriptors)))


def stored_extra(values: dict[str, np.ndarray], part: slice) -> dict[str, np.ndarray]:
    """A part of values (N,), by name, as they are to be stored."""
    found = {}
    for name, dtype, _ in EXTRA_BYTES:
        raw = np.asarray(values[name][part])
        found[name] = np.where(np.isfinite(raw), raw, NO_DATA).astype(dtype)
    return found


def _descriptor(name: str, dtype: np.dtype, description: str, known: np.ndarray) -> bytes:
    """One descriptor of 192 bytes; ``known`` are the values that are not "no data"."""
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
        if no_data.get(name) is not None:
            raw = las.points.array[name]
            missing = (raw.reshape(len(raw), -1) == no_data[name]).reshape(values.shape)
            values = np.where(missing, np.nan, values) if missing.any() else values
        extra[name] = values
    return extra
