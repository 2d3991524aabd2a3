"""Least-squares matching: the position of a window of one photograph in another, to a fraction of a pixel.

template  the window in its own photograph, at whole pixels: (S, S) samples
affine    pixels in the other photograph per pixel of the template, by the bed and the water (2, 2)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter

# Half the side of a window [px]: 13 x 13 hold texture enough, and little relief.
RADIUS = 6
# Most steps, and how far [px] a window may end from where it was expected.
_STEPS, _FARTHEST_PX = 12, 4.0
# A step shorter than this [px] is below the noise of a photograph.
_DONE_PX = 0.005
# With a lower correlation (NCC) a window shows another surface.
_ALIKE = 0.85
# A window keeps this far [px] from masked pixels. The cubic spline carries their fill over to its neighbours, less by a
# factor of 0.27 from pixel to pixel: after five, a thousandth is left, less than a grey level.
_CLEAR_PX = 5


@dataclass(frozen=True)
class PreparedImage:
    """A photograph prepared for matching."""

    spline: np.ndarray  # (height, width) float32: coefficients of its cubic spline
    clear: np.ndarray  # (height, width) bool: where samples of a window may lie, away from masked pixels


def prepare_image(image: np.ndarray) -> PreparedImage:
    """Prepare a photograph (height, width) for matching; masked pixels are NaN."""
    masked = ~np.isfinite(image)
    if masked.all():
        return PreparedImage(np.zeros_like(image), ~masked)
    if masked.any():
        # A single NaN would make the whole spline NaN. The value of the nearest pixel causes no ringing at the edge.
        lines, columns = distance_transform_edt(masked, return_distances=False, return_indices=True)
        image = image[lines, columns]
    near = cv2.dilate(masked.astype(np.uint8), np.ones((2 * _CLEAR_PX + 1, 2 * _CLEAR_PX + 1), np.uint8))
    return PreparedImage(spline_filter(image, order=3, output=np.float32), near == 0)


def window() -> tuple[np.ndarray, np.ndarray]:
    """Places x and y of the samples of a window from its middle, (S*S,) each [px]."""
    y, x = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    return x.ravel(), y.ravel()


def match(image: PreparedImage, templates, slopes, expected, offsets) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares matching of windows in another photograph.

    Parameters
    ----------
    image : PreparedImage
        The other photograph.
    templates, slopes : (K, S*S), (K, S*S, 2)
        The windows and their gradients per pixel along x and y.
    expected : (K, 2) [px]
        Approximate positions of the middle of each window.
    offsets : (K, 2, S*S) [px]
        Positions of the samples of each window relative to its middle.

    Returns
    -------
    pixels (K, 2) [px], and which of them (K,) bool match

    Notes
    -----
    The inverse compositional form (S. Baker and I. Matthews, IJCV 56(3), 2004, section 3.2), of a shift alone, with
    brightness and contrast free: steps are solved in the template, whose slopes stay as they are.
    """
    x, y = window()
    affine = np.einsum("kas,bs->kab", offsets, np.stack([x / (x @ x), y / (y @ y)]))
    centred = templates - templates.mean(axis=1, keepdims=True)
    norm = np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)
    unit = centred / norm
    free = slopes - slopes.mean(axis=1, keepdims=True)
    free = free - unit[..., None] * np.einsum("ks,ksa->ka", unit, free)[:, None]
    hessian = np.einsum("ksa,ksb->kab", free, free)
    inverse = np.linalg.inv(hessian + 1e-6 * np.eye(2))
    at = expected.copy()
    height, width = image.spline.shape
    reach = np.abs(offsets).max(axis=2) + 2.0
    moved = np.full(len(at), np.inf)
    alike = np.full(len(at), -1.0)
    usable = np.isfinite(at).all(axis=1)
    for _ in range(_STEPS):
        inside = (at > reach).all(axis=1) & (at < np.array([width, height]) - reach).all(axis=1)
        usable &= inside & (np.linalg.norm(at - expected, axis=1) < _FARTHEST_PX)
        active = np.nonzero(usable & (moved > _DONE_PX))[0]
        if not len(active):
            break
        # Pixel centres are at 0.5; array indices count from the centre of the first one.
        places = at[active, :, None] - 0.5 + offsets[active]
        values = map_coordinates(image.spline, places[:, ::-1].transpose(1, 0, 2), order=3, prefilter=False)
        values = values.astype(np.float64)
        values = values - values.mean(axis=1, keepdims=True)
        length = np.maximum(np.linalg.norm(values, axis=1), 1e-9)
        alike[active] = np.einsum("ks,ks->k", values, unit[active]) / length
        gain = np.einsum("ks,ks->k", values, unit[active]) / norm[active, 0]
        gain = np.where(np.abs(gain) > 1e-3, gain, 1e-3)
        difference = values / gain[:, None] - centred[active]
        step = np.einsum("kab,ksb,ks->ka", inverse[active], free[active], difference)
        step = np.einsum("kab,kb->ka", affine[active], step)
        at[active] -= step
        moved[active] = np.linalg.norm(step, axis=1)
    found = usable & (moved <= _DONE_PX) & (alike > _ALIKE)
    # All samples of a window, which lie inside the photograph, are to be clear of masked pixels.
    columns, lines = np.floor(at[found][:, :, None] + offsets[found]).astype(int).transpose(1, 0, 2)
    found[found] = image.clear[lines, columns].all(axis=1)
    return at, found
