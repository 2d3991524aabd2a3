"""Do colour, glint or smooth areas of photographs tell that there is water? Signs of it, over water and over dry land.

    python benchmarks/water_by_colour.py NAME=FOLDER ...

Largest (and median) share of a photograph in each folder: of the largest connected area in which blue and green are a
tenth brighter than red, of pixels that are saturated in all channels, and of the largest areas without texture, and
without texture and darker than the rest.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from survey.photos.images import list_images
from survey.photos.pixels import read_rgb
from survey.photos.texture import SIZE, largest_area, water_signs

SIGNS = ("blue-green", "saturated", "smooth", "smooth and dark")


def signs_of(pixels: np.ndarray) -> tuple[float, float, float, float]:
    """The shares of `SIGNS` in a photograph (height, width, 3) uint8."""
    small = cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    red, green, blue = np.moveaxis(small, -1, 0)
    cast = 3.0 * (np.minimum(green, blue) - red) / (small.sum(axis=2) + 1.0)
    grey = small.mean(axis=2)
    mean = cv2.blur(grey, (5, 5))
    deviation = np.sqrt(np.maximum(cv2.blur(grey**2, (5, 5)) - mean**2, 0.0))
    saturated = float((pixels.min(axis=2) >= 250).mean())
    return (
        largest_area(cast > 0.1, 3),
        saturated,
        largest_area(deviation < 0.06 * np.maximum(mean, 10.0), 5),
        water_signs(cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA))[0],
    )


def main() -> None:
    """Print a line for each folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="NAME=FOLDER")
    for given in parser.parse_args().folders:
        name, _, folder = given.partition("=")
        shares = np.array([signs_of(read_rgb(path)) for path in list_images(Path(folder)).values()])
        said = (f"{sign} {each.max():.4f} ({np.median(each):.4f})" for sign, each in zip(SIGNS, shares.T, strict=True))
        sys.stdout.write(f"{name}, {len(shares)} photographs: {', '.join(said)}\n")


if __name__ == "__main__":
    main()
