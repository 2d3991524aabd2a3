"""Weight of each colour channel in the matched texture, for the index of the water.

Matching compares grey, ``g = sum of w c`` over the channels c with the weights w of luma. A channel that is shifted by
a little moves the best match of g by its share ``w <dc, dg> / <dg, dg>`` of that, d for derivatives along the rows and
the columns. Products are taken between neighbours across the derivative, where white noise has none in common. In deep
water red has no texture left and its share is nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from refract.dispersion import mixed_index, mixed_wavelength
from survey.photos.cameras import View
from survey.photos.images import LUMA, grey_levels, load_mask, load_pixels
from survey.photos.saturation import saturated

# Reduction of photographs: JPEG subsamples colours, so that single pixels have none of their own.
_SMALLER = 4
# So many photographs, spread over the survey, are enough.
MOST_PHOTOGRAPHS = 8
# Least standard deviation [grey levels] of texture between adjacent reduced pixels from which shares are computed.
_FAINT = 0.05


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
    """The shares of the channels in some of the photographs, spread evenly; what masks leave out does not count.

    Raises
    ------
    ImageError
        Where one of them cannot be read.
    """
    some = np.unique(np.linspace(0, len(views) - 1, MOST_PHOTOGRAPHS).astype(int))
    found = [texture_of(_smaller(views[i])) for i in some]
    products, count = np.sum([f[0] for f in found], axis=0), sum(f[1] for f in found)
    total = float(products.sum())
    if total <= count * _FAINT**2:
        return MatchedLight()
    # A channel without texture may come out a little below zero by its noise.
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

    Glint has the colour of the sun, and would count as texture of all channels.
    """
    pixels = load_pixels(view)
    size = (max(pixels.shape[1] // _SMALLER, 1), max(pixels.shape[0] // _SMALLER, 1))
    white = 255.0 if pixels.dtype == np.uint8 else 65535.0
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) * np.float32(255.0 / white)
    used, mask = ~saturated(grey_levels(pixels)), load_mask(view)
    used = used if mask is None else used & mask
    if not used.all():
        share = cv2.resize(used.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small[share < 1.0 - 1e-4] = np.nan
    return small
