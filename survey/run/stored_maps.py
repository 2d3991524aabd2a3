"""Height maps on the disk: while they are worked on one file each, and afterwards all in one file, read one by one."""

from __future__ import annotations

import dataclasses
import os
import shutil
import struct
import zipfile
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fields.sweep.maps import DepthMap, Keep
from geo.files import disk_refusals
from survey.run.stored import load_arrays, unreadable, write_arrays

# In the header of a file in a zip archive: the lengths of name and extra field, which follow it.
_LENGTHS_AT = 26
_FIELDS = tuple(item.name for item in dataclasses.fields(DepthMap) if item.name != "view")


class MapsOnDisk(MutableMapping[int, DepthMap]):
    """Maps by view, in a folder of their own; each is read from there whenever it is asked for.

    Parameters
    ----------
    folder : Path
        Made here, and empty.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._views: set[int] = set()
        with disk_refusals(folder):
            folder.mkdir()

    def __getitem__(self, view: int) -> DepthMap:
        if view not in self._views:
            raise KeyError(view)
        with disk_refusals(self._path(view)), self._path(view).open("rb") as stream:
            return DepthMap(view, **{name: np.load(stream) for name in _FIELDS})

    def __setitem__(self, view: int, m: DepthMap) -> None:
        with disk_refusals(self._path(view)), self._path(view).open("wb") as stream:
            for name in _FIELDS:
                np.save(stream, getattr(m, name))
        self._views.add(view)

    def __delitem__(self, view: int) -> None:
        self._views.remove(view)
        with disk_refusals(self._path(view)):
            self._path(view).unlink()

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._views))

    def __len__(self) -> int:
        return len(self._views)

    def __contains__(self, view: object) -> bool:
        return view in self._views

    def _path(self, view: int) -> Path:
        return self._folder / f"{view}.npy"


@contextmanager
def maps_on_disk(folder: Path) -> Iterator[Keep]:
    """Places for maps in a folder, which is made, and removed in the end."""
    number = iter(range(1_000_000))
    with disk_refusals(folder):
        folder.mkdir()
    try:
        yield lambda: MapsOnDisk(folder / str(next(number)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def save_depth_maps(path: str | Path, maps: Sequence[DepthMap]) -> None:
    """Write depth maps, of any sizes, into one .npz file, one after the other."""
    views = []

    def named() -> Iterator[tuple[str, np.ndarray]]:
        for number, m in enumerate(maps):
            views.append(m.view)
            yield from ((f"{name}_{number}", getattr(m, name)) for name in _FIELDS)
        yield "views", np.array(views, dtype=np.int64)

    write_arrays(path, named())


class StoredMaps(Sequence):
    """The depth maps of a file of `save_depth_maps`, in their order; each is read when it is asked for.

    Attributes
    ----------
    views : list of int

    Raises
    ------
    SurveyError
        If the file is missing or damaged, or was changed since.
    """

    def __init__(self, path: str | Path):
        self._path = Path(path)
        self.views = [int(view) for view in load_arrays(self._path, ("views",)).get("views", ())]
        with zipfile.ZipFile(self._path) as archive:
            self._start = {each.filename: each.header_offset for each in archive.infolist()}
        for number in range(len(self.views)):
            for name in _FIELDS:
                if f"{name}_{number}.npy" not in self._start:
                    raise unreadable(self._path, f"it lacks the array {name}_{number}")

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, number):
        """The map at a place in the order."""
        view = self.views[number]
        try:
            with self._path.open("rb") as stream:
                return DepthMap(view, **{name: _read(stream, self._start[f"{name}_{number}.npy"]) for name in _FIELDS})
        except (OSError, ValueError, EOFError) as error:
            raise unreadable(self._path, error) from error

    @cached_property
    def by_view(self) -> ByView:
        """The same maps by their views."""
        return ByView(self)


def _read(stream: BinaryIO, start: int) -> np.ndarray:
    """An array of a zip file that does not compress, whose local header begins there: in one go, not by parts."""
    stream.seek(start + _LENGTHS_AT)
    stream.seek(sum(struct.unpack("<HH", stream.read(4))), os.SEEK_CUR)
    return np.load(stream, allow_pickle=False)


class ByView(Mapping[int, DepthMap]):
    """Stored maps by their views."""

    def __init__(self, maps: StoredMaps):
        self._maps, self._number = maps, {view: number for number, view in enumerate(maps.views)}

    def __getitem__(self, view: int) -> DepthMap:
        return self._maps[self._number[view]]

    def __iter__(self) -> Iterator[int]:
        return iter(self._number)

    def __len__(self) -> int:
        return len(self._number)

    def __contains__(self, view: object) -> bool:
        return view in self._number
