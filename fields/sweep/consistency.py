"""Do several views agree on the bed? Height maps compared with each other through the water."""

from __future__ import annotations

import numpy as np

from fields.sweep.arrays import host
from fields.sweep.backends import warping
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
    device, images = heights.device, warping(heights.device)
    own = host(device, heights.pixels[view])
    shape = (heights.height, heights.width) if pixels is None else (len(pixels),)
    own = (own if pixels is None else own[pixels]).reshape(shape)
    sums = images.compare(heights, view, peers, tolerance, pixels)
    count, total, square = (host(device, s).reshape(shape) for s in sums)
    mean = total / (count + 1.0)
    spread = np.sqrt(np.maximum(square / (count + 1.0) - mean * mean, 0.0))
    return count.astype(np.uint8), own + mean, spread
