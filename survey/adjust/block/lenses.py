"""Lenses of the photographs of a block, and a focal length for each photograph where these differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from refract.lens import MODELS, Lens, is_affine
from survey.photos.cameras import View

# Models whose distortion is Brown's; other lenses are held, and their tie points straightened.
BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FOCAL_NAMES = ("f", "fx", "fy")
# Fewer focal lengths that differ are those of several cameras, not the scatter of one.
FEWEST = 5
# Ratios of both focal lengths differ by less: of focal lengths of thousands of pixels written with three decimals.
_SAME_RATIO = 1e-6


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

    Lenses that differ in nothing but their focal length, of `FEWEST` different focal lengths or more, as an adjustment
    with autofocus writes them, are one with the mean of the focal lengths. All others are kept as they are.

    Returns
    -------
    lenses : tuple of L Lens
    lens_of : (V,) int64
        Number of the lens of each photograph.
    focals : (V,)
        Focal length of each photograph over that of its lens, less one; empty where they do not differ.
    """
    each = [view.lens for view in views]
    focal = np.array([lens.focal[0] for lens in each])
    common, focals = list(each), np.zeros(len(each))
    for alike in _alike(each):
        first = each[alike[0]]
        if is_held(first) or len(np.unique(focal[alike])) < FEWEST:
            continue
        mean = focal[alike].mean()
        lens = enlarged(first, float(mean) / first.focal[0])
        focals[alike] = focal[alike] / mean - 1.0
        for photograph in alike:
            common[photograph] = lens
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(common))}
    lens_of = np.array([numbers[lens] for lens in common], dtype=np.int64)
    return tuple(numbers), lens_of, focals if focals.any() else np.zeros(0)


def _alike(lenses: Sequence[Lens]) -> list[list[int]]:
    """Groups of the numbers of lenses that differ in nothing but their focal length."""
    groups = defaultdict(list)
    for number, lens in enumerate(lenses):
        names = MODELS[lens.model][1]
        rest = tuple(p for name, p in zip(names, lens.params, strict=True) if name not in _FOCAL_NAMES)
        groups[lens.model, lens.width, lens.height, rest].append(number)
    return [part for group in groups.values() for part in _of_one_ratio(lenses, group)]


def _of_one_ratio(lenses: Sequence[Lens], group: Sequence[int]) -> list[list[int]]:
    """Parts of a group whose ratios of both focal lengths are the same."""
    parts: list[list[int]] = []
    least = 0.0
    for ratio, number in sorted((lenses[number].focal[1] / lenses[number].focal[0], number) for number in group):
        # Against the least of a part, not its neighbour: ratios that spread continuously are no single one.
        if not parts or ratio > least * (1.0 + _SAME_RATIO):
            parts.append([])
            least = ratio
        parts[-1].append(number)
    return parts
