"""Matching of names of photographs in files, which may differ in case, slashes, folder and suffix."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath

from survey.errors import ImageError

# Behind the name of a photograph, before its suffix, in the name of its mask.
MASK_ENDING = "_mask"


def name_key(name: str) -> str:
    """A name normalised for comparison: case, slashes and the encoding of accents."""
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()


class ImageNames:
    """The photographs of a survey, looked up by the names in a file: by the longest common tail of the paths."""

    def __init__(self, names: Iterable[str]):
        self._names = frozenset(names)
        self._by_last: dict[str, list[tuple[str, tuple[str, ...]]]] = {}
        for name in sorted(self._names):
            parts = _parts(name)
            for last in {parts[-1], PurePosixPath(parts[-1]).stem}:
                self._by_last.setdefault(last, []).append((name, parts))
        self._name_in_file: dict[str, str] = {}

    def find(self, name_in_file: str, where: str) -> str | None:
        """The photograph that a file means by a name; None where there is none.

        Case, slashes and the encoding of accents do not count; the suffix may be missing. One of the two paths may
        begin further up than the other, but their folders must not contradict each other. ``where`` is the file, and
        the line, for errors.
        """
        image = name_in_file if name_in_file in self._names else self._longest_tail(name_in_file, where)
        if image is None:
            return None
        # Of two names of one photograph the longer one is kept, since it has more folders to contradict.
        before = self._name_in_file.setdefault(image, name_in_file)
        if not _agree(_parts(before)[:-1], _parts(name_in_file)[:-1]):
            raise ImageError(
                f"{where}: {name_in_file} and {before} are two photographs, and both names fit {image} "
                "alone; keep the photographs in the folders that the file has, or remove the lines of the other one"
            )
        self._name_in_file[image] = max(before, name_in_file, key=lambda name: len(_parts(name)))
        return image

    def _longest_tail(self, name_in_file: str, where: str) -> str | None:
        parts = _parts(name_in_file)
        if not parts:
            return None
        ranks = {
            name: (min(len(own), len(parts)), len(own) == len(parts), own[-1] == parts[-1])
            for name, own in self._by_last.get(parts[-1], ())
            if _agree(own[:-1], parts[:-1])
        }
        best = [name for name, rank in ranks.items() if rank == max(ranks.values())]
        if len(best) > 1:
            raise ImageError(
                f"{where}: {name_in_file} fits {best[0]} and {best[1]}"
                f"{f' and {len(best) - 2} more' if len(best) > 2 else ''}, expected the name of one photograph; write "
                f'its folder and suffix too, e.g. "{best[0]}"'
            )
        return best[0] if best else None


def _parts(name: str) -> tuple[str, ...]:
    return PurePosixPath(name_key(name.strip())).parts


def _agree(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    """Whether the folders of two paths do not contradict each other: one path may begin further up."""
    shared = min(len(a), len(b))
    return a[len(a) - shared :] == b[len(b) - shared :]
