"""Points of a cloud that a person has deleted, or given another class. The cloud itself stays as it was computed.

RUN/edits/<stage>-<checksum>.npz has the steps in their order: rows of the cloud, and the class that they got. So each
can be undone, and edits never meet another cloud than their own: that of other settings has another name.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from shapely import Polygon

from geo.features import points_inside
from geo.files import reporting_disk_errors
from geo.las import CLASS_BATHYMETRIC, CLASS_GROUND, CLASS_NOISE, CLASS_WATER_SURFACE, classes_of
from geo.shapes import NOT_GROUND
from survey.display.quantities import count
from survey.errors import SurveyError
from survey.run.folder import RunDir
from survey.run.stored import BED_FILE, StoredArrays, load_arrays, load_bed_columns, save_arrays

FOLDER = "edits"
# In the place of a class: points that are left out of everything.
DELETED = 0
# By ASPRS: LAS 1.4 and its topo-bathy profile.
CLASSES = {
    CLASS_BATHYMETRIC: "bathymetric point",
    CLASS_GROUND: "ground",
    CLASS_WATER_SURFACE: "water surface",
    CLASS_NOISE: "noise",
}


def edits_path(run: RunDir) -> Path:
    """Where the edits of the cloud of a run are, if there are any."""
    stage = run.load_stage("bed")
    return run.path / FOLDER / f"{stage.name}-{StoredArrays(stage / BED_FILE).checksum('points_crs'):08x}.npz"


class Edits:
    """The edits of the cloud of a run. Each is a step, saved in the run at once; `undo` takes the last one back.

    Rows are those of the points in RUN/cloud.las. Raises SurveyError where the folder is not a finished run.

    Attributes
    ----------
    classes : (N,) uint8
        Class of each point by now; 0 where it is deleted.
    """

    def __init__(self, run: str | Path):
        folder = RunDir(run)
        folder.require_run()
        self.path, self._stage = edits_path(folder), folder.load_stage("bed")
        columns = load_bed_columns(self._stage, "points_crs", "wet")
        self._places, self._computed = columns["points_crs"], classes_of(columns["wet"])
        self._steps, self._stamp = self._read(), self._stamp_of_file()
        self.classes = self._replayed()

    def inside(self, polygon: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
        """Rows (K,) of the points that are not deleted and lie in a polygon: corners (C, 2) in the CRS of the run."""
        corners = np.asarray(polygon, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
            raise SurveyError(
                f"a polygon is {str(polygon)[:60]}, expected three corners or more as [easting, northing] in the CRS "
                "of the run"
            )
        low, high = corners.min(axis=0), corners.max(axis=0)
        plan = self._places[:, :2]
        near = np.flatnonzero(((plan >= low) & (plan <= high)).all(axis=1) & (self.classes != DELETED))
        return near[points_inside([Polygon(corners)], plan[near])]

    def classify(self, rows: np.ndarray, kind: int) -> None:
        """Give points a class: 40 (bathymetric point), 2 (ground), 41 (water surface) or 7 (noise)."""
        if kind not in CLASSES:
            known = ", ".join(f"{code} ({name})" for code, name in CLASSES.items())
            raise SurveyError(f"the class of points is to become {kind}, expected one of {known}")
        self._add(rows, kind)

    def delete(self, rows: np.ndarray) -> None:
        self._add(rows, DELETED)

    def undo(self) -> np.ndarray:
        """Take the last step back; the rows that it had changed, none where there is no step."""
        if not self._steps:
            return np.empty(0, dtype=np.int64)
        rows, _ = self._steps[-1]
        self._save(self._steps[:-1])
        return rows

    def places(self, rows: np.ndarray) -> np.ndarray:
        """Points (K, 3) [m], local, of some rows, deleted or not."""
        return np.asarray(load_bed_columns(self._stage, "xyz")["xyz"][rows])

    @property
    def is_bed(self) -> np.ndarray:
        """Mask (N,) of the points that are left and of the bed by their class."""
        return ~np.isin(self.classes, [DELETED, *NOT_GROUND])

    def __str__(self) -> str:
        """What was done, in words."""
        changed = self.classes != self._computed
        counts = {DELETED: "deleted"} | {code: f"made class {code} ({name})" for code, name in CLASSES.items()}
        parts = [
            f"{count(number)} {words}"
            for code, words in counts.items()
            if (number := int(np.count_nonzero(changed & (self.classes == code))))
        ]
        return f"{', '.join(parts) or 'none'} of {count(len(changed))} points"

    def _add(self, rows: np.ndarray, kind: int) -> None:
        rows = np.asarray(rows)
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows.astype(np.int64)
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(self.classes):
            raise SurveyError(f"rows are {rows.min()} to {rows.max()}, expected 0 to {len(self.classes) - 1}")
        rows = rows[(self.classes[rows] != kind) & (self.classes[rows] != DELETED)]
        if len(rows):
            self._save([*self._steps, (rows, kind)])

    def _save(self, steps: list[tuple[np.ndarray, int]]) -> None:
        """Write the file whole; without a step there is none."""
        if self._stamp_of_file() != self._stamp:
            raise SurveyError(f"{self.path} was changed by somebody else meanwhile; open the run again to edit it")
        with reporting_disk_errors(self.path):
            self.path.parent.mkdir(exist_ok=True)
            if steps:
                rows, kinds = zip(*steps, strict=True)
                counts = np.array([len(each) for each in rows], dtype=np.int64)
                save_arrays(self.path, rows=np.concatenate(rows), counts=counts, kinds=np.array(kinds, dtype=np.uint8))
            else:
                self.path.unlink(missing_ok=True)
        self._steps, self._stamp = steps, self._stamp_of_file()
        self.classes = self._replayed()

    def _read(self) -> list[tuple[np.ndarray, int]]:
        if not self.path.is_file():
            return []
        found = load_arrays(self.path)
        rows, counts, kinds = (found.get(name, np.empty(0)) for name in ("rows", "counts", "kinds"))
        is_whole = len(counts) == len(kinds) and counts.sum() == len(rows) and np.isin(kinds, [DELETED, *CLASSES]).all()
        if not (is_whole and len(rows) and 0 <= rows.min() <= rows.max() < len(self._computed)):
            raise SurveyError(f"{self.path} holds no edits of this cloud; remove it, or put back what was there")
        return list(zip(np.split(rows, np.cumsum(counts)[:-1]), kinds.tolist(), strict=True))

    def _replayed(self) -> np.ndarray:
        classes = self._computed.copy()
        for rows, kind in self._steps:
            classes[rows] = kind
        return classes

    def _stamp_of_file(self) -> tuple[int, int] | None:
        if not self.path.is_file():
            return None
        status = self.path.stat()
        return status.st_size, status.st_mtime_ns


def edits_of(run: RunDir) -> Edits | None:
    """The edits of the cloud of a run; None where there are none."""
    return Edits(run.path) if (run.path / FOLDER).is_dir() and edits_path(run).is_file() else None


def edits_of_others(run: RunDir) -> str | None:
    """A sentence where edits in a run are of other clouds than that which it has now, and this one has none."""
    others = sorted(path.name for path in (run.path / FOLDER).glob("*.npz"))
    if not others or edits_path(run).is_file():
        return None
    return (
        f"points of an earlier cloud of {run.path} were edited; this is another cloud, which the edits do not fit: "
        f"they are kept in {FOLDER}/{others[-1]}, and apply again when that cloud is computed again"
    )
