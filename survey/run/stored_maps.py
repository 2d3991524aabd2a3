"""Height maps and solved maps on disk: scratch files during a stage, one archive after it."""

import dataclasses
import shutil
from collections.abc import Callable, Iterable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fields.image_store import Masks
from fields.sweep.maps import HeightMap, MemoryBudget
from geo.files import reporting_disk_errors
from survey.run.stored import StoredArrays, unreadable, write_arrays

# Bytes of maps that are worked on in memory; files for the others take a twentieth of the time of the sweep.
IN_MEMORY = 75_000_000

Kind = TypeVar("Kind")


class Scratch(MutableMapping[int, Kind]):
    """Maps of one kind by number: in memory while the budget lasts, the others each in a file of a folder of their own.

    The folder is made here. Maps in files are read from there whenever they are asked for.
    """

    def __init__(self, folder: Path, kind: type[Kind], budget: MemoryBudget):
        self._folder, self._kind, self._budget = folder, kind, budget
        self._held: dict[int, Kind] = {}
        self._written: set[int] = set()
        with reporting_disk_errors(folder):
            folder.mkdir()

    def __getitem__(self, number: int) -> Kind:
        if number in self._held:
            return self._held[number]
        if number not in self._written:
            raise KeyError(number)
        with reporting_disk_errors(self._path(number)), self._path(number).open("rb") as stream:
            return _made(self._kind, number, lambda _name: np.load(stream))

    def __setitem__(self, number: int, each: Kind) -> None:
        if number in self._held:
            self._budget.left += _bytes_of(self._held.pop(number))
        if number not in self._written and _bytes_of(each) <= self._budget.left:
            self._budget.left -= _bytes_of(each)
            self._held[number] = each
            return
        with reporting_disk_errors(self._path(number)), self._path(number).open("wb") as stream:
            for name in _names(self._kind):
                np.save(stream, getattr(each, name))
        self._written.add(number)

    def __delitem__(self, number: int) -> None:
        if number in self._held:
            self._budget.left += _bytes_of(self._held.pop(number))
            return
        self._written.remove(number)
        with reporting_disk_errors(self._path(number)):
            self._path(number).unlink()

    def __iter__(self) -> Iterator[int]:
        return iter(sorted({*self._held, *self._written}))

    def __len__(self) -> int:
        return len(self._held) + len(self._written)

    def __contains__(self, number: object) -> bool:
        return number in self._held or number in self._written

    def _path(self, number: int) -> Path:
        return self._folder / f"{number}.npy"


def _bytes_of(each: Any) -> int:
    return sum(getattr(each, name).nbytes for name in _names(type(each)))


@contextmanager
def map_store(folder: Path, kind: type[Kind], in_memory: int = IN_MEMORY) -> Iterator[Callable[[], Scratch[Kind]]]:
    """Places for maps, the first bytes of them in memory, the others in a folder that is removed in the end."""
    number, budget = count(), MemoryBudget(in_memory)
    with reporting_disk_errors(folder):
        folder.mkdir()
    try:
        yield lambda: Scratch(folder / str(next(number)), kind, budget)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def save_maps(path: str | Path, kind: type[Kind], maps: Iterable[Kind]) -> None:
    """Write height maps or solved maps, of any sizes, into one .npz file, one after the other."""
    views = []

    def named() -> Iterator[tuple[str, np.ndarray]]:
        for number, each in enumerate(maps):
            views.append(each.view if isinstance(each, HeightMap) else number)
            yield from ((f"{name}_{number}", getattr(each, name)) for name in _names(kind))
        yield "views", np.array(views, dtype=np.int64)

    write_arrays(path, named())


class Stored(Sequence[Kind]):
    """The maps of a file of `save_maps`, in their order; each is read when it is asked for.

    So many bytes ``in_memory`` of them are kept after their first reading, read-only.
    """

    def __init__(self, path: str | Path, kind: type[Kind], in_memory: int = 0):
        self._arrays, self._kind = StoredArrays(path), kind
        self._budget, self._held = MemoryBudget(in_memory), dict[int, Kind]()
        self.views = [int(view) for view in self._arrays["views"]]  # Of height maps; of others their numbers
        for number in range(len(self.views)):
            for name in _names(kind):
                if f"{name}_{number}" not in self._arrays:
                    raise unreadable(path, f"it lacks the array {name}_{number}")

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, number):
        if number in self._held:
            return self._held[number]
        found = _made(self._kind, self.views[number], lambda name: self._arrays[f"{name}_{number}"])
        if _bytes_of(found) <= self._budget.left:
            for name in _names(self._kind):
                getattr(found, name).flags.writeable = False
            self._budget.left -= _bytes_of(found)
            self._held[number] = found
        return found


def save_masks(path: Path, masks: Sequence[np.ndarray]) -> None:
    """Write masks (height, width) bool, one bit a pixel, for `StoredMasks`."""
    shapes = [mask.shape for mask in masks]
    bits = ((str(number), np.packbits(mask)) for number, mask in enumerate(masks))
    write_arrays(path, chain([("shapes", np.array(shapes, dtype=np.int64).reshape(-1, 2))], bits))


class StoredMasks(Sequence[np.ndarray]):
    """Masks of a file of `save_masks`, each read when it is asked for."""

    def __init__(self, path: Path):
        self._arrays = StoredArrays(path)
        self.shapes: list[tuple[int, ...]] = [tuple(shape) for shape in self._arrays["shapes"].tolist()]

    def __len__(self) -> int:
        return len(self.shapes)

    def __getitem__(self, number):
        height, width = self.shapes[number]
        return np.unpackbits(self._arrays[str(number)], count=height * width).reshape(height, width).view(bool)


def load_masks(path: Path) -> Masks:
    """Masks of a file of `save_masks`, in memory."""
    stored = StoredMasks(path)
    masks = Masks(stored.shapes)
    for number, mask in enumerate(stored):
        masks[number] = mask
    return masks


def _names(kind: type) -> list[str]:
    return [item.name for item in dataclasses.fields(kind) if item.name != "view"]


def _made(kind: type[Kind], view: int, array: Callable[[str], np.ndarray]) -> Kind:
    arrays: dict[str, Any] = {name: array(name) for name in _names(kind)}
    return kind(**({"view": view} if kind is HeightMap else {}), **arrays)
