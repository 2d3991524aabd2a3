"""Photo-consistency of each photograph with the surface of the height maps.

Points of the height maps are projected into every photograph, refracted at the water. Where its pose is right, its
grey levels there correlate with those of the photographs that the points come from; where it is wrong, they do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted
from refract import PinholeCamera

_WIDTH_PX = 800  # Wider images are reduced to this: structure of some pixels is compared, not noise
# The band of structure [px, standard deviations of Gauss filters] whose grey levels are compared.
_FINE_PX, _COARSE_PX = 1.0, 8.0
_SAMPLES = 400  # Points of each height map


@dataclass(frozen=True)
class Consistency:
    """Photo-consistency of one photograph with the surface."""

    num_points: int  # Points of other photographs that its frame holds
    # Of its grey levels with theirs, in a band of some pixels; None with fewer than two points
    correlation: float | None
    contrast: float  # [grey levels]: standard deviation of its grey levels in that band


def photo_consistency(
    block: Block, maps: Sequence[HeightMap], full_camera: PinholeCamera | None = None
) -> list[Consistency]:
    """Each photograph of a block, in its order, against the trusted points of the height maps of others.

    Where views are windows of photographs, ``full_camera`` is the camera of one of these: a window is reduced as the
    whole is, and gives as many points as its share of the pixels.
    """
    width = max(camera.width for camera in block.cameras) if full_camera is None else full_camera.width
    scale = min(1.0, _WIDTH_PX / width)
    cameras = [camera.scaled(scale) for camera in block.cameras]
    bands = [_band(block.images[view], scale) for view in range(len(cameras))]
    xyz, grey, source = _points(
        block, maps, bands, scale, None if full_camera is None else full_camera.width * full_camera.height
    )
    found = []
    for view, (camera, band) in enumerate(zip(cameras, bands, strict=True)):
        others = source != view
        at = camera.project(xyz[others], block.water)
        seen = camera.sees(at)
        sampled, expected = _sampled(band, at[seen]), grey[others][seen]
        known = np.isfinite(sampled)
        contrast = float(np.nanstd(band)) if np.isfinite(band).any() else 0.0
        found.append(Consistency(int(known.sum()), _correlation(sampled[known], expected[known]), contrast))
    return found


def _points(
    block: Block, maps: Sequence[HeightMap], bands: Sequence[np.ndarray], scale: float, whole_px: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) [m], local, their grey levels (N,) in the band, and the views (N,) they come from."""
    rng = np.random.default_rng(0)
    xyz, grey, source = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for m in maps:
        camera = block.cameras[m.view]
        pixels = np.flatnonzero(trusted(m)[: camera.height, : camera.width])
        most = _SAMPLES if whole_px is None else -(-_SAMPLES * camera.width * camera.height // whole_px)
        pixels = rng.choice(pixels, min(most, len(pixels)), replace=False)
        row, column = np.divmod(pixels, camera.width)
        at = np.column_stack([column, row]) + 0.5
        xyz.append(camera.paths(at, block.water).at_height(m.height[row, column].astype(np.float64), block.water))
        grey.append(_sampled(bands[m.view], at * scale))
        source.append(np.full(len(pixels), m.view))
    points, values, views = np.concatenate(xyz), np.concatenate(grey), np.concatenate(source)
    known = np.isfinite(values) & np.isfinite(points).all(axis=1)
    return points[known], values[known], views[known]


def _band(image: np.ndarray, scale: float) -> np.ndarray:
    """Structure of some pixels (rows, columns) of a grey image; NaN where it is not known."""
    image = np.asarray(image, dtype=np.float32)
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    known = np.isfinite(image)
    is_whole = bool(known.all())
    filled = image
    if not is_whole:
        filled = np.where(known, image, np.float32(np.nanmedian(image) if known.any() else 0.0))
    fine, coarse = (cv2.GaussianBlur(filled, (0, 0), sigma) for sigma in (_FINE_PX, _COARSE_PX))
    return fine - coarse if is_whole else np.where(known, fine - coarse, np.float32(np.nan))


def _sampled(band: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (N,) at the pixels that hold places (N, 2); NaN beyond the image."""
    column, row = np.floor(at).astype(np.int64).T
    inside = (row >= 0) & (column >= 0) & (row < band.shape[0]) & (column < band.shape[1])
    values = np.full(len(at), np.nan)
    values[inside] = band[row[inside], column[inside]]
    return values


def _correlation(a: np.ndarray, b: np.ndarray) -> float | None:
    if len(a) < 2 or a.std() == 0.0 or b.std() == 0.0:
        return None
    return float(np.corrcoef(a, b)[0, 1])
