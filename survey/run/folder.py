"""The run folder: its contents, the survey that it belongs to, and what a later run may reuse.

RUN/cloud.las, report.json, report.html, settings.toml, plan.json, flight.json, result.json, log.txt, pictures/*.png,
stages/<name>-<key>/..., and sfm/ where poses had to be found.

A stage works in a fresh hidden folder that is renamed when it is finished, so that every folder under ``stages`` is
complete; its name ends in a hash of all that it depends on, so that results of other settings are kept side by side.
One process at a time writes a run, which a lock ensures; what workers of a cluster still write to hidden folders after
a run that ended early, the next run removes.

A result, cloud, report, settings and plan, is written into a hidden folder, which renaming commits; its files are then
moved to their places, by the next process where this one is killed. So they always belong together.
"""

from __future__ import annotations

import importlib.metadata
import json
import re
import shutil
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.files.paths import ReadFiles, locked, require_plain_entries
from survey.progress import current
from survey.stage_key import code_hash, content_hash, stage_key
from survey.words import RUN_FOLDER, SFM_FOLDER

MARKER, STAGE_RECORD, _PART = ".bathynerf-run.json", "stage.json", ".part"
GAPS = "gaps.npz"
# Files and folders of a result; its record is moved last.
NAMES = (
    "settings.toml", "plan.json", "cloud.las", GAPS, "flight.json", "adjustment.json", "adjustment.npz", "cameras.csv",
    "sparse", "report.json", "report.html", "pictures", "result.json",
)  # fmt: skip
RECORD = "result.json"
# A complete result on its way to its place, and the finished stages of results that are not finished, by quality.
_COMPLETE, UNFINISHED = ".result.whole", ".unfinished.json"
# As a path has it, with one slash.
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
_NAMED_VERSIONS = ("numpy", "scipy", "drjit", "torch", "opencv-python-headless", "pyproj", "laspy", "pycolmap")

# What a stage depends on: a hash for each part of the job, or the folder of another stage, by its name.
Key = Mapping[str, str]


