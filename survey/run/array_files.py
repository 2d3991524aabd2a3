"""Arrays in files of their own, of which parts are read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from geo.files import disk_refusals


class FileArray:
    """Array (height, width) in a file; rows are read on demand and not cached."""

    def __init__(self, path: Path, array: np.ndarray):
        self._path, self.shape, self._dtype = path, array.shape, array.dtype
        with disk_refusals(path):
            path.write_bytes(np.ascontiguousarray(array).tobytes())

    def __getitem__(self, part: tuple[slice, slice]) -> np.ndarray:
        rows, columns = part
        height, width = self.shape
        first, last, _ = rows.indices(height)
        count = max(last - first, 0)
        offset = first * width * self._dtype.itemsize
        whole = np.fromfile(self._path, self._dtype, count * width, offset=offset).reshape(count, width)
        return whole[:, columns]


class ArrayFiles:
    """Makes a `FileArray` of each array, in a folder that is made here, and empty."""

    def __init__(self, folder: Path):
        # Workers open them by this path, whatever their working directory.
        self._folder, self._count = folder.absolute(), 0
        with disk_refusals(folder):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()

    def __call__(self, array: np.ndarray) -> FileArray:
        self._count += 1
        return FileArray(self._folder / f"{self._count}.raw", array)
