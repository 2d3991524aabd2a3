"""`bathynerf export`: products of a finished run. Each is written completely or not at all, and only if out of date.

A record in the run folder states which products are up to date, and what was in those that people edit: one that
somebody has changed since is not replaced.
"""

import hashlib
import sqlite3
from contextlib import closing
from dataclasses import fields
from pathlib import Path

from geo.errors import UnwritableFile
from survey.errors import OutputError, SurveyError
from survey.export.loaded import LoadedRun
from survey.export.registry import PRODUCTS, ExportOptions, Product, require_makeable
from survey.export.styles import write_style
from survey.files.json_values import read_json_object, write_json
from survey.files.paths import ReadFiles, require_file, require_folder
from survey.files.toml_table import option_name, require_options
from survey.progress import current
from survey.run.edits import FOLDER, edits_of
from survey.run.folder import RunDir
from survey.run.stored import FIELD_CLOUD, is_field, run_of
from survey.stage_key import code_hash, stage_key

_RECORD = "exports.json"
# What people edit in GIS, CAD and tables, and would lose; other products that were changed are written anew.
_EDITED = (".gpkg", ".geojson", ".dxf", ".csv", ".xyz")


def export(run: str | Path, *, options: ExportOptions | None = None, **files: str | Path | None) -> list[Path]:
    """Write products of a run, or of the surface of a field in its place; returns their files, written now or earlier.

    Each is named by its option, e.g. ``laz="bed.laz"``; see `survey.export.registry`.

    Raises SurveyError if a length is unusable, nothing is asked for, a name does not end as its product does, an option
    has no effect on any of them, the folder is not a run, or the run has not come as far as the cloud; or if a product
    cannot be made of the run with these options: all are checked before the first is computed; OutputError if a file
    must not be written, see `survey.files.paths`: a file that is there is replaced only where an export of this run
    wrote it, and one that people edit only as it was written; GeoError if a file cannot be written, or the CRS is
    unusable.
    """
    options = options or ExportOptions()
    require_options(options)
    wanted = _wanted(files)
    _require_effect([product for product, _ in wanted], options)
    field = Path(run) if is_field(Path(run)) else None
    if field and options.as_computed:
        raise SurveyError("--as-computed has no effect on a field, which has no edits; leave it out")
    with LoadedRun(run_of(field) if field else run, as_computed=options.as_computed, field=field) as loaded:
        if loaded.edits is not None:
            current().note(f"with edits: {loaded.edits}; without them: --as-computed")
        inputs = loaded.folder.inputs()
        if options.crs is not None and (warning := loaded.transformation_to(options.crs).warning) is not None:
            current().warn(warning)
        keys = {path: _key_of(product, loaded, options) for product, path in wanted}
        outdated = [
            (product, path)
            for product, path in wanted
            if not (path.is_file() and _entry(loaded, path).items() >= {"key": keys[path], **_stamp(path)}.items())
        ]
        for product, path in outdated:
            _require_writable(product, path, loaded, inputs)
        for product, path in outdated:
            require_makeable(product, path, loaded, options)
        loaded.folder.warn_if_unfinished()
        written: list[Path] = []
        with current().stage("Export", len(wanted)) as stage:
            try:
                for product, path in wanted:
                    if (product, path) in outdated:
                        product.function("write")(path, loaded, options)
                        if not product.is_folder and (style := product.function("style")) is not None:
                            write_style(path, style)
                        _note_written(loaded, path, keys[path])
                    else:
                        current().note(f"{path}: unchanged")
                    written.append(path)
                    stage.advance()
            finally:
                if written and len(written) < len(wanted):
                    left = ", ".join(str(path) for _, path in wanted[len(written) :])
                    current().warn(f"written before it ended: {', '.join(map(str, written))}; not written: {left}")
    return [path for _, path in wanted]


def cloud_of(run: str | Path) -> Path:
    """The file of the cloud of a run folder: cloud.las or, where it was edited, that without what was deleted.

    A file is taken for a cloud itself.
    """
    folder = RunDir(run)
    if not folder.path.is_dir():
        return folder.path
    if is_field(folder.path):
        return folder.path / FIELD_CLOUD
    folder.require_run()
    if edits_of(folder) is None:
        return folder.cloud_path
    return export(run, las=folder.path / FOLDER / folder.cloud_path.name)[0]


