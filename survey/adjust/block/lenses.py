"""Lenses of the photographs of a block, and a focal length for each photograph where these differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from refract.lens import MODELS, Lens, is_affine
from survey.photos.cameras import View

# Models whose distortion is Brown's; other lenses are held, and their tie points straightened.
BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FOCAL_NAMES = ("f", "fx", "fy")
# Of fewer photographs nothing tells a scatter of the focal lengths from several cameras.
FEWEST = 5
# Ratios of both focal lengths are written with 17 digits.
_SAME_RATIO = 1e-12


def is_held(lens: Lens) -> bool:
    """Whether a lens is not adjusted: its distortion is not Brown's. Of an affine one Brown's part is adjusted."""
    return not is_affine(lens) and (lens.model not in BROWN or any(lens[name] != 0.0 for name in ("k4", "k5", "k6")))


def enlarged(lens: Lens, factor: float) -> Lens:
    """A lens with its focal lengths times a factor."""
    names = MODELS[lens.model][1]
    params = tuple(p * factor if name in _FOCAL_NAMES else p for name, p in zip(names, lens.params, strict=True))
    return replace(lens, params=params)


def lenses_of(views: Sequence[View]) -> tuple[tuple[Lens, ...], np.ndarray, np.ndarray]:
    """Lenses of a block, L of V photographs.

    Where each photograph has a focal length of its own and all else is as in others, as an adjustment with autofocus
    writes them, these are one lens with the mean of the focal lengths.

    Returns
    -------
    lenses : tuple of L Lens
    lens_of : (V,) int64
        Number of the lens of each photograph.
    focals : (V,)
        Focal length of each photograph over that of its lens, less one; empty where they do not differ.
    """
    each = [view.lens for view in views]
    lenses = tuple(dict.fromkeys(each))
    if len(lenses) == len(views) >= FEWEST and not any(map(is_held, lenses)):
        shapes = _alike(lenses)
        if len(shapes) < len(lenses) and np.bincount(number := _numbers(lenses, shapes)).min() > 1:
            focal = np.array([lens.focal[0] for lens in lenses])
            mean = np.bincount(number, focal) / np.bincount(number)
            common = tuple(enlarged(lens, mean[i] / lens.focal[0]) for i, lens in enumerate(shapes))
            return common, number, focal / mean[number] - 1.0
    return lenses, np.array([lenses.index(lens) for lens in each]), np.zeros(0)


def _alike(lenses: Sequence[Lens]) -> list[Lens]:
    """The first of those lenses that differ in nothing but their focal length."""
    found: list[Lens] = []
    for lens in lenses:
        if not any(_is_scaled(lens, other) for other in found):
            found.append(lens)
    return found


def _numbers(lenses: Sequence[Lens], shapes: Sequence[Lens]) -> np.ndarray:
    return np.array([next(i for i, shape in enumerate(shapes) if _is_scaled(lens, shape)) for lens in lenses])


def _is_scaled(lens: Lens, other: Lens) -> bool:
    """Whether two lenses differ in nothing but their focal length."""
    if (lens.model, lens.width, lens.height) != (other.model, other.width, other.height):
        return False
    names = MODELS[lens.model][1]
    rest = [i for i, name in enumerate(names) if name not in _FOCAL_NAMES]
    ratios = [each.focal[1] / each.focal[0] for each in (lens, other)]
    return abs(ratios[0] / ratios[1] - 1.0) < _SAME_RATIO and all(lens.params[i] == other.params[i] for i in rest)
