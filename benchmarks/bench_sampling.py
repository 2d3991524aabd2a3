"""Does the sweep lock to pixels, and would another sampler or a filter before it do better?

    python benchmarks/bench_sampling.py [SURVEY ...] [--scenes N] [-o FOLDER]

First pairs of photographs of a flat texture, shifted by known fractions of a pixel and matched as the last pass does:
the mean error at each fraction, and the spread. Then surveys: those of `bench_lens.py`, drawn at random and seen
through a pinhole, and any SURVEY with known truth. Prints the tables in Markdown; docs/notes/sweep.md has them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from bench_lens import draw, drawn_scene
from bench_sweep import Case
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter, uniform_filter

from fields.sweep import block as block_module
from fields.sweep.kernels import drjit_kernels
from fields.sweep.kernels.stack import ViewStack

# Standard deviation of a Gauss filter of all images [px], 0 for none; and the order of the spline that is sampled.
SAMPLERS = {
    "bilinear (kept)": (0.0, 1),
    "Gauss 0.4 px, bilinear": (0.4, 1),
    "Gauss 0.5 px, bilinear": (0.5, 1),
    "Gauss 0.6 px, bilinear": (0.6, 1),
    "Gauss 0.8 px, bilinear": (0.8, 1),
    "cubic spline": (0.0, 3),
    "Gauss 0.5 px, cubic spline": (0.5, 3),
}
# Pairs: samples of the texture per pixel, grey levels of texture and noise, heights tried and their distance [px].
FINE, CONTRAST, NOISE, HYPOTHESES, STEP = 10, 35.0, 1.0, (-1, 0, 1), 0.25
SHIFTS = np.arange(10) / 10.0


def photographs(pixels: int, rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """A function that takes a photograph (pixels, pixels) of a texture, shifted along x by a number of pixels."""
    size = FINE * (pixels + 4)
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(size)]))
    texture = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) / np.maximum(frequency, 0.002)).real
    texture *= CONTRAST / texture.std()

    def take(shift: float) -> np.ndarray:
        first = 2 * FINE + round(FINE * shift)
        part = texture[2 * FINE : FINE * (pixels + 2), first : first + FINE * pixels]
        return part.reshape(pixels, FINE, pixels, FINE).mean(axis=(1, 3)) + NOISE * rng.normal(size=(pixels, pixels))

    return take


def ncc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation over windows of 3 x 3."""
    mean = partial(uniform_filter, size=3)
    va, vb = (np.maximum(mean(v * v) - mean(v) ** 2, 1.0) for v in (a, b))
    return (mean(a * b) - mean(a) * mean(b)) / np.sqrt(va * vb)


def matched(sigma: float, order: int, pixels: int = 256) -> tuple[np.ndarray, float]:
    """Mean error at each of the shifts, and the spread of the inner 90 % of the errors [px]."""
    rng = np.random.default_rng(1)
    take = photographs(pixels, rng)
    reference, *others = (gaussian_filter(take(shift), sigma) for shift in (0.0, *SHIFTS))
    y, x = np.mgrid[:pixels, :pixels].astype(np.float64)
    means, spreads = [], []
    for shift, other in zip(SHIFTS, others, strict=True):
        # The heights of the pass before, smooth and off by a quarter of a pixel.
        start = 6.0 * gaussian_filter(rng.uniform(-0.25, 0.25, x.shape), 4.0)
        places = [(y, x - shift + start + STEP * number) for number in HYPOTHESES]
        low, middle, high = (ncc(reference, map_coordinates(other, at, order=order, mode="nearest")) for at in places)
        bend = np.maximum(2.0 * middle - low - high, 1e-6)
        offset = np.where(middle >= np.maximum(low, high), np.clip(0.5 * (high - low) / bend, -0.5, 0.5), 0.0)
        offset += np.where(middle < np.maximum(low, high), np.sign(high - low), 0.0)
        error = (start + STEP * offset)[8:-8, 8:-8]
        means.append(error.mean())
        spreads.append(error[np.abs(error) <= np.quantile(np.abs(error), 0.9)].std())
    return np.array(means), float(np.mean(spreads))


