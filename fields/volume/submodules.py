"""Submodules: cells on the ground with a volume each, trained apart, and blended in the pictures of cameras.

As in Block-NeRF (Tancik et al. 2022), and after it the NeRF of tidal flats. A cell's box reaches over its own ground by
a rim, in which it overlaps its neighbours'. With c the camera, x_m the middle of the box of submodule m and C_m what it
renders, a pixel has the colour

    C = sum_m s_m w_m C_m / sum_m s_m w_m,  w_m = |c - x_m|^-p                                                     (1)

inverse distance weighting to the pose, on rendered pixels; s_m is 1 where the submodule shows the pixel and was not
left out as hardly visible, else 0. As published, a submodule shows all pixels, by a background (`fields.volume.shell`);
without one it shows those whose path ends inside its box. Distances and points are not blended: two cells that a camera
is equally far from would have equal weights, however well each knows a place. They are those of the submodule on whose
own ground its point lies.

Appearance vectors are matched as in Block-NeRF: one submodule keeps its own; the vector of a neighbour is
fitted until both render the places that they share alike, with all else fixed.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from fields.volume.fitted import ACROSS, SAMPLES, fitted_vectors
from fields.volume.paths import Box, Paths, Rays
from fields.volume.photographs import pixels_over
from fields.volume.renderer import VolumeImage, VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.surface import LEAST_OPACITY
from refract import PinholeCamera, WaterSurface

# A box reaches beyond its cell by this share of it, so that neighbours share half a cell, as blocks of Block-NeRF do.
RIM = 0.25
POWER = 4.0  # p of equation (1)
LEAST_VISIBLE = 0.01  # A submodule is left out of a view that shows it, or its ground, by less than this share
MOST_POINTS = 50_000  # Points of the bed at which visibility is computed and appearance is matched
MOST_CAMERAS = 32  # Cameras whose views match the appearance of two submodules
MATCHED_RAYS = 512  # Rays of each step of that


@dataclass(frozen=True)
class Grid:
    """Cells of equal size on the ground of a box, ``counts`` of them along x and y; counted along x first."""

    box: Box
    counts: tuple[int, int]
    trained: tuple[int, ...] = ()  # Numbers of those that have a volume; empty: all

    def __len__(self) -> int:
        return self.counts[0] * self.counts[1]

    @property
    def size(self) -> np.ndarray:
        """Edges (2,) [m] of a cell."""
        return self.box.size[:2] / self.counts

    def names(self) -> list[str]:
        """Names of the cells: their number along x and along y."""
        return [f"{column}_{row}" for row in range(self.counts[1]) for column in range(self.counts[0])]

    def owner(self, xy: np.ndarray) -> np.ndarray:
        """Numbers (...) of the cells in which places (..., 2 or more) [m] lie; elsewhere, of the nearest trained."""
        at = np.floor((xy[..., :2] - self.box.low[:2]) / self.size)
        column, row = np.moveaxis(np.clip(np.nan_to_num(at), 0, np.array(self.counts) - 1).astype(int), -1, 0)
        number = np.asarray(row * self.counts[0] + column)
        without = ~np.isin(number, self.trained or range(len(self)))
        beside = xy[without][..., :2]
        nearest, least = np.zeros(len(beside), int), np.full(len(beside), np.inf)
        for trained in self.trained:
            low = self.box.low[:2] + self.size * divmod(trained, self.counts[0])[::-1]
            distance = np.linalg.norm(beside - np.clip(beside, low, low + self.size), axis=-1)
            nearest[distance < least] = trained
            least = np.fmin(least, distance)
        number[without] = nearest
        return number

    def box_of(self, number: int) -> Box:
        """The box of a cell with its rim, inside that of all."""
        row, column = divmod(number, self.counts[0])
        low = self.box.low[:2] + self.size * (column - RIM, row - RIM)
        low, high = np.maximum(low, self.box.low[:2]), np.minimum(low + self.size * (1 + 2 * RIM), self.box.high[:2])
        return Box(np.append(low, self.box.low[2]), np.append(high, self.box.high[2]))


def counts_of(text: str, size: np.ndarray) -> tuple[int, int]:
    """Cells along x and y of "3x2", or of a number of cells that are as square as may be on ground of a size [m]."""
    if "x" in text:
        columns, rows = text.split("x")
        return int(columns), int(rows)
    number = int(text)
    pairs = [(n, number // n) for n in range(1, number + 1) if number % n == 0]
    return min(pairs, key=lambda pair: abs(np.log(size[0] / pair[0] * pair[1] / size[1])))


@dataclass(frozen=True)
class Submodule:
    """A trained volume of one cell of a grid."""

    number: int  # of its cell
    renderer: VolumeRenderer
    cells: Cells  # The proxy that training left

    @property
    def box(self) -> Box:
        return self.renderer.model.box


def pose_weights(centre: np.ndarray, boxes: Sequence[Box], power: float = POWER) -> np.ndarray:
    """Weights (M,) of submodules for a camera at a place (3,) [m], of sum 1: the powers of their inverse distances."""
    distances = np.array([np.linalg.norm(centre - 0.5 * (box.low + box.high)) for box in boxes])
    weights = (distances.min() / distances) ** power
    return weights / weights.sum()


def render_submodules(
    submodules: Iterable[tuple[float, Submodule]],
    grid: Grid,
    camera: PinholeCamera,
    water: WaterSurface | None,
    *,
    samples: int = 48,
    dry: bool = False,
) -> VolumeImage:
    """Image of (weight, submodule), rendered one at a time, by a camera, blended by their weights by equation (1)."""
    shape = (camera.height, camera.width)
    rgb, weights, opacity = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape, np.float32)
    distance, points = np.full(shape, np.nan, np.float32), np.full((*shape, 3), np.nan, np.float32)
    # Of the submodule that gives the place: the one whose ground it is before others, then the weightiest.
    rank = np.full(shape, -1.0)
    for weight, submodule in submodules:
        shown = None if submodule.renderer.background is not None else pixels_over(camera, submodule.box, water)
        if shown is not None and not len(shown):
            continue
        renderer, cells = submodule.renderer, submodule.cells
        seen = render_volume(renderer, camera, water, cells, samples=samples, dry=dry, shown=shown)
        mask = np.zeros(shape, bool)
        mask.flat[slice(None) if shown is None else shown] = True
        rgb[mask] += weight * seen.rgb[mask]
        weights[mask] += weight
        is_hit = mask & np.isfinite(seen.distance) & (seen.opacity > LEAST_OPACITY)
        own = np.where(is_hit, weight + (grid.owner(seen.points) == submodule.number), -1.0)
        better = own > rank
        given = ((rank, own), (distance, seen.distance), (opacity, seen.opacity), (points, seen.points))
        for target, values in given:
            target[better] = values[better]
    rgb /= np.where(weights > 0.0, weights, 1.0)[..., None]
    return VolumeImage(rgb.astype(np.float32), distance, opacity, points)


def ground_shares(grid: Grid, bed: np.ndarray, camera: PinholeCamera, water: WaterSurface | None) -> np.ndarray:
    """Shares (cells,) of the picture of a camera that show the ground of each cell, by the known bed (N, 3) [m].

    Of the points in a square of the picture, `ACROSS` along its longer side, the nearest hides the others.
    """
    bed = thinned(bed)
    pixels, step = camera.project(bed, water), max(camera.width, camera.height) / ACROSS
    inside = camera.sees(pixels)
    bed, pixels = bed[inside], pixels[inside]
    columns, rows = (int(np.ceil(side / step)) for side in (camera.width, camera.height))
    column, row = (pixels // step).astype(int).T
    order = np.argsort(np.linalg.norm(bed - camera.centre, axis=1))
    _, first = np.unique((row * columns + column)[order], return_index=True)
    return np.bincount(grid.owner(bed[order[first]]), minlength=len(grid)) / (columns * rows)


def kept(visible: np.ndarray, least: float = LEAST_VISIBLE) -> np.ndarray:
    """Indices (K,) of the submodules whose visibilities (M,) reach a least one, and of the most visible always."""
    return np.flatnonzero((visible >= least) | (visible == visible.max()))


def thinned(points: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """At most so many of points (N, 3), evenly through their order."""
    return points[:: max(-(-len(points) // most), 1)]


def _inside(points: np.ndarray, box: Box) -> np.ndarray:
    return np.logical_and.reduce((points > box.low) & (points < box.high), axis=1)


def single_vector(vector: torch.Tensor) -> nn.Embedding:
    """The appearance of a renderer that is the same for all photographs: one vector (A,)."""
    return nn.Embedding.from_pretrained(vector.detach().clone()[None], freeze=True)


def vectors_of(submodule: Submodule) -> torch.Tensor:
    """The appearance vectors (photographs, A) of a submodule. Raises ValueError if it has none."""
    own = submodule.renderer.appearance
    if own is None:
        raise ValueError("the submodules have no appearance vectors to match; train them with some")
    return own.weight.detach()


def matching_pairs(boxes: Sequence[Box], root: int, bed: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs (m, n) in which m is to be matched to n, which is matched: those that share the most ground first."""
    points = thinned(bed)
    inside = np.array([_inside(points, box) for box in boxes])
    common = inside.astype(int) @ inside.T.astype(int)
    done = [root]
    while len(done) < len(boxes):
        remaining = [m for m in range(len(boxes)) if m not in done]
        m, n = max(((m, n) for m in remaining for n in done), key=lambda pair: common[pair])
        yield m, n
        done.append(m)


