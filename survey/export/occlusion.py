"""Photographs in the cells of the bed: occlusion of cells by others in front, and exposure compensation.

The heights of the bed are projected into the photograph. A cell is hidden where the bed at its pixel is seen higher:
cameras look from above, so that along a ray the higher bed is the nearer one.

Exposures are compensated by the cells of the bed that several photographs show.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from refract import PinholeCamera
from survey.export.cell_projection import CellProjection, Windows
from survey.export.photographs import Photograph

# A cell is hidden where the bed that is seen at its pixel is higher by so many cells.
_HIDDEN_CELLS = 3.0
# Side of the blocks of pixels that are told apart, in cells of the bed: so that each has one.
_BLOCK_CELLS = 1.5
# Cells that are compared at most, about, and rounds of medians.
_COMPARED, _ROUNDS = 20_000, 6


@dataclass(frozen=True)
class HeightBuffer:
    """The highest bed in each block of a photograph's pixels."""

    height: np.ndarray  # (rows, columns) [m]: -inf where there is none
    block: float  # [px]: side
    allowed: float  # [m]: by so much a cell may lie lower and be seen

    @staticmethod
    def of(camera: PinholeCamera, bed: Windows, *, cell_m: float, cell_px: float) -> HeightBuffer:
        """The height buffer of a camera.

        Parameters
        ----------
        camera : PinholeCamera
        bed : Windows
        cell_m, cell_px : [m], [px]
            Side of a cell of the bed, on the bed and in the photograph.
        """
        block = max(_BLOCK_CELLS * cell_px, 1.0)
        highest = np.full((int(camera.height / block) + 1, int(camera.width / block) + 1), -np.inf)
        buffer = HeightBuffer(highest, block, _HIDDEN_CELLS * cell_m)
        for _, height, projection in bed.through(camera):
            seen, place = buffer._block_of(projection)
            np.maximum.at(highest, tuple(at[seen] for at in place), height[seen])
        return buffer

    def visible(self, projection: CellProjection, height: np.ndarray) -> CellProjection:
        """Projection of the visible cells with these heights (rows, columns) [m]; NaN where something hides them."""
        seen, place = self._block_of(projection)
        return projection.where(seen & (np.where(seen, height, -np.inf) >= self.height[place] - self.allowed))

    def _block_of(self, projection: CellProjection) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Cells in the photograph, and the row and column of their blocks."""
        seen = np.isfinite(projection.u)
        rows, columns = (np.where(seen, at, 0.0) / self.block for at in (projection.v, projection.u))
        return seen, (rows.astype(np.int64), columns.astype(np.int64))


def common_exposure(
    photographs: list[Photograph], buffers: list[HeightBuffer], bed: Windows, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) on the colours of photographs that make them alike; they are 1 on average.

    Parameters
    ----------
    photographs : V of them
    buffers : HeightBuffer of each
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
        for window, height, projection in bed.through(photograph.camera):
            at = compared[window]
            seen = buffers[number].visible(projection, height)
            colour = pixels.at(seen.u.ravel()[at][None], seen.v.ravel()[at][None])[0]
            shown[number, first[window] : first[window] + len(at)] = np.log(np.maximum(colour, 1.0))
        advance()
    return np.exp(-exposure_gains(shown))


def exposure_gains(shown: np.ndarray) -> np.ndarray:
    """Exposure gains (V, 3) in the logarithms of colours (V, K, 3), NaN where a photograph does not show a cell."""
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
