"""Exposure compensation of photographs, by the cells of the bed that several of them show."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from survey.export.hidden import Tops
from survey.export.photographs import Photograph
from survey.export.sight import Windows

# Cells that are compared at most, about, and rounds of medians.
_COMPARED, _ROUNDS = 20_000, 6


def common_exposure(
    photographs: list[Photograph], tops: list[Tops], bed: Windows, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) on the colours of photographs that make them alike; they are 1 on average.

    Parameters
    ----------
    photographs : V of them
    tops : what hides what in each
    bed : Windows
    advance : callable
        Called after each photograph.
    """
    known = {window: np.flatnonzero(np.isfinite(height)) for window, height in bed.all()}
    # Rounded up: OpenCV looks up less than 32,768 places of a row at a time.
    step = max(-(-sum(len(at) for at in known.values()) // _COMPARED), 1)
    compared = {window: at[::step] for window, at in known.items()}
    first = dict(zip(compared, np.cumsum([0, *map(len, compared.values())]).tolist(), strict=False))
    shown = np.full((len(photographs), sum(map(len, compared.values())), 3), np.nan, dtype=np.float32)
    for number, photograph in enumerate(photographs):
        pixels = photograph.pixels()
        for window, height, sight in bed.through(photograph.camera):
            at = compared[window]
            seen = tops[number].unhidden(sight, height)
            colour = pixels.at(seen.u.ravel()[at][None], seen.v.ravel()[at][None])[0]
            shown[number, first[window] : first[window] + len(at)] = np.log(np.maximum(colour, 1.0))
        advance()
    return np.exp(-exposure_gains(shown))


def exposure_gains(shown: np.ndarray) -> np.ndarray:
    """What photographs (V, 3) add to the logarithms of colours (V, K, 3), NaN where one does not show a cell."""
    gain = np.zeros((len(shown), 3))
    shown = shown[:, np.isfinite(shown[..., 0]).sum(axis=0) >= 2]
    if not shown.shape[1]:
        return gain
    with warnings.catch_warnings():
        # Of photographs that share no cell with another.
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(_ROUNDS):
            bed = np.nanmedian(shown - gain[:, None], axis=0)
            gain = np.nan_to_num(np.nanmedian(shown - bed, axis=1))
            gain -= gain.mean(axis=0)
    return gain
