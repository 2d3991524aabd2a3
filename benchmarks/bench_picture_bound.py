"""How near can a perfect rendering come to photographs that are noisy and stored as JPEG?

    python benchmarks/bench_picture_bound.py SURVEY [--noise 1] [--every 8] [--seed 0]

Each chosen photograph, moved by some pixels so that its blocks are others, stands for what a perfect rendering shows:
noise [grey levels] is added, and it is stored with the quantization of the photograph. Prints the PSNR of the noisy
one, of the stored one, and of the noisy one stored, against it: means of squared errors over the photographs. A
photograph has noise of its own, so that a little more of it survives than of a rendering.
"""

import argparse
import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image, JpegImagePlugin

from survey.folder.survey import load_survey

# Rows and columns that are cut off, no multiples of a block.
CUT = (3, 5)
ROWS = ("noise", "JPEG", "noise and JPEG")


def stored(picture: np.ndarray, like: JpegImagePlugin.JpegImageFile) -> np.ndarray:
    """A picture (height, width, 3) uint8 as it comes back from a JPEG with the tables and sampling of another."""
    stream = io.BytesIO()
    sampling = JpegImagePlugin.get_sampling(like)
    Image.fromarray(picture).save(stream, "JPEG", qtables=like.quantization, subsampling=sampling)
    return np.asarray(Image.open(stream))


def squared_errors(path: Path, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Mean squared errors (3,), of `ROWS`, of a photograph."""
    with Image.open(path) as image:
        if not isinstance(image, JpegImagePlugin.JpegImageFile):
            raise SystemExit(f"{path} is a {image.format}, expected a JPEG, whose tables are used")
        clean = np.asarray(image)[CUT[0] :, CUT[1] :]
        noisy = np.clip(np.round(clean + rng.normal(0.0, noise, clean.shape)), 0, 255).astype(np.uint8)
        seen = (noisy, stored(clean, image), stored(noisy, image))
    return np.array([np.mean((each.astype(float) - clean) ** 2) for each in seen])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    paths = [view.path for view in load_survey(options.survey).views[:: options.every]]
    errors = np.mean([squared_errors(path, options.noise, rng) for path in paths], axis=0)
    for name, error in zip(ROWS, errors, strict=True):
        sys.stdout.write(f"{name}: {10.0 * np.log10(255.0**2 / error):.2f} dB\n")


if __name__ == "__main__":
    main()