@contextmanager
def sampler(sigma: float, order: int) -> Iterator[None]:
    """The sweep in Dr.Jit with images filtered, and neighbours sampled by a spline of that order."""
    build, warp, raw = ViewStack.build, drjit_kernels.warp, {}

    def filtered(device, cameras, images, water, *skips):
        images = [gaussian_filter(image, sigma) for image in images] if sigma else images
        stack = build(device, cameras, images, water, *skips)
        if order == 3:
            splines = [spline_filter(image, order=3, output=np.float32) for image in images]
            raw[id(stack)] = build(device, cameras, splines, water, *skips)
        return stack

    def warped(values, stack, *rest):
        # Height maps are compared as they are.
        with patch.object(drjit_kernels, "sample_packed", _cubic):
            warp(values, raw[id(stack)], *rest)

    class Images(ViewStack):
        build = staticmethod(filtered)

    with (
        patch.object(block_module, "ViewStack", Images),
        patch.object(drjit_kernels, "warp", warped if order == 3 else warp),
    ):
        yield


def _cubic(stack: ViewStack, view, u, v, inside):
    """`fields.sweep.kernels.drjit_kernels.sample_packed` of the coefficients of a cubic spline."""
    import drjit as dr

    Float, UInt, Int = (getattr(stack.device.module, name) for name in ("Float", "UInt", "Int"))
    x, y = (dr.select(inside, at - 0.5, 1.0) for at in (u, v))
    x0, y0 = Int(x), Int(y)

    def weights(f):
        near = [(3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0 for s in (f, 1.0 - f)]
        return (1.0 - f) * (1.0 - f) * (1.0 - f) / 6.0, *near, f * f * f / 6.0

    columns = [UInt(dr.clip(x0 + k, 0, stack.width - 1)) for k in (-1, 0, 1, 2)]
    total = Float(0.0)
    for k, by_row in zip((-1, 0, 1, 2), weights(y - Float(y0)), strict=True):
        row = UInt(dr.clip(y0 + k, 0, stack.height - 1)) * stack.width
        across = zip(columns, weights(x - Float(x0)), strict=True)
        total += by_row * sum(w * dr.gather(Float, stack.pixels[view], row + column, inside) for column, w in across)
    return dr.select(inside, total, dr.nan)


def pairs_table() -> str:
    """Markdown of the errors in pairs."""
    lines = ["| pairs | least and greatest mean error over the shifts | mean over them | std |", "|---|---|---|---|"]
    for name, way in SAMPLERS.items():
        means, spread = matched(*way)
        cells = (
            f"{1e3 * means.min():.0f} and {1e3 * means.max():.0f}",
            f"{1e3 * means.mean():.1f}",
            f"{1e3 * spread:.0f}",
        )
        lines.append(f"| {name} | " + " | ".join(f"{cell} mpx" for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def survey_table(folder: Path, names: list[str]) -> str:
    """Markdown of the figures of a survey."""
    case = Case(folder, "standard")
    lines = [f"| {folder.name} | mean | std | at 0.2 m | at 0.05 m | beyond 0.2 m |", "|---|---|---|---|---|---|"]
    for name in names:
        case.block.release(1.0)
        with sampler(*SAMPLERS[name]):
            r = case.figures(case.points(case.maps()[0]))
        cells = [f"{1e3 * r['mean_inner90_m']:.2f} mm", f"{1e3 * r['std_inner90_m']:.2f} mm"]
        cells += [f"{100 * r[k]:.2f} %" for k in ("complete_0.2", "complete_0.05", "beyond_0.2")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surveys", nargs="*", type=Path)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--samplers", nargs="+", default=list(SAMPLERS), choices=list(SAMPLERS))
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    work = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_sampling_"))
    sys.stdout.write(pairs_table() + "\n")
    for seed in range(1, options.scenes + 1):
        draw(work / f"{seed}_pinhole", drawn_scene(seed), "pinhole")
        options.surveys.append(work / f"{seed}_pinhole")
    for folder in options.surveys:
        sys.stdout.write(survey_table(folder, options.samplers) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
