"""Arrays on disk between the stages of a run: written whole, read back as they were, whole or in parts.

The points of a bed stay there: their columns are mapped into memory, of which the system keeps what is in use.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS

from geo.files import reporting_disk_errors, write_whole
from geo.shapes import ComputedColumn
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints

# In the header of a file in a zip archive: the lengths of name and extra field, which follow it.
_LENGTHS_AT = 26
# Bytes that are read at a time, and that the header of an array of numpy takes at most.
_PORTION, _MOST_HEADER = 4_000_000, 1 << 16
BED_FILE, SURVEY_FILE = "bed.npz", "survey.json"
# Columns of a stored bed beside those of its points.
OF_PLACES = ("std_common", "std_placed", "std_plan")
# Of a trained field; `survey.run.trained_field` reads and writes them.
FIELD_FILES = FIELD_STATE, FIELD_SETTINGS = "state.pt", "settings.json"
SUBMODULES = "submodules"  # Folder of the submodules of a field, where there are some
# Of a field: its surface as a cloud, and the folder where it is stored as the bed of a run is.
FIELD_CLOUD, FIELD_BED = "cloud.las", "bed"


@dataclass(frozen=True)
class Column:
    """An array that is written part by part: its parts follow each other along the first axis."""

    dtype: np.dtype
    shape: tuple[int, ...]
    parts: Iterable[np.ndarray]


@dataclass(frozen=True)
class BedHeader:
    """What a stored bed has beside its points; the attributes are those of `StoredBed`."""

    crs: CRS
    name: str
    gsd_m: float


@dataclass(frozen=True)
class StoredBed:
    """Result of the stage of the bed, all that an export needs."""

    bed: BedPoints  # Local frame
    points_crs: Any  # (N, 3) float64, or a column of them to write: the same points, in crs
    crs: CRS
    name: str  # Of the survey
    gsd_m: float  # [m]: ground sampling distance that was worked at
    # (N,) float32 [m] or None: standard deviation of the heights by water, lens and poses,
    # `survey.adjust.result.std_common`; None: not known
    std_common: np.ndarray | None = None
    # (N,) float32 [m] or None: the part of the standard deviations in `bed` by how GPS or control has placed the block
    # (`survey.adjust.result.std_common.std_of_block`); None where nothing placed it, and of a file without that column
    std_placed: np.ndarray | None = None
    # (N,) float32 [m] or None: standard deviation of the places in plan along one axis, by water, lens and poses
    std_plan: np.ndarray | None = None

    def __getitem__(self, keep: np.ndarray) -> StoredBed:
        """Some points, by a mask (N,) or their rows."""
        of_places = {name: std[keep] for name in OF_PLACES if (std := getattr(self, name)) is not None}
        return dataclasses.replace(self, bed=self.bed[keep], points_crs=self.points_crs[keep], **of_places)

    def std_of_photographs(self) -> np.ndarray | ComputedColumn:
        """Standard deviations (N,) [m] of the heights without `std_placed`: as good as the photographs are."""
        if self.std_placed is None:
            return self.bed.std
        return ComputedColumn(
            lambda std, placed: np.sqrt(np.maximum(std**2 - placed**2, 0.0)), self.bed.std, self.std_placed
        )


def save_arrays(path: str | Path, **arrays: np.ndarray) -> None:
    """Write arrays by name into one .npz file, whole or not at all."""
    write_arrays(path, arrays.items())


def write_arrays(path: str | Path, arrays: Iterable[tuple[str, np.ndarray | Column]]) -> None:
    """Write arrays one after the other: they need not be in memory together; otherwise as `save_arrays`."""
    with write_whole(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if not isinstance(array, Column):
                    np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
                    continue
                descr, written = np.lib.format.dtype_to_descr(array.dtype), 0
                header = {"descr": descr, "fortran_order": False, "shape": array.shape}
                np.lib.format.write_array_header_1_0(member, header)
                for part in array.parts:
                    member.write(np.ascontiguousarray(part, dtype=array.dtype).data)
                    written += len(part)
                if written != array.shape[0]:
                    raise ValueError(f"the parts of a column have {written} rows, expected {array.shape[0]}")


def load_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of a file of `save_arrays`."""
    return dict(StoredArrays(path))


