"""Do several views agree on the bed? Height maps compared with each other through the water."""

from __future__ import annotations

import numpy as np

from fields.sweep.backends import warping
from fields.sweep.in_turn import Job, Launched, alone
from fields.sweep.stack import ViewStack


def agreement(
    heights: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the height map of one view with those of its peers.

    The bed point of each pixel is projected into each peer, whose own height there (bilinear) is compared.

    Parameters
    ----------
    heights : ViewStack whose images are height maps [m] over the water plane
    view, peers : indices into the stack
    tolerance : [m]
        Heights closer than this agree.
    pixels : (P,) flat indices, optional
        Of the view; all of them by default.

    Returns
    -------
    agreeing : (height, width) uint8, or (P,)
        Number of peers that agree.
    fused : float32 [m]
        Mean of the view's own height and those that agree.
    spread : float32 [m]
        Standard deviation (population) of the same.
    """
    return alone(heights.device, comparing(heights, view, peers, tolerance, pixels))


def comparing(
    heights: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None
) -> Job[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`agreement` as a job."""
    own = heights.images[view]
    shape = (heights.height, heights.width) if pixels is None else (len(pixels),)
    own = own if pixels is None else own.ravel()[pixels]

    def launch() -> Launched:
        return Launched(list(warping(heights.device).compare(heights, view, peers, tolerance, pixels)))

    count, total, square = (each.reshape(shape) for each in (yield launch))
    mean = total / (count + 1.0)
    spread = np.sqrt(np.maximum(square / (count + 1.0) - mean * mean, 0.0))
    return count.astype(np.uint8), own + mean, spread
