"""A run at a URL: it works in a folder of this machine, and finished stages and the result are put to the URL whole.

The URL has the files of a run folder, and a copy of it is a run folder. The record of a stage is its commit marker:
uploaded last, deleted first. A stage without one is incomplete. The commit marker of a result is result.json. Complete
stages are used again, whatever machine they come from. A store has no lock: one machine at a time is to work at a run.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath

from geo.errors import GeoError
from geo.files import reporting_disk_errors, write_text
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.files.remote import Remote, files_below
from survey.run.folder import MARKER, NAMES, RECORD, STAGE_RECORD, UNFINISHED, Key, Owner, RunDir
from survey.words import SFM_FOLDER

_STAGES, _LOG = "stages", "log.txt"
# What a run and its workers leave at the URL until the result is there: jobs, stages of tiles, photographs.
JOBS, PARTS, PHOTOGRAPHS = ".jobs", ".parts", ".photographs"
# That of structure from motion, put last.
_SOLVED = "solved.json"


class RemoteRun(RunDir):
    """A run folder on this machine whose results are put to a URL, too."""

    def __init__(self, path: str | Path, remote: Remote):
        super().__init__(path)
        self.remote = remote
        self._is_claimed, self._has_put_poses = False, False
        # Folders at the URL where workers have left stages, by the names of these with their keys.
        self._results_of_workers: dict[str, str] = {}

    def __enter__(self) -> RemoteRun:
        super().__enter__()
        try:
            self._take_up()
        except BaseException:
            super().__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exception) -> None:
        # What ended the run counts more than that its log is not there. One that was refused leaves that of the other.
        with suppress(SurveyError, GeoError):
            if self._is_claimed:
                if not self._has_put_poses:
                    self._put_poses()
                if (self.path / _LOG).is_file():
                    self.remote.put({_LOG: self.path / _LOG})
        super().__exit__(*exception)

    def claim(self, owner: Owner, *, is_inside: bool) -> None:
        """Note the survey that the run is of, at the URL too; `RunDir.claim`."""
        try:
            super().claim(owner, is_inside=False)
        except SurveyError as error:
            raise SurveyError(str(error).replace(str(self.path), self.remote.url)) from error
        self.remote.put({MARKER: self.path / MARKER})
        self._is_claimed = True

    def _take_up(self) -> None:
        """Fetch the records of the run, and the poses that structure from motion found."""
        marker = self.remote.read(MARKER)
        if marker is None and (others := [name for name in self.remote.files() if name[0] != "."]):
            raise SurveyError(
                f"{self.remote.url} is not empty and is no run (it has {others[0]}); name a new or empty place with -o"
            )
        for name, content in ((MARKER, marker), *((name, self.remote.read(name)) for name in (RECORD, UNFINISHED))):
            if content is not None:
                write_text(self.path / name, content.decode())
            elif name == UNFINISHED:
                # Not the record: where it is missing at the URL, an upload was interrupted, and it names other results.
                (self.path / name).unlink(missing_ok=True)
        solved, solved_path = self.remote.read(f"{SFM_FOLDER}/{_SOLVED}"), self.sfm_path / _SOLVED
        if solved is not None and not (solved_path.is_file() and solved_path.read_bytes() == solved):
            # Stages at the URL are of the poses there.
            with reporting_disk_errors(self.sfm_path):
                shutil.rmtree(self.sfm_path, ignore_errors=True)
            self.remote.fetch_folder(SFM_FOLDER, self.sfm_path, last=_SOLVED)

    def latest_stage_json(self, name: str) -> dict:
        """As `RunDir.latest_stage_json`; where no stage here has the file, of any whole one at the URL."""
        found = super().latest_stage_json(name)
        if found:
            return found
        names = self.remote.files(_STAGES)
        complete = [
            each for each in names if each.endswith(f"/{name}") and f"{each.split('/')[0]}/{STAGE_RECORD}" in names
        ]
        with suppress(ValueError):
            content = json.loads(self.remote.read(f"{_STAGES}/{complete[-1]}") or b"{}") if complete else {}
            return content if isinstance(content, dict) else {}
        return {}

    def finished_stage(self, name: str, key: Key, leaves: Iterable[str] = ()) -> Path | None:
        """As `RunDir.finished_stage`; one that is only here is put to the URL, one that is only there fetched."""
        leaves, place = tuple(leaves), self.place(name, key)
        folder = super().finished_stage(name, key, leaves)
        record = self.remote.read(f"{_STAGES}/{place.name}/{STAGE_RECORD}")
        if folder is not None:
            if record is None:
                self._put_stage(folder)
            return folder
        if record is None:
            return None
        temp = super().open_stage(name)
        self.remote.fetch_folder(f"{_STAGES}/{place.name}", temp)
        with reporting_disk_errors(place):
            # One that is not whole.
            shutil.rmtree(place, ignore_errors=True)
            temp.rename(place)
        return super().finished_stage(name, key, leaves)

    def open_stage(self, name: str) -> Path:
        """As `RunDir.open_stage`; poses of structure from motion are there by then, and put to the URL."""
        if not self._has_put_poses:
            self._put_poses()
            self._has_put_poses = True
        return super().open_stage(name)

    def _put_poses(self) -> None:
        solved, name = self.sfm_path / _SOLVED, f"{SFM_FOLDER}/{_SOLVED}"
        if solved.is_file() and self.remote.read(name) != solved.read_bytes():
            self.remote.remove([name, SFM_FOLDER])
            self.remote.put_folder(self.sfm_path, SFM_FOLDER, last=_SOLVED)

    def fetched_stage(self, name: str, key: Key, place: str) -> Path:
        """The folder of `open_stage` with a stage that a worker has left at a place at the URL."""
        folder = self.open_stage(name)
        self.remote.fetch_folder(place, folder)
        self._results_of_workers[self.place(name, key).name] = place
        return folder

    def finish_stage(self, name: str, key: Key, temp: Path, seconds: float | None = None) -> Path:
        folder = super().finish_stage(name, key, temp, seconds)
        self._put_stage(folder)
        self._put_unfinished()
        return folder

    def open_result(self, quality: str) -> Path:
        """As `RunDir.open_result`; that a run has begun is noted at the URL."""
        folder = super().open_result(quality)
        self._put_unfinished()
        return folder

    def _put_unfinished(self) -> None:
        if (self.path / UNFINISHED).is_file():
            self.remote.put({UNFINISHED: self.path / UNFINISHED})

    def _put_stage(self, folder: Path) -> None:
        place = f"{_STAGES}/{folder.name}"
        left = self._results_of_workers.pop(folder.name, None)
        # Where it is put again, or what an interrupted put has left; the record first: half a stage is none.
        self.remote.remove([f"{place}/{STAGE_RECORD}", place])
        if left is None:
            self.remote.put_folder(folder, place, last=STAGE_RECORD)
            return
        self.remote.copy_folder(left, place)
        self.remote.put({f"{place}/{STAGE_RECORD}": folder / STAGE_RECORD})
        self.remote.remove([left])

    def publish(self, folder: Path, *, quality: str, stages: dict[str, Path]) -> None:
        super().publish(folder, quality=quality, stages=stages)
        record, at_url = read_json_object(self.path / RECORD), self.remote.files(_STAGES)
        for name in {*record["stages"].values()}:
            if f"{name}/{STAGE_RECORD}" not in at_url and (self.stages_path / name / STAGE_RECORD).is_file():
                # As by whoever tidies up a store.
                self._put_stage(self.stages_path / name)
        self.remote.remove([RECORD])
        names = [name for name in record["files"] if name != RECORD]
        for name in names:
            if (self.path / name).is_dir():
                self.remote.put_folder(self.path / name, name)
        self.remote.put({name: self.path / name for name in names if (self.path / name).is_file()})
        self._remove_from_url()
        self._put_unfinished()
        self.remote.put({RECORD: self.path / RECORD})

    def _remove_from_url(self) -> None:
        """Remove earlier results, stages of none, and what workers have left, but not what another run works on."""
        kept, own_names = (
            self.kept_stages(),
            {path.relative_to(self.path).as_posix() for path in files_below(self.path)},
        )
        is_alone = not (self.path / UNFINISHED).exists()
        gone = dict.fromkeys((JOBS, PARTS, PHOTOGRAPHS, UNFINISHED)) if is_alone else {}
        for name in self.remote.files():
            first, *parts = PurePosixPath(name).parts
            if first == _STAGES and parts[0] not in kept:
                # The record first, as where a stage is put again.
                gone |= dict.fromkeys((f"{_STAGES}/{parts[0]}/{STAGE_RECORD}", f"{_STAGES}/{parts[0]}"))
            elif first in NAMES and name not in own_names:
                gone[name] = None
        self.remote.remove(gone)
