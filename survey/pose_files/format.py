"""A format of pose files: how it is found, recognised and read, and which of its keys change a lens.

The one place for all formats: a reader names the keys that it reads, and what is left is held against this.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refract.lens import Lens, LensError
from survey.errors import PosesError
from survey.files.csv_table import number_of
from survey.files.foreign_text import finite_number
from survey.photos.poses import FileTies, PoseFile

# Names of coefficients, what only says which lens it is, and words in the names of keys that are about a lens.
_COEFFICIENT = re.compile(r"(k|p|b|s|tau|sx|sy)_?\d{1,2}")
_LABEL = re.compile(r"(lens|camera)_(make|maker|name|serial|serial_number|id)|lens_model")
_WORDS = re.compile(
    r"fish_?eye|distort|lens|skew|shear|aspect|focal|fov|principal|ppx|ppy|^[fc]_?[xy]$|^fl_|ftheta|projection|"
    r"equirect|lat_?long|panorama|spherical|cylindrical|omnidirectional|camera_model|camera_type|prism|radial|"
    r"tangential|affin|intrinsic|rolling|shutter|decent(er|r)ing|dist_?coeff?"
)


@dataclass(frozen=True)
class Format:
    name: str  # In a sentence: "expected ..."
    # files or folders of this format in a survey folder, best known places only
    find: Callable[[Path], list[Path]]
    recognises: Callable[[Path], bool]  # whether a path, which exists, is of this format
    read: Callable[[Path], PoseFile]  # what such a path holds; raises PosesError
    # the files beside such a path, which is one, that are read with it
    files: Callable[[Path], list[Path]] | None = None
    # tie points that came with the poses, in their frame; None where none came; raises PosesError
    read_ties: Callable[[Path], FileTies | None] | None = None


def numbers_in(cells: Sequence[str], count: int, where: str, remedy: str) -> list[float]:
    """The finite numbers in texts, so many of them; PosesError where they are not."""
    found = [number_of(cell) for cell in cells]
    if len(found) != count or not all(map(math.isfinite, found)):
        raise PosesError(f'{where}: "{" ".join(cells)}" was found, expected {count} finite numbers; {remedy}')
    return found


def lens_number(values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """A finite number of a lens in JSON; LensError where it is none."""
    found = finite_number(values.get(key, default))
    if found is None:
        raise LensError(f"{key} is {values.get(key)}, expected a finite number; correct it")
    return found


def lens_size(values: Mapping[str, Any], width: str, height: str) -> tuple[int, int]:
    """Width and height [px] of a photograph in JSON; LensError where they are no whole numbers."""
    w, h = lens_number(values, width), lens_number(values, height)
    if not (w.is_integer() and h.is_integer()):
        raise LensError(f"the image has {w:g} x {h:g} pixels, expected whole numbers; correct it")
    return int(w), int(h)


def brown_lens(
    inner: Sequence[float], size: tuple[int, int], *, k3: float = 0.0, k4: float = 0.0, shear: float = 0.0
) -> Lens:
    """The model of fewest parameters for Brown's distortion; ``inner`` are fx, fy, cx, cy, k1, k2, p1, p2 of OpenCV."""
    if k4 or shear:
        return Lens("BROWN_AFFINE", (*inner, k3, k4, shear), *size)
    if k3:
        return Lens("FULL_OPENCV", (*inner, k3, 0.0, 0.0, 0.0), *size)
    return Lens("OPENCV", tuple(inner), *size)


def require_understood(
    values: Mapping[str, Any], known: Collection[str], *, remedy: str, are_all_of_lens: bool = False
) -> None:
    """Raise LensError where a key that changes the lens is none of those that a reader knows.

    ``remedy`` follows the semicolon of the error; ``are_all_of_lens`` where the object is that of a lens alone, so that
    each key is one of it; else names tell it.
    """
    for key, value in values.items():
        is_of_lens = are_all_of_lens or is_lens_key(key)
        if is_of_lens and key not in known and not _changes_nothing(value):
            raise LensError(f"{key} is {value}, a part of the lens that is not read, expected none; {remedy}")


def is_lens_key(key: str) -> bool:
    """Whether the name of a key or column is that of a part of a lens."""
    name = key.casefold()
    if _LABEL.fullmatch(name):
        return False
    return _COEFFICIENT.fullmatch(name) is not None or _WORDS.search(name) is not None


def _changes_nothing(value: Any) -> bool:
    """Zero, false or empty, as a number, its text, or a list of those."""
    if isinstance(value, list | tuple):
        return all(_changes_nothing(part) for part in value)
    if isinstance(value, dict):
        return all(_changes_nothing(part) for part in value.values())
    if isinstance(value, str):
        text = value.strip().casefold()
        try:
            return all(float(word) == 0.0 for word in text.replace(",", " ").split())
        except ValueError:
            return text in ("false", "none", "null")
    return not value
