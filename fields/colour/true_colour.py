"""Colours of the bed without the water, whose absorption comes from views with paths of different length.

    seen_i = (1 - R_i) exp(-a w_i) bed + R_i sky        of one patch in view i; w the light's path in water, down and up

Means over patches are compared, since single pixels lose contrast in oblique, coarse views, which looks like
absorption. The veil is left out: a few angles cannot separate it from the colour of the bed, so that `a` is the net
loss, too small in turbid water.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize_scalar

from evaluation.summary import std_by_median
from fields.image_store import GAMMA
from fields.sweep.bed import BedPoints
from fields.sweep.maps import HeightMap, Sources, trusted
from fields.water_column import WaterColumn
from refract import FlatWater, PinholeCamera, fresnel_coefficients

SIDE_PX, PATCHES = 16, 2000  # Side of a patch, and the approximate number of patches in all
SHALLOWEST_M = 0.1  # Shorter paths absorb too little to measure
# A patch counts if at least this share of it is trusted, and this share of that is seen.
TRUSTED_SHARE, SEEN_SHARE = 0.9, 0.95
FEWEST = 10  # Fewer patches that several views see are too few for an estimate
SAME_HEIGHT_PX = 3.0  # A view sees a point if its own height there differs by less than this many of its pixels
MOST = 5.0  # Upper limit of the search [1/m]; pure water absorbs 0.3 of red light, brown water 3 of blue
# Standard deviation [1/m] of a useless estimate: over 3 m down and up it changes the light by a third.
USELESS_STD = 0.05
TRIMS, TRIM_STDS = 4, 3.0
STEP = 1e-4  # Step of the derivative by absorption [1/m]: far below the required accuracy, far above rounding


def true_colours(
    bed: BedPoints, water: FlatWater, column: WaterColumn, tide: np.ndarray | float = 0.0
) -> tuple[np.ndarray, float]:
    """Colours (N, 3) uint8 of points as photographs would store them without water, and the share too bright for that.

    Dry points keep theirs. Fully absorbed channels are black. ``tide`` (N,) [m] is that of the photographs which the
    colours come from.
    """
    depth = np.where(bed.wet, np.maximum(bed.depth + tide, 0.0), 0.0)
    dry = without_water(bed.rgb, depth, bed.incidence, water.n_water, column)
    stored = np.round(stored_colours(dry)).astype(np.uint8)
    too_bright = bed.wet & (dry > 1.0).any(axis=1)
    return np.where(bed.wet[:, None], stored, bed.rgb), float(too_bright.mean())


def without_water(
    rgb: np.ndarray, depth: np.ndarray, incidence: np.ndarray, n_water: float, column: WaterColumn
) -> np.ndarray:
    """Linear radiance (N, 3) of the bed, 1 for white, from the stored values of photographs.

    ``rgb`` (N, 3): 0 to 255. ``depth`` (N,) [m]. ``incidence`` (N,) [rad]: in air. ``n_water`` [-].
    """
    cos_wet = np.sqrt(1.0 - (np.sin(incidence) / n_water) ** 2)
    mirrored = fresnel_coefficients(np.cos(incidence), n_from=1.0, n_to=n_water).reflectance
    seen = torch.as_tensor((rgb / 255.0) ** GAMMA)
    with torch.no_grad():
        path_length = column.path_length(torch.as_tensor(depth), torch.as_tensor(depth) / torch.as_tensor(cos_wet))
        return column.bed_of(seen, path_length, torch.as_tensor(mirrored)).numpy()


def stored_colours(radiance: np.ndarray) -> np.ndarray:
    """Stored levels, 0 to 255 with fractions, of linear radiance; brighter than white is white."""
    return 255.0 * np.clip(radiance, 0.0, 1.0) ** (1.0 / GAMMA)


@dataclass(frozen=True)
class PatchSightings:
    """Patches as views see them, N of them."""

    patch: np.ndarray  # (N,) int
    below: np.ndarray  # (N, 3): mean linear radiance under the surface, without the light that the surface reflects
    path_length: np.ndarray  # (N,) [m]: mean path of the light in water, down and up


def estimate_absorption(sources: Sources) -> tuple[float, float, float]:
    """Absorption [1/m] of red, green and blue of the water over a swept bed.

    Raises ValueError if the survey is dry, or too little of the bed is seen along paths of sufficiently different
    length.
    """
    if sources.water is None:
        raise ValueError("the survey is dry: it has no water that could absorb light")
    points, patch = _patches(sources)
    parts = [
        _sightings(points, patch, *view, sources.water)
        for view in zip(sources.cameras, sources.maps, sources.images, strict=True)
    ]
    seen = PatchSightings(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("patch", "below", "path_length"))
    )
    if np.count_nonzero(np.bincount(seen.patch) > 1) < FEWEST:
        raise ValueError("too little of the bed under water is seen by several views")
    red, green, blue = (_fit(seen.patch, seen.below[:, channel], seen.path_length) for channel in range(3))
    return red, green, blue


def _patches(sources: Sources) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) [m] of the wet bed, local, in square patches of the views; and the patch (P,) of each."""
    rng = np.random.default_rng(0)
    each = max(PATCHES // len(sources.maps), 1)
    points, patch, count = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)], 0
    for camera, height_map in zip(sources.cameras, sources.maps, strict=True):
        shape = (camera.height // SIDE_PX, SIDE_PX, camera.width // SIDE_PX, SIDE_PX)
        height = height_map.height[: shape[0] * SIDE_PX, : shape[2] * SIDE_PX]
        wet = trusted(height_map)[: height.shape[0], : height.shape[1]] & (height < -SHALLOWEST_M)
        squares = np.argwhere(wet.reshape(shape).mean(axis=(1, 3)) >= TRUSTED_SHARE)
        for row, column in squares[rng.permutation(len(squares))[:each]] * SIDE_PX:
            r, c = np.nonzero(wet[row : row + SIDE_PX, column : column + SIDE_PX])
            path = camera.paths(np.stack([column + c + 0.5, row + r + 0.5], axis=-1), sources.water)
            points.append(path.at_height(height[row + r, column + c].astype(np.float64), sources.water))
            patch.append(np.full(len(r), count))
            count += 1
    return np.concatenate(points), np.concatenate(patch)


def _sightings(
    points: np.ndarray,
    patch: np.ndarray,
    camera: PinholeCamera,
    height_map: HeightMap,
    image: np.ndarray,
    water: FlatWater,
) -> PatchSightings:
    """The patches that one view sees whole."""
    pixels = camera.project(points, water)
    size = np.array([camera.width, camera.height])
    inside = np.flatnonzero(((pixels > 0.5) & (pixels < size - 0.5)).all(axis=1))
    height = (points[inside] - water.point) @ np.array(water.up)
    column, row = np.floor(pixels[inside]).astype(np.int64).T
    pixel_m = np.linalg.norm(points[inside] - camera.centre, axis=1) / camera.fx
    same = np.abs(height_map.height[row, column] - height) < SAME_HEIGHT_PX * pixel_m
    up = np.array(water.up)
    inside, depth = inside[same], camera.tide * up[2] - height[same]
    path = camera.paths(pixels[inside], water)
    mirrored = fresnel_coefficients(-(path.air_direction @ up), n_from=1.0, n_to=water.n_water).reflectance[:, None]
    linear = (np.arange(256, dtype=np.float32) / 255.0) ** GAMMA
    at = pixels[inside].T[::-1] - 0.5
    seen = np.stack([map_coordinates(linear[image[..., k]], at, order=1) for k in range(3)], axis=-1)
    below = (seen - mirrored * WaterColumn().sky.detach().numpy()) / (1.0 - mirrored)
    columns = [*below.T, depth - depth / (path.water_direction @ up)]
    num_pixels, num_inside = (
        np.bincount(patch),
        np.bincount(patch[inside], minlength=patch[-1] + 1 if len(patch) else 0),
    )
    kept = np.flatnonzero(num_inside >= SEEN_SHARE * num_pixels)
    means = np.stack(
        [np.bincount(patch[inside], v, len(num_pixels))[kept] / num_inside[kept] for v in columns], axis=-1
    )
    return PatchSightings(kept, means[:, :3], means[:, 3])


def _fit(patch: np.ndarray, below: np.ndarray, path_length: np.ndarray) -> float:
    """Absorption [1/m] of one channel: least squares with a bed radiance per patch, outliers removed."""
    share = np.ones(len(patch))

    def misfit(absorption: float) -> np.ndarray:
        return share * _without_bed(patch, below, np.exp(-absorption * path_length), share)

    for _ in range(TRIMS):
        found = float(minimize_scalar(lambda a: np.sum(misfit(a) ** 2), bounds=(0.0, MOST), method="bounded").x)
        residual = _without_bed(patch, below, np.exp(-found * path_length), share)
        change = (misfit(found + STEP) - misfit(found)) / STEP
        std = np.sqrt(np.sum(misfit(found) ** 2) / (max(share.sum(), 1.0) * max(np.sum(change**2), 1e-30)))
        share = (np.abs(residual) <= TRIM_STDS * std_by_median(residual)) * 1.0
    if not std < USELESS_STD:
        raise ValueError(
            f"the paths through the water are too similar to estimate absorption: its error is {std:.2g} per m"
        )
    return found


def _without_bed(patch: np.ndarray, below: np.ndarray, kept: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Residuals (N,) after a weighted fit of one bed radiance per patch; ``share`` (N,) are the weights."""
    squares = np.bincount(patch, share * kept * kept)
    bed = np.bincount(patch, share * kept * below) / np.maximum(squares, 1e-30)
    return below - kept * bed[patch]
