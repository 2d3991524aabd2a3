"""Texture and sharpness of photographs: weights of the colour channels, white pixels.

Matching compares grey, ``g = sum of w c`` over the channels c with the weights w of luma. If a channel is shifted, the
best match of g shifts by the share ``w <dc, dg> / <dg, dg>`` of that, d for derivatives along rows and columns.
Products are taken between neighbours across the derivative, so that white noise cancels. In deep water red has no
texture left, and a share of zero.

Sharpness is the ratio of the finest to coarser detail. It depends on the scene, so that a photograph is blurred only
relative to others of the same bed by the same camera. Motion removes detail along its direction alone, so that four
directions are evaluated separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from refract.media import mixed_index, mixed_wavelength
from survey.photos.cameras import View
from survey.photos.images import LUMA, grey_levels, load_mask, load_pixels
from survey.photos.pixels import read_rgb

# White, 255, less a margin for noise and JPEG [grey levels].
_WHITE = 250.0
# A photograph of which more than this share is white shows the sun, or its exposure, rather than the bed.
MOSTLY_WHITE = 0.5
# Width of the fainter rim of glint around saturated pixels, which hides the bed as well [px].
_RIM_PX = 1
# Standard deviations of the Gaussians that leave fine and coarse detail, and half the way of their differences [px].
_FINE, _COARSE = (0.7, 1), (2.8, 4)
_DIRECTIONS = ((1, 0), (0, 1), (1, 1), (1, -1))
# Squares of an image; the half with more coarse detail counts.
_SQUARE_PX = 64
# Side of the middle of an image that is used [px].
_MOST_PX = 2048
_FEWEST_PX = 16
# Least energy of coarse detail [grey levels squared], so that squares without any detail have a ratio.
_LEAST = 1e-3
# Grey levels of a photograph of one colour, with noise and JPEG, differ by less; those of one in the dark are below.
PLAIN_STD, _BLACK_LEVEL = 2.0, 16.0
# Largest values of numbers of 10 to 12 bits in a file of 16, whose white is 65535.
_LOW_BITS = range(1 << 9, 1 << 12)
# Reduction of photographs: JPEG subsamples colours, so that single pixels have none of their own.
_SMALLER = 4
# So many photographs, spread over the survey, are enough.
MOST_PHOTOGRAPHS = 8
# Least standard deviation [grey levels] of texture between adjacent reduced pixels from which shares are computed.
_FAINT = 0.05


def saturated_pixels(grey: np.ndarray) -> np.ndarray:
    """Saturated pixels of an image (height, width) of 0 to 255, and those beside them, (height, width) bool."""
    white = (grey >= _WHITE).astype(np.uint8)
    side = 2 * _RIM_PX + 1
    return cv2.dilate(white, np.ones((side, side), np.uint8)).astype(bool) if white.any() else white.astype(bool)


@dataclass(frozen=True)
class ImageDetail:
    """Detail in a photograph, for its sharpness."""

    detail: np.ndarray  # (4,): see `detail_of`
    white: float  # [-]: share of its pixels that are white or beside white; see `saturated_pixels`
    is_plain: bool = False  # Whether it is black, as under a lens cap, or has one colour all over
    low_bits: int | None = None  # Bits that its numbers need, where they need far fewer than the file has


def image_detail(path: Path) -> ImageDetail:
    """Detail and white of a photograph."""
    grey = grey_levels(pixels := read_rgb(path))
    is_plain = bool(np.std(grey) < PLAIN_STD or np.quantile(grey, 0.99) < _BLACK_LEVEL)
    largest = int(pixels.max())
    # Sensors have 10 or 12: a factor for the 11 bits of the brightest that was looked at would overflow in others.
    low_bits = (10 if largest < 1 << 10 else 12) if pixels.dtype == np.uint16 and largest in _LOW_BITS else None
    return ImageDetail(detail_of(grey), float(saturated_pixels(grey).mean()), is_plain, low_bits)


def bytes_per_pixel(paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Bytes per pixel (N,) of the files of photographs: few where these show little."""
    return np.array([path.stat().st_size / (w * h) for path, (w, h) in zip(paths, sizes, strict=True)])


