"""Names of photographs as files write them: in other case, with other slashes, with or without folder and suffix."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath

# Behind the name of a photograph, before its suffix, in the name of its mask.
MASK_ENDING = "_mask"


def name_key(name: str) -> str:
    """A name normalised for comparison: case, slashes and the encoding of accents."""
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()


class ImageNames:
    """The photographs of a survey, found by what a file calls them."""

    def __init__(self, names: Iterable[str]):
        self._names = frozenset(names)
        self._by_key: dict[str, set[str]] = {}
        for name in self._names:
            path = PurePosixPath(name_key(name))
            for key in (str(path), str(path.with_suffix("")), path.name, path.stem):
                self._by_key.setdefault(key, set()).add(name)

    def find(self, called: str) -> str | None:
        """The name of the only photograph that a file can mean; None where there is none, or several.

        Asked in this order: the same name; the same but for case and suffix; the same without folders.
        """
        if called in self._names:
            return called
        path = PurePosixPath(name_key(called.strip()))
        for key in (str(path), path.name):
            found = self._by_key.get(key, set())
            if len(found) == 1:
                return next(iter(found))
        return None
