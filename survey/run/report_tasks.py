"""The pictures of a report, drawn by the worker processes of a run.

Workers read what they draw from a file, in which the columns of the points are references to the file of the bed.
"""

from __future__ import annotations

import gc
import pickle
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from mmap import mmap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fields.sweep.kernels.arrays import trim_heap
from geo.files import reporting_disk_errors, write_whole
from survey.display.quantities import foot_m, lengths_in_feet
from survey.report.facts import ReportFacts
from survey.report.pictures import drawings_of
from survey.report.raster import Picture
from survey.run.worker_task import require_code, with_absolute_paths
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.run.workers import Workers

_FACTS = "facts.pickle"


def draw_on(workers: Workers, scratch: Path, folder: Path, facts: ReportFacts) -> Iterator[Picture]:
    """As `survey.report.pictures.draw_pictures`, on workers: all pictures are under way when this returns.

    Parameters
    ----------
    scratch : Path
        Folder for the file that the workers read.
    """
    place = scratch.absolute() / f"report-{uuid.uuid4().hex}"
    with reporting_disk_errors(place):
        place.mkdir()
    names, code = list(drawings_of(facts)), code_hash()
    sent = replace(facts, survey=with_absolute_paths(facts.survey))
    # Found already, from all points.
    sent.__dict__["checkpoints"] = facts.checkpoints
    with write_whole(place / _FACTS) as stream:
        _Pickler(stream).dump(sent)
    under_way = [workers.submit(_draw, place / f"{name}.png", code) for name in names]
    return _moved(under_way, folder, workers)


def _moved(
    under_way: Sequence[Callable[[], Picture]], folder: Path, workers: Workers
) -> Generator[Picture, None, None]:
    """The pictures in their folder: what a worker of an earlier run still writes does not reach it."""
    try:
        for result in under_way:
            picture = result()
            path = folder / picture.path.name
            with reporting_disk_errors(path):
                picture.path.replace(path)
            yield replace(picture, path=path)
    finally:
        # Workers of a cluster outlive the run, and would keep its files open.
        workers.on_each(_forget)
        _forget()


def _draw(picture: Path, code: str) -> Picture:
    """Draw the picture of this name from the facts beside it."""
    require_code(code)
    foot, drawings = _drawings(picture.with_name(_FACTS))
    try:
        with lengths_in_feet(foot):
            return drawings[picture.stem](picture)
    finally:
        # Figures hold their canvas and it holds them.
        gc.collect()
        trim_heap()


@lru_cache(maxsize=1)
def _drawings(path: Path) -> tuple[float | None, dict[str, Callable[[Path], Picture]]]:
    """Foot that lengths are shown in [m], or None, and `drawings_of` the facts in a file."""
    facts = pickle.loads(path.read_bytes())
    foot = foot_m(facts.survey.config.report.units, facts.survey.frame.crs)
    with lengths_in_feet(foot):
        return foot, drawings_of(facts)


def _forget() -> None:
    _drawings.cache_clear()


class _Pickler(pickle.Pickler):
    """Pickles arrays that are mapped from files as references to these."""

    def reducer_override(self, given: Any) -> Any:
        """How to make an object again."""
        mapped = given.base if type(given) is np.ndarray else None
        if not isinstance(mapped, np.memmap) or mapped.filename is None or not _is_whole(given, mapped):
            return NotImplemented
        order = "C" if mapped.flags.c_contiguous else "F"
        return _mapped, (Path(mapped.filename).absolute(), mapped.dtype, mapped.offset, mapped.shape, order)


def _is_whole(array: np.ndarray, mapped: np.memmap) -> bool:
    """Whether an array is all of what is mapped, and not a part of something mapped."""
    return isinstance(mapped.base, mmap) and array.__array_interface__ == mapped.__array_interface__


def _mapped(path: Path, dtype: np.dtype, offset: int, shape: tuple[int, ...], order: Any) -> np.ndarray:
    return np.memmap(path, dtype, "c", offset, shape, order).view(np.ndarray)
