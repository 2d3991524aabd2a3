"""Test whether a surface over the layer explains the photographs that agree on it.

Photographs that nearly look along each other show the same colours on whatever lies behind what they see. If it is a
surface over the layer, other photographs show those colours on it, too.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from fields.occluded.consensus import Colours, windowed

# Heights over the layer at which other photographs are tested, in ground sampling distances: steps of a fourth.
_SHEETS_GSD = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0, 64.0)
# In variances of the noise, the mean square up to which a photograph agrees; one cell counts at most so much.
_AGREE, _MOST = 1.5, 30.0
# Share of the other photographs that agree by chance at one of the heights.
_BY_CHANCE = 0.3


def explained_above(
    slopes: np.ndarray,
    on_layer: Colours,
    surfaces: Iterable[Colours],
    members: np.ndarray,
    gsd: float,
    part: tuple[slice, slice] = np.s_[:, :],
) -> np.ndarray:
    """Cells (rows, columns) bool whose colours other photographs show where the rays of the members pass over them.

    Only of a ``part`` of the rows and columns.

    Parameters
    ----------
    slopes : (K, 2)
        How far the rays of each photograph move over the ground with the height [m/m].
    on_layer : Colours
        At the cells.
    surfaces : iterable of Colours
        At the heights `surface_heights` over the layer.
    members : (K, rows, columns) bool
        Photographs that agree on each cell.
    gsd : [m]
        Side of a cell.
    """
    row, column = (each[part] for each in np.mgrid[: members.shape[1], : members.shape[2]])
    members = members[:, *part]
    share, count = members[..., None].astype(np.float32), np.maximum(members.sum(axis=0), 1)
    mean = (share * on_layer.values[:, *part]).sum(axis=0) / count[..., None]
    shift = (
        np.einsum("kij,kc->ijc", members.astype(np.float32), slopes.astype(np.float32))
        / count[..., None]
        / np.float32(gsd)
    )
    variance = on_layer.noise**2 * (1.0 + 1.0 / count)[..., None]
    most = np.zeros(count.shape)
    for height, sheet in zip(surface_heights(gsd), surfaces, strict=True):
        x, y = ((each + height * shift[..., axis]).astype(np.float32) for axis, each in enumerate((column, row)))
        agree, others = np.zeros(count.shape), np.zeros(count.shape)
        for values, use, is_member in zip(sheet.values, sheet.use, members, strict=True):
            seen = cv2.remap(use.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
            difference = cv2.remap(values, x, y, cv2.INTER_LINEAR) - mean
            square = np.minimum((difference**2 / variance).mean(axis=-1), _MOST).astype(np.float32)
            agree += seen & ~is_member & (windowed(square, seen) < _AGREE)
            others += seen & ~is_member
        most = np.maximum(most, agree / np.maximum(others, 1.0))
    return most > _BY_CHANCE


def surface_heights(gsd: float) -> list[float]:
    """Heights [m] over the layer at which other photographs are tested."""
    return [gsd * each for each in _SHEETS_GSD]