@dataclass(frozen=True)
class Owner:
    """A survey as a run folder knows it."""

    name: str  # For messages only: it may change
    # name to bytes: cameras give the same names again in every flight, but hardly the same sizes too
    photographs: dict[str, int]
    # name to SHA-256: photographs that are not compressed are of one size
    contents: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, images: Mapping[str, Path]) -> Owner:
        """Owner for a survey with these images, name to path."""
        sizes = {image: path.stat().st_size for image, path in images.items()}
        return cls(name, sizes, {image: content_hash(path) for image, path in images.items()})

    @classmethod
    def from_record(cls, record: Mapping) -> Owner | None:
        """Owner from its record; None before a run is claimed, and of a run of a version that kept none."""
        return cls(record["survey"], record["photographs"], record.get("contents", {})) if "survey" in record else None

    def require_unchanged(self, name: str, path: Path) -> None:
        """Raise SurveyError where the file at a path is not the photograph of this name, by size and content."""
        before, now, content = self.photographs.get(name), path.stat().st_size, self.contents.get(name)
        if before is not None and before != now:
            differs = f"it has {now} bytes, expected {before}"
        elif content is not None and content != content_hash(path):
            differs = "it has the same size and another content"
        else:
            return
        raise SurveyError(
            f"{path} is not the photograph that the run used: {differs}; put the photographs of the run there, name "
            "the folder of the survey with --survey DIR, or process again"
        )

    def require_same(self, other: Owner, run: Path) -> None:
        """Raise SurveyError where a run of this survey is to become one of another.

        Photographs may come, go and change, but half of those of the smaller of the two have to be the same.
        """
        same = self.photographs.items() & other.photographs.items()
        if self.contents:
            same = {(name, size) for name, size in same if self.contents.get(name) == other.contents.get(name)}
        if 2 * len(same) < min(len(self.photographs), len(other.photographs)):
            raise SurveyError(
                f"the run folder {run} belongs to another survey, {self.name}, with other photographs ({len(same)} of "
                f"{len(other.photographs)} have the same name, size and content there); name another folder with -o, "
                "or remove that one"
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
            self._move_into_place()
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
        before = self.owner()
        if before is not None and not is_inside:
            before.require_same(owner, self.path)
        if before != owner:
            self._mark({"survey": owner.name, "photographs": owner.photographs, "contents": owner.contents})

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
        if (self.path / _COMPLETE).exists():
            raise SurveyError(
                f"`bathynerf process` was stopped while it put its result into {self.path}; run the same command again"
            )

    def result(self) -> dict:
        """The contents of result.json: ``quality``, ``finished``, ``stages`` (name to folder), and ``others``.

        ``others`` has the stages of the latest result of each other quality, by quality. Empty without a result.
        """
        return read_json_object(self.path / RECORD)

    def _unfinished(self) -> dict[str, list[str]]:
        """Finished stages of each result that is not finished, by its quality."""
        return read_json_object(self.path / UNFINISHED)

    def inputs(self) -> ReadFiles:
        """Files of the run that other commands read or must not overwrite."""
        files = (self.path / name for name in NAMES)
        return ReadFiles.of(*files) + ReadFiles((), (self.stages_path, self.pictures_path, self.sfm_path))

    def warn_if_unfinished(self) -> None:
        """Warn where a later `process` began here and did not finish, so that the result is that of the one before."""
        if self._unfinished():
            current().warn(
                f"a `bathynerf process` in {self.path} with other settings has not finished; this is the result of "
                f"{self.result().get('finished')}, with the settings in settings.toml beside it"
            )

    def open_result(self, quality: str) -> Path:
        """An empty folder for a new result of a quality, noted as being worked on; `publish` puts it in its place."""
        folder = self.path / f".result{_PART}"
        with reporting_disk_errors(folder):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            write_json(self.path / UNFINISHED, {quality: [], **self._unfinished()})
        self._quality = quality
        return folder

    def publish(self, folder: Path, *, quality: str, stages: dict[str, Path]) -> None:
        """Let the result in the folder of `open_result` replace the one before; remove results no longer needed.

        ``stages`` are the folders of the stages that it was made from, by name.
        """
        with reporting_disk_errors(self.path):
            before = self.result()
            others = {**before.get("others", {})} | ({before["quality"]: before["stages"]} if before else {})
            record = {
                "quality": quality,
                "finished": time.strftime("%Y-%m-%d %H:%M:%S"),
                "stages": {name: place.name for name, place in stages.items()},
                "others": {other: names for other, names in others.items() if other != quality},
                "files": [name for name in NAMES if (folder / name).exists()] + [RECORD],
            }
            write_json(folder / RECORD, record)
            folder.rename(self.path / _COMPLETE)
            self._move_into_place()
            kept = self.kept_stages()
            for stage in self.stages_path.iterdir():
                if stage.is_dir() and stage.name[0] != "." and stage.name not in kept:
                    shutil.rmtree(stage, ignore_errors=True)

    def _move_into_place(self) -> None:
        """Move a complete result to its place, replacing the old one; does nothing without one."""
        complete = self.path / _COMPLETE
        # Where the record is gone, everything else has been moved.
        if (complete / RECORD).exists():
            new = json.loads((complete / RECORD).read_text(encoding="utf-8"))
            others = {name: stages for name, stages in self._unfinished().items() if name != new["quality"]}
            if others:
                write_json(self.path / UNFINISHED, others)
            else:
                (self.path / UNFINISHED).unlink(missing_ok=True)
            for name in NAMES:
                if (complete / name).exists() or name not in new["files"]:
                    _remove(self.path / name)
                if (complete / name).exists():
                    (complete / name).rename(self.path / name)
        shutil.rmtree(complete, ignore_errors=True)

    def kept_stages(self) -> set[str]:
        """Folders of the stages of the latest result of each quality, and of results that are not finished."""
        record = self.result()
        kept = {name for stages in (record["stages"], *record["others"].values()) for name in stages.values()}
        return kept | {name for names in self._unfinished().values() for name in names}

    def finished_stage(self, name: str, key: Key, leaves: Iterable[str] = ()) -> Path | None:
        """The folder of a stage that was finished with this key and has these files; None if there is none."""
        folder = self.place(name, key)
        is_whole = stage_record(folder).get("key") == stage_key(dict(key)) and all(
            (folder / leaf).is_file() for leaf in leaves
        )
        return folder if is_whole else None

    def latest_stage_json(self, name: str) -> dict:
        """Contents of a JSON file of the latest stage that has one; empty where none has."""
        found = [path for path in self.stages_path.glob(f"*/{name}") if path.parent.name[0] != "."]
        return read_json_object(max(found, key=lambda path: path.stat().st_mtime)) if found else {}

    def earlier_keys(self, name: str) -> list[Key]:
        """Keys with which a stage was finished before."""
        records = [stage_record(folder) for folder in self.stages_path.glob(f"{name}-*")]
        return [record["parts"] for record in records if isinstance(record.get("parts"), dict)]

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
        record = {"key": stage_key(dict(key)), "parts": dict(key), "seconds": round(seconds, 3), "versions": versions()}
        write_json(temp / STAGE_RECORD, record)
        place = self.place(name, key)
        with reporting_disk_errors(place):
            # Computed again on demand, or with a record that cannot be read.
            shutil.rmtree(place, ignore_errors=True)
            temp.rename(place)
        if self._quality is not None:
            # Kept for when the work goes on.
            others = self._unfinished()
            finished = [*others.get(self._quality, []), place.name]
            write_json(self.path / UNFINISHED, others | {self._quality: finished})
        return place

    def load_stage(self, name: str) -> Path:
        """The folder of a stage of the result that stands in the run."""
        folder = self.stages_path / self.result().get("stages", {}).get(name, f"{name}-none")
        if not stage_record(folder):
            raise SurveyError(
                f"the run {self.path} has no finished stage {name}; run the same `bathynerf process` again, "
                "it resumes where it stopped"
            )
        return folder

    def place(self, name: str, key: Key) -> Path:
        """Folder of a stage with a key, whether it is there or not."""
        return self.stages_path / f"{name}-{stage_key(dict(key))[:12]}"

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
        for part in (*self.stages_path.glob(f".*{_PART}"), *self.path.glob(f".*{_PART}")):
            with suppress(OSError):
                _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def run_in(path: Path) -> Path:
    """The run folder at a path: that of the survey, where the path is the folder of one."""
    within = path / RUN_FOLDER
    return within if (within / MARKER).is_file() and not (path / MARKER).is_file() else path


def stage_record(folder: Path) -> dict:
    """The record of a finished stage; empty if there is none, or none that can be read."""
    return read_json_object(folder / STAGE_RECORD)


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