def _wanted(files: dict[str, str | Path | None]) -> list[tuple[Product, Path]]:
    """The products that are asked for, with their files, in the order of the registry."""
    unknown = files.keys() - {product.option for product in PRODUCTS}
    if unknown:
        raise TypeError(f"no product is called {sorted(unknown)[0]}")
    named = {option: Path(path) for option, path in files.items() if path is not None}
    wanted = [(product, named[product.option]) for product in PRODUCTS if product.option in named]
    if not wanted:
        options = ", ".join(f"{_name(product)} F" for product in PRODUCTS)
        raise SurveyError(f"nothing to export was named; give at least one of {options}")
    seen: dict[Path, Product] = {}
    for product, path in wanted:
        if not path.name.lower().endswith(product.suffixes):
            suffixes = " or ".join(product.suffixes)
            raise SurveyError(f"{_name(product)} names {path}; expected a name that ends in {suffixes}")
        other = seen.setdefault(path.resolve(), product)
        if other is not product:
            raise SurveyError(f"{_name(product)} and {_name(other)} both name {path}; give each a file of its own")
    return wanted


def _require_writable(product: Product, path: Path, run: LoadedRun, inputs: ReadFiles) -> None:
    entry = _entry(run, path)
    if product.is_folder:
        require_folder(_name(product), path, inputs)
        if path.is_dir() and any(path.iterdir()) and not entry:
            raise OutputError(f"{_name(product)} names {path}, which holds other files; name a new or empty folder")
        return
    require_file(_name(product), path, inputs, kind="an export of this run", is_of_kind=lambda _head: bool(entry))
    if not path.is_file():
        return
    as_it_is = {"sha256": _content_hash(path)} if "sha256" in entry else _stamp(path)
    if not as_it_is.items() <= entry.items():
        raise OutputError(
            f"{_name(product)} names {path}, which somebody has changed since bathynerf wrote it; remove it or choose "
            "another name"
        )


def _require_effect(products: list[Product], options: ExportOptions) -> None:
    """Raise SurveyError where an option was given that no wanted product follows."""
    for field in fields(ExportOptions):
        if getattr(options, field.name) == field.default or any(field.name in p.takes for p in products):
            continue
        takers = ", ".join(_name(product) for product in PRODUCTS if field.name in product.takes)
        raise SurveyError(
            f"{option_name(field)} has no effect on what is exported here; leave it out, or export one of {takers}"
        )


def _name(product: Product) -> str:
    return f"--{product.option}"


def _key_of(product: Product, run: LoadedRun, options: ExportOptions) -> str:
    """A hash of all that a product depends on: result and edits of the run, the options that it follows, its code."""
    asked = {name: getattr(options, name) for name in product.takes}
    edits = None if run.edits is None or not product.is_of_points else run.edits.path
    return stage_key(product.option, run.stages, asked, code_hash(), edits)


def _note_written(run: LoadedRun, path: Path, key: str) -> None:
    """Note that a file was written with this key; a run that cannot be written to stays as it is."""
    record = run.folder.path / _RECORD
    known = {name: entry for name, entry in read_json_object(record).items() if Path(name).exists()}
    edited = {"sha256": _content_hash(path)} if path.suffix.lower() in _EDITED else {}
    try:
        write_json(record, known | {str(path.resolve()): {"key": key, **_stamp(path), **edited}})
    except UnwritableFile as error:
        current().detail(f"{error}; the next export writes {path} again")


def _entry(run: LoadedRun, path: Path) -> dict[str, int | str]:
    """What the run has noted of a file; nothing where it has not written it."""
    entry = read_json_object(run.folder.path / _RECORD).get(str(path.resolve()))
    return entry if isinstance(entry, dict) else {}


def _stamp(path: Path) -> dict[str, int]:
    status = path.stat()
    return {"bytes": status.st_size, "modified_ns": status.st_mtime_ns}


def _content_hash(path: Path) -> str:
    """SHA-256 of a file; of a GeoPackage that of its tables, since a program that only shows it changes its bytes."""
    if path.suffix.lower() != ".gpkg":
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    found = hashlib.sha256()
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True)) as database:
        tables = database.execute("select name, sql from sqlite_master where type = 'table' order by name").fetchall()
        for table, form in tables:
            if not table.startswith(("sqlite_", "gpkg_", "rtree_")):
                found.update(form.encode())
                for row in database.execute(f'select * from "{table}"'):
                    found.update(repr((table, row)).encode())
    return found.hexdigest()
