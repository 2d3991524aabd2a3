"""`bathynerf export`: products of a finished run. Each is written completely or not at all, and only if out of date.

A record in the run folder states which products are up to date.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from geo.errors import UnwritableFile
from survey.errors import OutputError, SurveyError
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions, Product, require_lengths
from survey.export.registry import PRODUCTS
from survey.export.styles import write_style
from survey.files.json_values import read_json_object, write_json
from survey.files.outputs import ReadFiles, require_file, require_folder
from survey.progress import current
from survey.stage_key import code_hash, stage_key

_RECORD = "exports.json"


def export(run: str | Path, *, options: ExportOptions | None = None, **files: str | Path | None) -> list[Path]:
    """Write products of a run.

    Parameters
    ----------
    run : Path
        Folder that `bathynerf process` made.
    options : ExportOptions, optional
        Options of the products.
    **files : Path, optional
        The file of each wanted product, by its option, e.g. ``laz="bed.laz"``; see `survey.export.registry`.

    Returns
    -------
    list of Path
        The files, whether written now or unchanged since an earlier export.

    Raises
    ------
    SurveyError
        If a length is unusable, nothing is asked for, a name does not end as its product does, an option has no effect
        on any of them, the folder is not a run, or the run has not come as far as the cloud.
    OutputError
        If a file must not be written, see `survey.files.outputs`: a file that is there is replaced only where bathynerf
        wrote it.
    GeoError
        If a file cannot be written, or the CRS is unusable.
    """
    options = options or ExportOptions()
    require_lengths(options)
    wanted = _wanted(files)
    _require_effect([product for product, _ in wanted], options)
    with LoadedRun(run) as loaded:
        inputs = loaded.folder.inputs()
        for product, path in wanted:
            _require_writable(product, path, inputs)
        loaded.folder.warn_if_unfinished()
        if options.crs is not None and (warning := loaded.transformation_to(options.crs).warning) is not None:
            current().warn(warning)
        with current().stage("Export", len(wanted)) as stage:
            for product, path in wanted:
                _write(product, path, loaded, options)
                stage.advance()
    return [path for _, path in wanted]


def _write(product: Product, path: Path, loaded: LoadedRun, options: ExportOptions) -> None:
    """Write one product, unless the file is there and up to date."""
    if product.is_folder:
        product.write(path, loaded, options)
        return
    key = key_of(product, loaded, options)
    if is_current(loaded, path, key):
        current().note(f"{path}: unchanged")
    else:
        product.write(path, loaded, options)
        if product.style is not None:
            write_style(path, product.style)
        note_written(loaded, path, key)


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


def _require_writable(product: Product, path: Path, inputs: ReadFiles) -> None:
    if product.is_folder:
        require_folder(_name(product), path, inputs)
        if path.is_dir() and any(path.iterdir()) and not product.is_ours(path):
            raise OutputError(f"{_name(product)} names {path}, which holds other files; name a new or empty folder")
        return
    require_file(_name(product), path, inputs, kind=product.kind, is_of_kind=lambda _head: product.is_ours(path))


def _require_effect(products: list[Product], options: ExportOptions) -> None:
    """Raise SurveyError where an option was given that no wanted product follows."""
    for field in fields(ExportOptions):
        if getattr(options, field.name) == field.default or any(field.name in p.takes for p in products):
            continue
        takers = ", ".join(_name(product) for product in PRODUCTS if field.name in product.takes)
        option = "--" + field.name.removesuffix("_m").replace("_", "-")
        raise SurveyError(f"{option} has no effect on what is exported here; leave it out, or export one of {takers}")


def _name(product: Product) -> str:
    return f"--{product.option}"


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
