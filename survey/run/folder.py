"""The run folder: what a run leaves behind, where, and what of it an interrupted run may use again.

RUN/cloud.las, report.json, report.html, settings.toml, plan.json, log.txt, pictures/*.png, stages/<name>/...,
and sfm/ where poses had to be found.

A stage works in a fresh hidden folder that is renamed when the stage is finished, so that what stands under
``stages`` is whole. One process at a time writes to a run; a lock says so.
"""

from __future__ import annotations

import fcntl
import importlib.metadata
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import BinaryIO

from geo.files import disk_refusals, write_whole
from survey.errors import SurveyError
from survey.outputs import Inputs
from survey.run.stored import load_arrays, save_arrays
from survey.stage_key import code_version, stage_key

__all__ = ["RunDir", "load_arrays", "save_arrays", "stage_key", "versions"]

_MARKER, _LOCK, _RECORD, _PART = ".bathynerf-run.json", ".lock", "stage.json", ".part"
# Structure from motion works there before anything else of a run exists.
_BEFORE = ("sfm",)
_NAMED_VERSIONS = (
    "numpy",
    "scipy",
    "drjit",
    "torch",
    "opencv-python-headless",
    "pyproj",
    "laspy",
    "pycolmap",
)


class RunDir:
    """A run folder.

    Reading needs no more than the path. Writing happens in a ``with`` block, which makes the folder, marks it
    as a run and locks it against other processes:

    >>> with RunDir("survey/bathynerf") as run:                              # doctest: +SKIP
    ...     key = stage_key("sweep", settings, image_paths)
    ...     if not run.stage_is_current("sweep", key):
    ...         folder = run.open_stage("sweep")
    ...         save_arrays(folder / "heights.npz", heights=heights)
    ...         run.finish_stage("sweep", key, folder)
    ...     heights = load_arrays(run.load_stage("sweep") / "heights.npz")["heights"]

    Attributes
    ----------
    path, cloud_path, report_json_path, report_html_path, settings_path, plan_path, log_path, pictures_path,
    stages_path : Path

    Raises
    ------
    SurveyError
        On entering, if the folder holds something else or is in use by another process.
    UnwritableFile
        If the folder cannot be made or written to.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.cloud_path = self.path / "cloud.las"
        self.report_json_path = self.path / "report.json"
        self.report_html_path = self.path / "report.html"
        self.settings_path = self.path / "settings.toml"
        self.plan_path = self.path / "plan.json"
        self.log_path = self.path / "log.txt"
        self.pictures_path = self.path / "pictures"
        self.stages_path = self.path / "stages"
        self._lock: BinaryIO | None = None
        self._started: dict[Path, float] = {}

    def __enter__(self) -> RunDir:
        with disk_refusals(self.path):
            self._require_ours_or_empty()
            self.stages_path.mkdir(parents=True, exist_ok=True)
            self.pictures_path.mkdir(exist_ok=True)
            if not (self.path / _MARKER).exists():
                made_by = {"made_by": f"bathynerf {importlib.metadata.version('bathynerf')}"}
                self.write_text(self.path / _MARKER, json.dumps(made_by))
            self._lock = _locked(self.path)
        self._remove_parts()
        return self

    def __exit__(self, *_exception) -> None:
        self._remove_parts()
        (self.path / _LOCK).unlink(missing_ok=True)
        self._lock.close()
        self._lock = None

    def require_run(self) -> None:
        """Raise SurveyError where the folder is not one that `bathynerf process` made."""
        if not self.path.is_dir():
            what = "is a file" if self.path.exists() else "does not exist"
            raise SurveyError(f"the run folder {self.path} {what}; name the folder that process wrote")
        if not (self.path / _MARKER).is_file():
            default = self.path / "bathynerf"
            mend = f"name {default}" if (default / _MARKER).is_file() else "name the folder that process wrote"
            raise SurveyError(f"{self.path} is no run folder; {mend}")

    def inputs(self) -> Inputs:
        """What other commands read of the run, or would spoil."""
        files = (self.cloud_path, self.report_json_path, self.report_html_path, self.settings_path, self.plan_path)
        folders = (self.stages_path, self.pictures_path, *(self.path / name for name in _BEFORE))
        return Inputs.of(*files, *folders)

    def stage_is_current(self, name: str, key: str) -> bool:
        """Whether a stage was finished with this key (see `stage_key`), so that its result can be used."""
        return self._record(name).get("key") == key

    def stage_seconds(self, name: str) -> float | None:
        """How long a finished stage took when it was computed [s]; None if it is not finished."""
        return self._record(name).get("seconds")

    def open_stage(self, name: str) -> Path:
        """A fresh folder for a stage to work in; `finish_stage` gives it its place."""
        if self._lock is None:
            raise RuntimeError("open_stage outside a with block: stages are written while the run is locked")
        folder = self.stages_path / f".{name}{_PART}"
        with disk_refusals(folder):
            if folder.exists():
                shutil.rmtree(folder)
            folder.mkdir()
        self._started[folder] = time.monotonic()
        return folder

    def finish_stage(self, name: str, key: str, temp: Path) -> Path:
        """Put the folder of `open_stage` in its place, with a record of key, seconds and versions; return it.

        An older result of the stage is replaced in the moment the new one is whole.
        """
        seconds = round(time.monotonic() - self._started.pop(temp), 3)
        record = {"key": key, "seconds": seconds, "versions": versions()}
        self.write_text(temp / _RECORD, json.dumps(record, indent=2))
        place, old = self.stages_path / name, self.stages_path / f".{name}.old{_PART}"
        with disk_refusals(place):
            if place.exists():
                place.rename(old)
            temp.rename(place)
            shutil.rmtree(old, ignore_errors=True)
        return place

    def load_stage(self, name: str) -> Path:
        """The folder of a finished stage.

        Raises
        ------
        SurveyError
            If there is none.
        """
        folder = self.stages_path / name
        if not self._record(name):
            raise SurveyError(
                f"the run {self.path} has no finished stage {name}; give the same `bathynerf process` again, "
                "it goes on where it stopped"
            )
        return folder

    def write_text(self, path: Path, text: str) -> None:
        """Write a text file as UTF-8, whole or not at all."""
        with write_whole(path) as stream:
            stream.write(text.encode())

    def _record(self, name: str) -> dict:
        """The record of a finished stage; empty if there is none, or none that can be read."""
        try:
            record = json.loads((self.stages_path / name / _RECORD).read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    def _require_ours_or_empty(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise SurveyError(f"the run folder {self.path} is a file; name a folder with -o")
        if not self.path.is_dir() or (self.path / _MARKER).is_file():
            return
        # Hidden files are left by file managers and by a first start that was killed.
        others = sorted(p.name for p in self.path.iterdir() if p.name[0] != "." and p.name not in _BEFORE)
        if others:
            raise SurveyError(
                f"the folder {self.path} is not empty and is no run (it has {others[0]}); name a new or "
                "empty folder with -o"
            )

    def _remove_parts(self) -> None:
        """Remove what a run that was killed, or failed, left unfinished: folders of stages and half-written files."""
        for folder in self.stages_path.glob(f".*{_PART}"):
            shutil.rmtree(folder, ignore_errors=True)
        for place in (self.path, self.pictures_path):
            for file in place.glob(f".*{_PART}"):
                file.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Versions of what computes, by name; what is not installed is left out."""
    found = {"bathynerf": code_version(), "python": ".".join(str(v) for v in sys.version_info[:3])}
    for name in _NAMED_VERSIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _locked(folder: Path) -> BinaryIO:
    """The lock file of a run, open and locked; the system frees it when its process ends, however it ends.

    Raises
    ------
    SurveyError
        If another process has it.
    """
    path = folder / _LOCK
    while True:
        lock = path.open("a+b")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.seek(0)
            pid = lock.read().decode(errors="replace").strip() or "unknown"
            lock.close()
            raise SurveyError(
                f"the run {folder} is being written by another process (number {pid}); wait until it ends, "
                "stop it, or name another run folder with -o"
            ) from error
        except OSError:
            lock.close()
            raise
        # Its last owner may have removed the file between our opening and our locking it.
        if path.exists() and path.stat().st_ino == os.fstat(lock.fileno()).st_ino:
            break
        lock.close()
    lock.truncate(0)
    lock.write(str(os.getpid()).encode())
    lock.flush()
    return lock
