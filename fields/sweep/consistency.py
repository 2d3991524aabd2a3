"""Do several views agree on the bed? Height maps compared with each other through the water."""

from __future__ import annotations

from typing import Any

from fields.sweep.backends import images, kernels
from fields.sweep.in_turn import Job, Launched
from fields.sweep.stack import ViewStack


def agreement(
    heights: ViewStack, view: int, peers: list[int], tolerance: float, pixels: Any | None = None
) -> Job[tuple[Any, Any, Any]]:
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
    backend = images(heights.device)
    shape = (heights.height, heights.width) if pixels is None else (len(pixels),)

    def launch() -> Launched:
        return Launched(list(kernels(heights.device).compare(heights, view, peers, tolerance, pixels)))

    sums = yield launch
    return backend.agreement(backend.heights_at(heights, view, pixels), sums, shape)