def mapped_arrays(path: str | Path, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """Arrays mapped from a file, of which with ``names`` only those; what is written to them does not reach it."""
    stored = StoredArrays(path)
    return {name: stored.mapped(name) for name in stored if names is None or name in names}


class StoredArrays(Mapping[str, np.ndarray]):
    """Arrays of a file of `save_arrays` by name, each read in one go when it is asked for."""

    def __init__(self, path: str | Path):
        # Workers open it by this path, whatever their working directory.
        self._path = Path(path).absolute()
        try:
            with zipfile.ZipFile(self._path) as archive:
                self._members = {each.filename.removesuffix(".npy"): each for each in archive.infolist()}
        except (OSError, zipfile.BadZipFile) as error:
            raise unreadable(path, error) from error

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def __getitem__(self, name: str) -> np.ndarray:
        with self._at_member(name) as (stream, size):
            content = np.empty(size, dtype=np.uint8)
            if stream.readinto(content.data) != size:
                raise EOFError("the file ends within an array")
            self._require_whole(name, zlib.crc32(content.data))
            return _array_in(content)

    def checksum(self, name: str) -> int:
        """CRC-32 of the array of a name, as the file states it."""
        return self._members[name].CRC

    def mapped(self, name: str) -> np.ndarray:
        """The array of a name, which stays in the file."""
        with self._at_member(name) as (stream, size):
            start, checksum, left = stream.tell(), 0, size
            while left and (part := stream.read(min(_PORTION, left))):
                checksum, left = zlib.crc32(part, checksum), left - len(part)
            self._require_whole(name, checksum)
            return _array_in(np.memmap(self._path, np.uint8, "c", start, (size,)).view(np.ndarray))

    @contextmanager
    def _at_member(self, name: str) -> Iterator[tuple[BufferedReader, int]]:
        """The file at an array, and how many bytes it takes."""
        if name not in self._members:
            raise unreadable(self._path, f"it lacks the array {name}")
        member = self._members[name]
        try:
            with self._path.open("rb") as stream:
                # The archive does not compress; the local header ends with the name and an extra field.
                stream.seek(member.header_offset + _LENGTHS_AT)
                stream.seek(sum(struct.unpack("<HH", stream.read(4))), os.SEEK_CUR)
                yield stream, member.file_size
        except (OSError, ValueError, EOFError, struct.error) as error:
            if isinstance(error, SurveyError):
                raise
            raise unreadable(self._path, error) from error

    def _require_whole(self, name: str, checksum: int) -> None:
        if checksum != self._members[name].CRC:
            raise unreadable(self._path, f"the checksum of its array {name} differs")


def _array_in(content: np.ndarray) -> np.ndarray:
    """The array whose bytes (N,), in the format of numpy, are these."""
    stream = BytesIO(content[:_MOST_HEADER].tobytes())
    np.lib.format.read_magic(stream)
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject:
        raise ValueError("an array of objects")
    return content[stream.tell() :].view(dtype).reshape(shape, order="F" if is_fortran else "C")


def unreadable(path: str | Path, why: Exception | str) -> SurveyError:
    """The error for a file that an earlier stage left."""
    return SurveyError(f"{path} cannot be read ({why}); delete its folder and run `bathynerf process` again")


def save_bed(folder: str | Path, stored: StoredBed) -> None:
    """Write what an export needs into the folder of the bed's stage: bed.npz and survey.json."""
    folder = Path(folder)
    columns: dict[str, np.ndarray | Column] = {"points_crs": stored.points_crs}
    columns |= {f.name: getattr(stored.bed, f.name) for f in dataclasses.fields(stored.bed)}
    columns |= {name: std for name in OF_PLACES if (std := getattr(stored, name)) is not None}
    write_arrays(folder / BED_FILE, columns.items())
    record = {"crs_wkt": stored.crs.to_wkt(), "name": stored.name, "gsd_m": stored.gsd_m}
    write_json(folder / SURVEY_FILE, record)


def load_bed(folder: str | Path) -> StoredBed:
    """The bed that `save_bed` wrote."""
    from fields.sweep.bed import BedPoints

    arrays = mapped_arrays(Path(folder) / BED_FILE)
    header = load_bed_header(folder)
    try:
        points_crs = arrays.pop("points_crs")
        parts = [arrays.pop(name, None) for name in OF_PLACES]
        return StoredBed(BedPoints(**arrays), points_crs, header.crs, header.name, header.gsd_m, *parts)
    except (KeyError, TypeError) as error:
        raise _no_bed(folder, error) from error


def load_bed_header(folder: str | Path) -> BedHeader:
    """The attributes of a bed beside its points, as `save_bed` wrote them."""
    try:
        record = json.loads((Path(folder) / SURVEY_FILE).read_text(encoding="utf-8"))
        return BedHeader(CRS.from_wkt(record["crs_wkt"]), record["name"], record["gsd_m"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _no_bed(folder, error) from error


def _no_bed(folder: str | Path, error: Exception) -> SurveyError:
    return SurveyError(f"{folder} is no bed that can be read ({error}); delete it and run `bathynerf process` again")


def load_bed_columns(folder: str | Path, *names: str) -> dict[str, np.ndarray]:
    """Some columns of the points that `save_bed` wrote, by name: points_crs, or a field of BedPoints.

    The others are not read: a cloud is larger than what a raster needs of it. Names that the file does not have are
    left out.
    """
    return mapped_arrays(Path(folder) / BED_FILE, names)


@contextmanager
def columns_in(folder: Path) -> Iterator[Callable[[int], np.ndarray]]:
    """Makes columns (N,) float32 that lie in files of a folder of their own there, which goes at the end."""
    numbers = count()
    with reporting_disk_errors(folder), TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as place:
        yield lambda rows: np.memmap(Path(place) / f"{next(numbers)}.raw", np.float32, "w+", shape=(rows,))


class FileArray:
    """Array (height, width) in a file; rows are read on demand and not cached."""

    def __init__(self, path: Path, array: np.ndarray):
        self._path, self.shape, self._dtype = path, array.shape, array.dtype
        with reporting_disk_errors(path):
            path.write_bytes(np.ascontiguousarray(array).tobytes())

    def __getitem__(self, part: tuple[slice, slice]) -> np.ndarray:
        rows, columns = part
        height, width = self.shape
        first, last, _ = rows.indices(height)
        count = max(last - first, 0)
        offset = first * width * self._dtype.itemsize
        full_rows = np.fromfile(self._path, self._dtype, count * width, offset=offset).reshape(count, width)
        return full_rows[:, columns]


class ArrayFiles:
    """Makes a `FileArray` of each array, in a folder that is made here, and empty."""

    def __init__(self, folder: Path):
        # Workers open them by this path, whatever their working directory.
        self._folder, self._count = folder.absolute(), 0
        with reporting_disk_errors(folder):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()

    def __call__(self, array: np.ndarray) -> FileArray:
        self._count += 1
        return FileArray(self._folder / f"{self._count}.raw", array)


def is_field(folder: Path) -> bool:
    """Whether a folder is one of `bathynerf field`."""
    return (folder / FIELD_SETTINGS).is_file() and ((folder / FIELD_STATE).is_file() or (folder / SUBMODULES).is_dir())


def run_of(folder: Path) -> Path:
    """The run that the field in a folder was trained on."""
    if not is_field(folder):
        raise SurveyError(f"{folder} holds no trained field ({FIELD_SETTINGS} and {FIELD_STATE}); expected one")
    run = read_json_object(folder / FIELD_SETTINGS).get("run")
    if not isinstance(run, str) or not Path(run).is_dir():
        raise SurveyError(
            f"the field in {folder} was trained on the run {run}, which is not there; give the same options to "
            "bathynerf field with its present folder, which writes that down"
        )
    return Path(run)