def detail_of(grey: np.ndarray) -> np.ndarray:
    """Ratios (4,) of fine to coarse detail along rows, columns and both diagonals; the higher, the sharper.

    Of an image (height, width) of grey levels, 0 to 255; NaN for less than 16 pixels a side.
    """
    if min(grey.shape) < _FEWEST_PX:
        return np.full(len(_DIRECTIONS), np.nan)
    top, left = (max(side - _MOST_PX, 0) // 2 for side in grey.shape)
    grey = grey[top : top + _MOST_PX, left : left + _MOST_PX].astype(np.float32)
    levels = [(cv2.GaussianBlur(grey, (0, 0), sigma), half_step) for sigma, half_step in (_FINE, _COARSE)]
    ratios = []
    for dx, dy in _DIRECTIONS:
        fine, coarse = (_energies(level, dx * half_step, dy * half_step) for level, half_step in levels)
        textured = coarse >= np.median(coarse)
        ratios.append(np.median(np.sqrt(fine[textured] / np.maximum(coarse[textured], _LEAST))))
    return np.array(ratios)


def relative_sharpness(details: Sequence[np.ndarray]) -> np.ndarray:
    """Relative sharpness of images (N,), by `detail_of`: the worst direction over the median of all images."""
    every = np.array(details)
    return (every / np.median(every, axis=0)).min(axis=1)


def _energies(grey: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Mean squares, by squares of the image, of differences between pixels 2 (dx, dy) apart."""
    rim, (height, width) = _COARSE[1], grey.shape
    after = grey[rim + dy : height - rim + dy, rim + dx : width - rim + dx]
    before = grey[rim - dy : height - rim - dy, rim - dx : width - rim - dx]
    squared = (after - before) ** 2
    side = min(_SQUARE_PX, *squared.shape)
    rows, columns = (length // side for length in squared.shape)
    parts = squared[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return parts.mean(axis=(1, 3)).ravel()


@dataclass(frozen=True)
class MatchedLight:
    """The light whose texture is matched."""

    shares: tuple[float, float, float] = LUMA  # (3,) [-]: of red, green and blue; they add up to 1
    is_measured: bool = False  # Whether photographs told them; else they are the weights of luma

    @property
    def wavelength_nm(self) -> float:
        """Wavelength [nm] at which water has the index of this mixture of the channels."""
        return mixed_wavelength(self.shares)

    def __str__(self) -> str:
        red, green, blue = (f"{100.0 * share:.0f} %" for share in self.shares)
        source = "of the texture of the photographs" if self.is_measured else "by the weights of luma"
        return f"light of {self.wavelength_nm:.0f} nm (red {red}, green {green}, blue {blue} {source})"

    def index(self, temperature_c: float, salinity_psu: float) -> float:
        """Index of water, relative to air."""
        return mixed_index(self.shares, temperature_c, salinity_psu)


def matched_light(views: Sequence[View]) -> MatchedLight:
    """The shares of the channels in some of the photographs, spread evenly; what masks leave out does not count."""
    some = np.unique(np.linspace(0, len(views) - 1, MOST_PHOTOGRAPHS).astype(int))
    found = [texture_of(_smaller(views[i])) for i in some]
    products, count = np.sum([f[0] for f in found], axis=0), sum(f[1] for f in found)
    total = float(products.sum())
    if total <= count * _FAINT**2:
        return MatchedLight()
    # Noise may make the share of a channel without texture slightly negative.
    shares = np.maximum(products, 0.0)
    red, green, blue = (float(share) for share in shares / shares.sum())
    return MatchedLight((red, green, blue), is_measured=True)


def texture_of(pixels: np.ndarray) -> tuple[np.ndarray, int]:
    """Products (3,) of the derivatives of each weighted channel with those of grey, summed, and their number.

    ``pixels`` (height, width, 3) are in grey levels, NaN where left out.
    """
    weighted = pixels * np.array(LUMA, dtype=np.float32)
    total, count = np.zeros(3), 0
    for along in (0, 1):
        change = np.diff(np.moveaxis(weighted, along, 0), axis=0)
        grey = change.sum(axis=2, keepdims=True)
        product = change[:, 1:] * grey[:, :-1]
        known = np.isfinite(product).all(axis=2)
        total += product[known].sum(axis=0, dtype=np.float64)
        count += int(known.sum())
    return total, count


def _smaller(view: View) -> np.ndarray:
    """A photograph in grey levels, of a quarter of its width and height, NaN where it is masked or white.

    White pixels are left out because glint has the colour of the sun, and would count as texture of all channels.
    """
    pixels, mask = load_pixels(view), load_mask(view)
    size = (max(pixels.shape[1] // _SMALLER, 1), max(pixels.shape[0] // _SMALLER, 1))
    white = np.float32(255.0 / np.iinfo(pixels.dtype).max)
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) * white
    used = ~saturated_pixels(grey_levels(pixels)) & (True if mask is None else mask)
    if not used.all():
        small[cv2.resize(used.astype(np.float32), size, interpolation=cv2.INTER_AREA) < 1.0 - 1e-4] = np.nan
    return small
