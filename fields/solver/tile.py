"""Tiles of height maps, solved independently, with a halo each; albedo, gain, offset and noise of photographs."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage, sparse

from evaluation.summary import MAD_TO_STD
from fields.image_store import GreyImages
from fields.sweep.images import median_reordering

# Most pixels of a tile's window, without its surroundings. Larger ones save no time and are less accurate: gain and
# noise of a photograph are those of a tile.
MOST_PX = 50_000
HALO_PX = 8  # How far the surroundings of a tile reach: several times the range over which heights are correlated
# Heights are solved this far around the pixels that are asked for, where other views confirm the sweep's height.
AROUND_PX = 3


@dataclass(frozen=True)
class SolverTile:
    """Pixels of one height map that are solved together; N of them."""

    # row, column: Of the first pixel of the window that holds them
    row: int
    column: int
    inside: np.ndarray  # (rows, columns) bool: which pixels of the window are solved
    requested: np.ndarray  # (N,) bool: whose heights are wanted; the others are their surroundings

    def __len__(self) -> int:
        return len(self.requested)

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column in the window (N,) each."""
        rows, columns = np.nonzero(self.inside)
        return rows, columns

    @cached_property
    def pixels(self) -> np.ndarray:
        """Positions (N, 2) [px] in the image."""
        rows, columns = self.places
        return np.stack([columns + (self.column + 0.5), rows + (self.row + 0.5)], axis=-1)

    def of(self, image: np.ndarray) -> np.ndarray:
        """The N pixels of an image."""
        return self.window(image)[self.inside]

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) as an image of the window (rows, columns) float32; 0 outside."""
        image = np.zeros(self.inside.shape, dtype=np.float32)
        image[self.inside] = values
        return image

    def window(self, image: np.ndarray) -> np.ndarray:
        """The part of an image in which the tile lies."""
        return image[self._window]

    def window_of_view(self, images: GreyImages | Mapping[int, np.ndarray], view: int) -> np.ndarray:
        """The part of the image of a view in which the tile lies."""
        return images.window(view, *self._window) if isinstance(images, GreyImages) else self.window(images[view])

    @property
    def _window(self) -> tuple[slice, slice]:
        rows, columns = self.inside.shape
        return slice(self.row, self.row + rows), slice(self.column, self.column + columns)


def tiles_of(wanted: np.ndarray, confirmed: np.ndarray, side: int | None = None) -> Iterator[SolverTile]:
    """Tiles that contain every wanted pixel (height, width) bool once, with confirmed pixels around them.

    They are squares of ``side`` pixels, without their surroundings; without it, parts that are close about what is
    wanted, so that a map of which little is takes few.
    """
    solved = (ndimage.binary_dilation(wanted, iterations=AROUND_PX) & confirmed) | wanted
    for top, bottom, left, right in _halves(wanted) if side is None else _squares(wanted.shape, side):
        core = np.s_[top:bottom, left:right]
        if not wanted[core].any():
            continue
        row, column = max(top - HALO_PX, 0), max(left - HALO_PX, 0)
        window = np.s_[row : bottom + HALO_PX, column : right + HALO_PX]
        inside, requested = solved[window].copy(), np.zeros_like(solved[window])
        requested[top - row : bottom - row, left - column : right - column] = wanted[core]
        yield SolverTile(row, column, inside, requested[inside])


def requested_in_squares(wanted: np.ndarray, side: int) -> list[int]:
    """Number of wanted pixels in each of the tiles that `tiles_of` makes with a side."""
    counts = (
        int(np.count_nonzero(wanted[top:bottom, left:right]))
        for top, bottom, left, right in _squares(wanted.shape, side)
    )
    return [count for count in counts if count]


def _squares(shape: tuple[int, ...], side: int) -> Iterator[tuple[int, int, int, int]]:
    """Top, bottom, left and right of squares that cover an image."""
    height, width = shape
    for top in range(0, height, side):
        for left in range(0, width, side):
            yield top, min(top + side, height), left, min(left + side, width)


def _halves(wanted: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Top, bottom, left and right of the parts of a recursive bisection, each cropped to its wanted pixels."""
    waiting = [(0, wanted.shape[0], 0, wanted.shape[1])]
    while waiting:
        top, bottom, left, right = waiting.pop()
        part = wanted[top:bottom, left:right]
        rows, columns = (np.flatnonzero(part.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            continue
        top, bottom = top + int(rows[0]), top + int(rows[-1]) + 1
        left, right = left + int(columns[0]), left + int(columns[-1]) + 1
        if (bottom - top) * (right - left) <= MOST_PX:
            yield top, bottom, left, right
        elif bottom - top > right - left:
            middle = (top + bottom) // 2
            waiting += [(middle, bottom, left, right), (top, middle, left, right)]
        else:
            middle = (left + right) // 2
            waiting += [(top, bottom, middle, right), (top, bottom, left, middle)]


# The offset of a photograph (veil, reflected sky, vignetting) varies slowly: means over cells of this side, under a
# Gauss filter of this standard deviation in cells.
CELL_PX, SMOOTHING_STD_CELLS = 8, 2.5
_KERNEL = (21, 21)  # Size of the filter in cells: four standard deviations to each side
GAINS = (0.3, 3.0)  # A gain beyond these is not gain: the photograph shows something else
LEAST_PIXELS = 100  # Fewest pixels for a gain
LEAST_NOISE = 0.3  # Quantisation alone has 0.29 grey levels
OUTLIER = 3.0  # Residuals beyond this many times the noise lose their weight
# An outlier has less than this share of its weight left: its residual is beyond `OUTLIER` times the noise.
_REMAINING_WEIGHT = 0.5
_SAMPLE = 10_000  # A median over this many pixels is good enough, of each photograph


@dataclass(frozen=True)
class Appearance:
    """Gain (K,) and offset (K, N) of K photographs: grey = gain * albedo + offset; the albedo is in grey levels."""

    gain: np.ndarray
    offset: np.ndarray

    def albedo(self, grey: np.ndarray) -> np.ndarray:
        """Albedo by each photograph (K, N) from its grey values."""
        return (grey - self.offset) / self.gain[:, None]


@dataclass(frozen=True)
class Brightness:
    """Albedo by variable projection, and the residuals of K photographs; N pixels."""

    albedo: np.ndarray  # (N,)
    residual: np.ndarray  # (K, N): grey levels of the albedo; 0 where not seen
    weight: np.ndarray  # (K, N): one over the variance; 0 where not seen
    noise: np.ndarray  # (K,): standard deviation of the residual

    @property
    def outlying(self) -> np.ndarray:
        """Outliers (K, N) bool: observations with less than half of their weight left."""
        return (self.weight > 0.0) & (self.weight * self.noise[:, None] ** 2 < _REMAINING_WEIGHT)

    def minus_albedo(self, values: np.ndarray) -> np.ndarray:
        """Values (K, N) minus their weighted mean over the photographs: orthogonal to the albedo."""
        mean = np.einsum("kn,kn->n", self.weight, values) / np.maximum(self.weight.sum(axis=0), 1e-12)
        return np.where(self.weight > 0.0, values - mean, np.float32(0.0))


def log_likelihood_ratio(before: Brightness, now: Brightness) -> np.ndarray:
    """Log-likelihood ratio of the photographs at each pixel (N,), now against before, by Cauchy's distribution.

    The distribution is that of the robust weights, with the noise of ``now``. Only photographs that show the pixel in
    both count.
    """
    scale = OUTLIER * now.noise[:, None]
    both = (before.weight > 0.0) & (now.weight > 0.0)
    misfit = np.log1p((before.residual / scale) ** 2) - np.log1p((now.residual / scale) ** 2)
    return 0.5 * OUTLIER**2 * np.where(both, misfit, np.float32(0.0)).sum(axis=0)


def appearance_of(tile: SolverTile, grey: np.ndarray) -> Appearance:
    """Photometric gain and smooth offset of each photograph against the mean, from grey values (K, N), NaN if not seen.

    Estimated twice: from all pixels, then without what one photograph alone shows, such as glint.
    The tile's own photograph, the first, stays as it is.
    """
    seen = np.isfinite(grey)
    values = np.where(seen, grey, np.float32(0.0))
    gain, cells = np.ones(len(grey), dtype=np.float32), _Cells(tile)
    mean, inliers = values.sum(axis=0) / np.maximum(seen.sum(axis=0, dtype=np.float32), 1.0), seen
    for last in (False, True):
        gain = np.where(inliers.sum(axis=1) >= LEAST_PIXELS, _gains(values, mean, inliers), gain)
        offset = cells.smooth(values - gain[:, None] * mean, inliers)
        if not last:
            found = brightness_of((grey - offset) / gain[:, None])
            mean, inliers = found.albedo, seen & ~found.outlying
    return Appearance(gain / gain[0], offset - gain[:, None] / gain[0] * offset[0])


def _gains(values: np.ndarray, mean: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Regression slopes (K,) of values (K, N) on their mean (N,) within ``mask`` (K, N); 1 if the mean is constant."""
    share = mask.astype(np.float32)
    about = mean - (share @ mean / np.maximum(share.sum(axis=1), 1.0))[:, None]
    about *= share
    spread, along = (np.einsum("kn,kn->k", about, each) for each in (about, values))
    gain = np.divide(along, spread, out=np.ones_like(along), where=spread > 0.0)
    return np.clip(gain, *GAINS)


class _Cells:
    """Means of values over cells of a tile, smoothed and interpolated back to the pixels."""

    def __init__(self, tile: SolverTile):
        rows, columns = tile.places
        self._shape = tuple(-(-size // CELL_PX) for size in tile.inside.shape)
        cell = (rows // CELL_PX) * self._shape[1] + columns // CELL_PX
        places, shares = [], []
        for index, size in zip((rows, columns), self._shape, strict=True):
            at = np.clip((index + 0.5) / CELL_PX - 0.5, 0.0, size - 1.0)
            first = np.minimum(at.astype(np.int32), max(size - 2, 0))
            share = (at - first).astype(np.float32)
            places.append((first, np.minimum(first + 1, size - 1)))
            shares.append((1.0 - share, share))
        four = [(i, j) for i in (0, 1) for j in (0, 1)]
        index = np.stack([places[0][i] * self._shape[1] + places[1][j] for i, j in four], axis=-1)
        share = np.stack([shares[0][i] * shares[1][j] for i, j in four], axis=-1)
        number = np.arange(len(rows) + 1)
        shape = len(rows), self._shape[0] * self._shape[1]
        self._between = sparse.csr_matrix((share.ravel(), index.ravel(), 4 * number), shape=shape)
        self._sums = sparse.csr_matrix((np.ones(len(rows), dtype=np.float32), cell, number), shape=shape).T

    def smooth(self, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Local means (K, N) of values (K, N) within ``mask`` (K, N)."""
        num = len(values)
        # Pixel by pixel: sums of all photographs at once run in vectors.
        both = np.empty((values.shape[1], 2 * num), dtype=np.float32)
        both[:, :num], both[:, num:] = np.where(mask, values, np.float32(0.0)).T, mask.T
        sums = (self._sums @ both).reshape(*self._shape, 2 * num)
        smooth = cv2.GaussianBlur(sums, _KERNEL, SMOOTHING_STD_CELLS, borderType=cv2.BORDER_REFLECT).reshape(
            -1, 2 * num
        )
        mean = smooth[:, :num] / np.maximum(smooth[:, num:], 1e-9)
        return np.ascontiguousarray((self._between @ mean).T)


def brightness_of(albedos: np.ndarray) -> Brightness:
    """Albedo, residuals and robust (Cauchy) weights from its estimates by each photograph (K, N), NaN if not seen.

    The noise of each photograph is measured by the median of its residuals.
    """
    seen = np.isfinite(albedos)
    is_seen = seen.astype(np.float32)
    values = np.where(seen, albedos, np.float32(0.0))
    count = seen.sum(axis=0, dtype=np.float32)
    # The mean takes a share of the residual.
    left = np.sqrt(np.maximum(1.0 - 1.0 / np.maximum(count, 2), 0.5)).astype(np.float32)
    albedo = values.sum(axis=0) / np.maximum(count, 1.0)
    # A subset is large enough for a median.
    some = [(index := np.flatnonzero(mask))[:: max(len(index) // _SAMPLE, 1)] for mask in seen]
    weight, residual = np.empty_like(values), np.empty_like(values)
    # In place, as most of the time goes into memory that is asked for again and again.
    for _ in range(2):
        np.subtract(values, albedo, out=residual)
        noise = np.ones(len(values), dtype=np.float32)
        for view, index in enumerate(some):
            if len(index):
                middle = float(median_reordering(np.abs(residual[view][index] / left[index])))
                noise[view] = max(MAD_TO_STD * middle, LEAST_NOISE)
        residual /= (OUTLIER * noise[:, None]) * left
        residual *= residual
        residual += np.float32(1.0)
        residual *= noise[:, None] ** 2
        np.divide(is_seen, residual, out=weight)
        albedo = np.einsum("kn,kn->n", weight, values) / np.maximum(weight.sum(axis=0), 1e-12)
    np.subtract(values, albedo, out=residual)
    residual *= is_seen
    return Brightness(albedo, residual, weight, noise)
