"""Settings of structure from motion from [cameras], checked before it starts."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from survey.errors import FILE_NAME, SurveyError
from survey.photos.exif import Exif
from survey.photos.pixels import require_pixels

# Longest side [px] of a photograph for the detection of features; larger ones are reduced.
FEATURES_PX = 3200
# Up to so many images every pair is tried, beyond it each image with its nearest neighbours.
ALL_PAIRS_UP_TO, NEIGHBOURS = 40, 20
# More threads would be faster; with two, most repeated runs of a block agree in all significant digits.
THREADS = 2
SEED = 0
# Images of a block, at least, but for those of two photographs.
MIN_IMAGES = 3
_ERRORS_ONLY = 2
# Of two neighbours, most have each other: so many pairs come of a neighbour.
_PAIRS_OF_NEIGHBOUR = 0.65


def pairs_about(num: int) -> int:
    """Approximate number of pairs that are matched of so many images."""
    return num * (num - 1) // 2 if num <= ALL_PAIRS_UP_TO else round(_PAIRS_OF_NEIGHBOUR * NEIGHBOURS * num)


def solver() -> ModuleType:
    """pycolmap, which prints errors only."""
    import pycolmap

    pycolmap.logging.minloglevel = _ERRORS_ONLY
    return pycolmap


def require_solver(module: str = "pycolmap") -> None:
    """Raise SurveyError where structure from motion is not installed: there is no pycolmap for every machine."""
    if find_spec(module) is None:
        raise SurveyError(
            "the survey has no poses, and pycolmap, which finds them from the photographs, is not installed; it has no "
            "package for Linux on ARM (aarch64). Name a file of poses in [cameras] poses, e.g. of Metashape, "
            "OpenDroneMap or COLMAP, or run structure from motion on another machine"
        )


def require_size(images: Mapping[str, Path], headers: Mapping[str, Exif], size_px: tuple[int, int] | None) -> None:
    """Raise ImageError where an image does not have the size that the settings say."""
    if size_px is not None:
        remedy = f"correct it in {FILE_NAME}, or leave the image out"
        for name, header in headers.items():
            require_pixels(images[name], header.size_px, size_px, "[cameras] size_px", remedy)


def one_focal(focal_px: float | tuple[float, float] | None) -> float | None:
    """The focal length [px] of square pixels."""
    if not isinstance(focal_px, tuple | list):
        return focal_px
    if focal_px[0] != focal_px[1]:
        raise SurveyError(
            f"[cameras] focal_px in {FILE_NAME} is {list(focal_px)}, and structure from motion solves for square "
            "pixels; give one number, or poses made elsewhere in [cameras] poses"
        )
    return focal_px[0]