def match_submodule(
    target: Submodule,
    source: Submodule,
    cameras: Sequence[PinholeCamera],
    bed: np.ndarray,
    water: WaterSurface | None,
    *,
    steps: int = 100,
) -> bool:
    """Match a submodule to another, which has a single vector, along rays of the nearest cameras to places in both.

    All else of both is unchanged. False: they share no ground, and it gets the mean of its own vectors.
    """
    points, parts = thinned(bed[_inside(bed, target.box) & _inside(bed, source.box)], MOST_POINTS // 10), []
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    for camera in sorted(cameras, key=lambda each: float(np.linalg.norm(each.centre - middle)))[:MOST_CAMERAS]:
        pixels = camera.project(points, water)
        pixels = pixels[camera.sees(pixels)]
        parts.append(Rays.of(camera, pixels, np.zeros((len(pixels), 3), dtype=np.uint8), 0))
    shared = Rays.concatenate(parts)
    if not len(shared.view):
        target.renderer.appearance = single_vector(vectors_of(target).mean(dim=0))
        return False
    rng, place = np.random.default_rng(0), target.renderer.model.place
    source_cells = source.cells.to(place)

    def draw() -> Paths:
        some = shared[rng.integers(len(shared.view), size=MATCHED_RAYS)]
        paths, source_paths = some.paths(water, target.box).to(place), some.paths(water, source.box).to(place)
        with torch.no_grad():
            samples = source.renderer.samples(source_paths, source_cells, SAMPLES, jitter=False)
            paths.rgb = source.renderer.render(source_paths, samples).rgb.clamp(max=1.0)
        return paths

    target.renderer.appearance = fitted_vectors(target.renderer, 1, target.cells, draw, steps=steps)
    return True
