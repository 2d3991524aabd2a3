"""Arrays on disk between the stages of a run: written whole, read back as they were."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS

from geo.files import write_whole
from survey.errors import SurveyError

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints

BED_FILE, SURVEY_FILE = "bed.npz", "survey.json"
# Of the stage of the field; `survey.run.stored_field` reads and writes them.
FIELD_FILES = FIELD_FILE, FIGURES_FILE, PLACE_FILE = "field.pt", "field.json", "place.json"


@dataclass(frozen=True)
class BedPlace:
    """What is known of a stored bed without its points; the attributes are those of `StoredBed`."""

    crs: CRS
    name: str
    gsd_m: float


@dataclass(frozen=True)
class StoredBed:
    """What the stage of the bed leaves behind, all that an export needs.

    Attributes
    ----------
    bed : BedPoints
        Local frame.
    points_crs : (N, 3) float64
        The same points, in crs.
    crs : pyproj.CRS
    name : str
        Of the survey.
    gsd_m : [m]
        Ground sampling distance that was worked at.
    std_common : (N,) float32 [m] or None
        Standard deviation of the heights by water, lens and poses, `survey.adjust.std_common`; None where not known.
    std_placed : (N,) float32 [m] or None
        The part of the standard deviations in `bed` by how GPS or control has placed the block
        (`survey.adjust.std_of_block`); None where a file has.
    """

    bed: BedPoints
    points_crs: np.ndarray
    crs: CRS
    name: str
    gsd_m: float
    std_common: np.ndarray | None = None
    std_placed: np.ndarray | None = None

    def std_of_photographs(self) -> np.ndarray:
        """Standard deviations (N,) [m] of the heights without `std_placed`: as good as the photographs are."""
        if self.std_placed is None:
            return self.bed.std
        return np.sqrt(np.maximum(self.bed.std**2 - self.std_placed**2, 0.0))


def save_arrays(path: str | Path, **arrays: np.ndarray) -> None:
    """Write arrays by name into one .npz file, whole or not at all.

    Raises
    ------
    UnwritableFile
        If the system refuses; see `geo.write_whole`.
    """
    write_arrays(path, arrays.items())


def write_arrays(path: str | Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """As `save_arrays`, of names with their arrays one after the other: they need not be in memory together."""
    with write_whole(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def load_arrays(path: str | Path, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a file of `save_arrays`; with ``names`` only those of them that it has.

    Raises
    ------
    SurveyError
        If the file is missing or damaged.
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files if names is None or name in names}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise unreadable(path, error) from error


def unreadable(path: str | Path, why: Exception | str) -> SurveyError:
    """The error for a file that an earlier stage left."""
    return SurveyError(f"{path} cannot be read ({why}); delete its folder and give `bathynerf process` again")


def save_bed(folder: str | Path, stored: StoredBed) -> None:
    """Write what an export needs into the folder of the bed's stage: bed.npz and survey.json."""
    folder = Path(folder)
    columns = {f.name: getattr(stored.bed, f.name) for f in dataclasses.fields(stored.bed)}
    if stored.std_common is not None:
        columns["std_common"] = stored.std_common
    if stored.std_placed is not None:
        columns["std_placed"] = stored.std_placed
    save_arrays(folder / BED_FILE, points_crs=stored.points_crs, **columns)
    said = {"crs_wkt": stored.crs.to_wkt(), "name": stored.name, "gsd_m": stored.gsd_m}
    with write_whole(folder / SURVEY_FILE) as stream:
        stream.write(json.dumps(said, indent=2, ensure_ascii=False).encode())


def load_bed(folder: str | Path) -> StoredBed:
    """What `save_bed` wrote.

    Raises
    ------
    SurveyError
        If a file is missing or damaged.
    """
    from fields.sweep.bed import BedPoints

    arrays = load_arrays(Path(folder) / BED_FILE)
    place = load_bed_place(folder)
    try:
        points_crs = arrays.pop("points_crs")
        parts = [arrays.pop(name, None) for name in ("std_common", "std_placed")]
        return StoredBed(BedPoints(**arrays), points_crs, place.crs, place.name, place.gsd_m, *parts)
    except (KeyError, TypeError) as error:
        raise _no_bed(folder, error) from error


def load_bed_place(folder: str | Path) -> BedPlace:
    """What `save_bed` wrote of a bed beside its points.

    Raises
    ------
    SurveyError
        If the file is missing or damaged.
    """
    try:
        said = json.loads((Path(folder) / SURVEY_FILE).read_text(encoding="utf-8"))
        return BedPlace(CRS.from_wkt(said["crs_wkt"]), said["name"], said["gsd_m"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _no_bed(folder, error) from error


def _no_bed(folder: str | Path, error: Exception) -> SurveyError:
    return SurveyError(f"{folder} is no bed that can be read ({error}); delete it and give `bathynerf process` again")


def load_bed_columns(folder: str | Path, *names: str) -> dict[str, np.ndarray]:
    """Some columns of the points that `save_bed` wrote, by name: points_crs, or a field of BedPoints.

    The others are not read: a cloud is larger than what a raster needs of it. Names that the file does not have are
    left out.

    Raises
    ------
    SurveyError
        If the file is missing or damaged.
    """
    return load_arrays(Path(folder) / BED_FILE, names)
