"""Record of exported files, so that those that are up to date are not written again."""

from __future__ import annotations

from pathlib import Path

from geo.errors import UnwritableFile
from survey.code_hash import code_hash
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions, Product
from survey.files.json_values import read_json_object, write_json
from survey.progress import current
from survey.stage_key import stage_key

_RECORD = "exports.json"


def key_of(product: Product, run: LoadedRun, options: ExportOptions) -> str:
    """A hash of all that a product depends on: the run's result, the options that it follows, and its code."""
    asked = {name: getattr(options, name) for name in product.takes}
    return stage_key(product.option, run.stages, asked, code_hash(product.write.__module__))


def is_current(run: LoadedRun, path: Path, key: str) -> bool:
    """Whether a file is the one that was written with this key, and unchanged since."""
    entry = read_json_object(run.folder.path / _RECORD).get(str(path.resolve()))
    return path.is_file() and entry == {"key": key, **_stamp(path)}


def note_written(run: LoadedRun, path: Path, key: str) -> None:
    """Note that a file was written with this key; a run that cannot be written to stays as it is."""
    record = run.folder.path / _RECORD
    known = {name: entry for name, entry in read_json_object(record).items() if Path(name).is_file()}
    try:
        write_json(record, known | {str(path.resolve()): {"key": key, **_stamp(path)}})
    except UnwritableFile as error:
        current().detail(f"{error}; the next export writes {path} again")


def _stamp(path: Path) -> dict[str, int]:
    status = path.stat()
    return {"bytes": status.st_size, "modified_ns": status.st_mtime_ns}
