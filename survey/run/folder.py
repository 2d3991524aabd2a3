"""The run folder: its contents, and which of them a later run may reuse.

RUN/cloud.las, report.json, report.html, settings.toml, plan.json, flight.json, result.json, log.txt, pictures/*.png,
stages/<name>-<key>/..., and sfm/ where poses had to be found.

A stage works in a fresh hidden folder that is renamed when the stage is finished, so that every folder under
``stages`` is complete; its name ends in a hash of all that the stage depends on, so that results of other settings are
kept side by side. One process at a time gives stages their place in a run; a lock ensures this. Workers of a cluster
may still write to hidden folders after a run that ended early; the next run removes them.
"""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.files.entries import require_plain_entries
from survey.files.json_values import read_json_object, write_json
from survey.files.outputs import ReadFiles, locked
from survey.progress import current
from survey.run import result
from survey.run.keys import Key
from survey.run.result import Owner
from survey.stage_key import code_hash
from survey.words import RUN_FOLDER, SFM_FOLDER

MARKER, STAGE_RECORD, _PART = ".bathynerf-run.json", "stage.json", ".part"
# As a path has it, with one slash.
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
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
    ...     folder = run.finished_stage("sweep", key)
    ...     if folder is None:
    ...         temp = run.open_stage("sweep")
    ...         save_arrays(temp / "heights.npz", heights=heights)
    ...         folder = run.finish_stage("sweep", key, temp)
    ...     heights = load_arrays(folder / "heights.npz")["heights"]
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
        self.sfm_path = self.path / SFM_FOLDER
        self.scratch_path = self.path / f".scratch{_PART}"
        self._held: ExitStack | None = None
        self._started: dict[Path, float] = {}
        self._quality: str | None = None

    def __enter__(self) -> RunDir:
        with ExitStack() as stack, reporting_disk_errors(self.path):
            require_plain_entries(self.path)
            self._require_ours_or_empty()
            self.stages_path.mkdir(parents=True, exist_ok=True)
            if not (self.path / MARKER).exists():
                self._mark({})
            busy = (
                f"the run {self.path} is being written by another process (number {{pid}}); wait until it ends, "
                "stop it, or name another run folder with -o"
            )
            stack.enter_context(locked(self.path, busy=busy))
            stack.callback(self._remove_parts)
            result.move_into_place(self.path)
            self._remove_parts()
            self._held = stack.pop_all()
        return self

    def __exit__(self, *exception) -> None:
        held, self._held = self._held, None
        if held is not None:
            held.__exit__(*exception)

    def claim(self, owner: Owner, *, is_inside: bool) -> None:
        """Note the survey that the run is of.

        ``is_inside``: the run lies in the folder of the survey, and is its own whatever became of its photographs.
        """
        before = Owner.from_record(read_json_object(self.path / MARKER))
        if before is not None and not is_inside:
            before.require_same(owner, self.path)
        if before != owner:
            self._mark(owner.as_record())

    def owner(self) -> Owner | None:
        """The survey whose run this is; None in a run of a version that did not keep it."""
        return Owner.from_record(read_json_object(self.path / MARKER))

    def _mark(self, owner: dict) -> None:
        made_by = {"made_by": f"bathynerf {importlib.metadata.version('bathynerf')}"}
        write_json(self.path / MARKER, made_by | owner)

    def require_run(self) -> None:
        """Raise SurveyError where the folder is not one that `bathynerf process` made."""
        require_plain_entries(self.path)
        if not self.path.is_dir():
            if _URL.match(str(self.path)):
                raise SurveyError(f"{self.path} is a URL; copy the run to this machine, and name the copy")
            what = "is a file" if self.path.exists() else "does not exist"
            raise SurveyError(f"the run folder {self.path} {what}; name the folder that process wrote")
        if not (self.path / MARKER).is_file():
            default = self.path / RUN_FOLDER
            remedy = f"name {default}" if (default / MARKER).is_file() else "name the folder that process wrote"
            raise SurveyError(f"{self.path} is no run folder; {remedy}")
        if not result.is_in_place(self.path):
            raise SurveyError(
                f"`bathynerf process` was stopped while it put its result into {self.path}; run the same command again"
            )

    def result(self) -> dict:
        """The contents of result.json; see `survey.run.result.read_record`."""
        return result.read_record(self.path)

    def inputs(self) -> ReadFiles:
        """Files of the run that other commands read or must not overwrite."""
        files = (self.path / name for name in result.NAMES)
        return ReadFiles.of(*files) + ReadFiles((), (self.stages_path, self.pictures_path, self.sfm_path))

    def warn_if_unfinished(self) -> None:
        """Warn where a later `process` began here and did not finish, so that the result is that of the one before."""
        if result.unfinished(self.path):
            current().warn(
                f"a `bathynerf process` in {self.path} with other settings has not finished; this is the result of "
                f"{self.result().get('finished')}, with the settings in settings.toml beside it"
            )

    def open_result(self, quality: str) -> Path:
        """An empty folder for a new result of a quality; `publish` puts it in its place."""
        folder = self.path / f".result{_PART}"
        with reporting_disk_errors(folder):
            result.begin(self.path, folder, quality)
        self._quality = quality
        return folder

    def publish(self, folder: Path, *, quality: str, stages: dict[str, Path]) -> None:
        """Let the result in the folder of `open_result` replace the one before; remove results no longer needed.

        ``stages`` are the folders of the stages that it was made from, by name.
        """
        finished = time.strftime("%Y-%m-%d %H:%M:%S")
        names = {name: place.name for name, place in stages.items()}
        with reporting_disk_errors(self.path):
            result.publish(self.path, folder, quality=quality, finished=finished, stages=names)
            result.prune(self.path)

    def finished_stage(self, name: str, key: Key, leaves: Iterable[str] = ()) -> Path | None:
        """The folder of a stage that was finished with this key and has these files; None if there is none."""
        folder = self.place(name, key)
        is_whole = _record(folder).get("key") == key.digest and all((folder / leaf).is_file() for leaf in leaves)
        return folder if is_whole else None

    def latest_stage_json(self, name: str) -> dict:
        """Contents of a JSON file of the latest stage that has one; empty where none has."""
        found = [path for path in self.stages_path.glob(f"*/{name}") if path.parent.name[0] != "."]
        return read_json_object(max(found, key=lambda path: path.stat().st_mtime)) if found else {}

    def recompute_reason(self, name: str, key: Key) -> str | None:
        """Reason why a stage is computed again, in words; None if it never was.

        The finished result of this stage that has most in common with the key shows what changed.
        """
        records = [_record(folder) for folder in self.stages_path.glob(f"{name}-*")]
        found = [key.changes_from(record["parts"]) for record in records if isinstance(record.get("parts"), dict)]
        return key.sentence_of(min(found, key=len)) if found else None

    def open_stage(self, name: str) -> Path:
        """A fresh folder for a stage to work in; `finish_stage` gives it its place."""
        if self._held is None:
            raise RuntimeError("open_stage outside a with block: stages are written while the run is locked")
        folder = self.stages_path / f".{name}{_PART}"
        with reporting_disk_errors(folder):
            if folder.exists():
                shutil.rmtree(folder)
            folder.mkdir()
        self._started[folder] = time.monotonic()
        return folder

    def finish_stage(self, name: str, key: Key, temp: Path, seconds: float | None = None) -> Path:
        """Put the folder of `open_stage` in its place, with a record of key, seconds and versions; return it.

        ``seconds`` are those of another process, which made the folder.
        """
        seconds = time.monotonic() - self._started.pop(temp) if seconds is None else seconds
        record = {"key": key.digest, "parts": key.parts, "seconds": round(seconds, 3), "versions": versions()}
        write_json(temp / STAGE_RECORD, record)
        place = self.place(name, key)
        with reporting_disk_errors(place):
            # Computed again on demand, or with a record that cannot be read.
            shutil.rmtree(place, ignore_errors=True)
            temp.rename(place)
        if self._quality is not None:
            result.note_finished(self.path, self._quality, place.name)
        return place

    def load_stage(self, name: str) -> Path:
        """The folder of a stage of the result that stands in the run."""
        folder = self.stages_path / self.result().get("stages", {}).get(name, f"{name}-none")
        if not _record(folder):
            raise SurveyError(
                f"the run {self.path} has no finished stage {name}; run the same `bathynerf process` again, "
                "it resumes where it stopped"
            )
        return folder

    def place(self, name: str, key: Key) -> Path:
        """Folder of a stage with a key, whether it is there or not."""
        return self.stages_path / f"{name}-{key.digest[:12]}"

    def _require_ours_or_empty(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise SurveyError(f"the run folder {self.path} is a file; name a folder with -o")
        if not self.path.is_dir() or (self.path / MARKER).is_file():
            return
        # Hidden files are left by file managers and by a first start that was killed.
        others = sorted(p.name for p in self.path.iterdir() if p.name[0] != "." and p.name != SFM_FOLDER)
        if others:
            raise SurveyError(
                f"the folder {self.path} is not empty and is no run (it has {others[0]}); name a new or "
                "empty folder with -o"
            )

    def _remove_parts(self) -> None:
        """Remove what a run that was killed, or failed, left unfinished: folders of stages and half-written files."""
        for folder in self.stages_path.glob(f".*{_PART}"):
            shutil.rmtree(folder, ignore_errors=True)
        for part in self.path.glob(f".*{_PART}"):
            if part.is_dir():
                shutil.rmtree(part, ignore_errors=True)
            else:
                part.unlink(missing_ok=True)


def _record(folder: Path) -> dict:
    """The record of a finished stage; empty if there is none, or none that can be read."""
    return read_json_object(folder / STAGE_RECORD)


def seconds_of(folder: Path) -> float:
    """Computation time [s] of the finished stage in a folder."""
    return _record(folder)["seconds"]


def versions_of(folder: Path) -> dict[str, str]:
    """Versions of the libraries that computed the finished stage in a folder, by name."""
    return _record(folder)["versions"]


def versions() -> dict[str, str]:
    """Versions of the installed libraries that compute, by name."""
    program = f"{importlib.metadata.version('bathynerf')}+{code_hash()[:8]}"
    found = {"bathynerf": program, "python": ".".join(str(v) for v in sys.version_info[:3])}
    for name in _NAMED_VERSIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
