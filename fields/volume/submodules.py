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

from __future__ import annotations

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
        number[without] = self._nearest_trained(xy[without][..., :2])
        return number

    def _nearest_trained(self, xy: np.ndarray) -> np.ndarray:
        """Numbers (N,) of the trained cells whose edges are nearest to places (N, 2) [m]."""
        nearest, least = np.zeros(len(xy), int), np.full(len(xy), np.inf)
        for number in self.trained:
            low = self.box.low[:2] + self.size * divmod(number, self.counts[0])[::-1]
            distance = np.linalg.norm(xy - np.clip(xy, low, low + self.size), axis=-1)
            nearest[distance < least] = number
            least = np.fmin(least, distance)
        return nearest

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
        """Its box."""
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
    """Image of submodules by a camera, blended by their weights as in equation (1).

    ``submodules``: iterable of (weight, Submodule), those that the view has, one of which is rendered at a time.
    """
    blend = Blend(camera, grid)
    for weight, submodule in submodules:
        shown = None if submodule.renderer.background is not None else pixels_over(camera, submodule.box, water)
        if shown is not None and not len(shown):
            continue
        seen = render_volume(
            submodule.renderer, camera, water, submodule.cells, samples=samples, dry=dry, shown=shown
        )  # fmt: skip
        blend.add(weight, submodule.number, seen, shown)
    return blend.view()


class Blend:
    """A picture that submodules are blended into, one after the other."""

    def __init__(self, camera: PinholeCamera, grid: Grid):
        shape = (camera.height, camera.width)
        self.grid = grid
        self._rgb, self._weight = np.zeros((*shape, 3)), np.zeros(shape)
        # Of the submodule that gives the place: the one whose ground it is before others, then the weightiest.
        self._rank = np.full(shape, -1.0)
        self._distance, self._points = np.full(shape, np.nan, np.float32), np.full((*shape, 3), np.nan, np.float32)
        self._opacity = np.zeros(shape, np.float32)

    def add(self, weight: float, number: int, seen: VolumeImage, shown: np.ndarray | None) -> None:
        """Add the view of a submodule that has a weight and the number of a cell; None: it shows every pixel."""
        mask = np.ones(self._weight.shape, bool)
        if shown is not None:
            mask[:] = False
            mask.flat[shown] = True
        self._rgb[mask] += weight * seen.rgb[mask]
        self._weight[mask] += weight
        is_hit = mask & np.isfinite(seen.distance) & (seen.opacity > LEAST_OPACITY)
        rank = np.where(is_hit, weight + (self.grid.owner(seen.points) == number), -1.0)
        better = rank > self._rank
        for kept, new in ((self._rank, rank), (self._distance, seen.distance), (self._opacity, seen.opacity)):
            kept[better] = new[better]
        self._points[better] = seen.points[better]

    def view(self) -> VolumeImage:
        """The picture."""
        rgb = self._rgb / np.where(self._weight > 0.0, self._weight, 1.0)[..., None]
        return VolumeImage(rgb.astype(np.float32), self._distance, self._opacity, self._points)


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


def shared_rays(
    cameras: Iterable[PinholeCamera], bed: np.ndarray, one: Box, other: Box, water: WaterSurface | None
) -> Rays | None:
    """Rays of the nearest cameras to points of the bed (N, 3) [m] that lie in two boxes; None where there are none."""
    points = thinned(bed[_inside(bed, one) & _inside(bed, other)], MOST_POINTS // 10)
    if not len(points):
        return None
    middle, parts = points.mean(axis=0), []
    for camera in sorted(cameras, key=lambda each: float(np.linalg.norm(each.centre - middle)))[:MOST_CAMERAS]:
        pixels = camera.project(points, water)
        pixels = pixels[camera.sees(pixels)]
        parts.append(Rays.of(camera, pixels, np.zeros((len(pixels), 3), dtype=np.uint8), 0))
    rays = Rays.concatenate(parts)
    return rays if len(rays.view) else None


def _inside(points: np.ndarray, box: Box) -> np.ndarray:
    return np.logical_and.reduce((points > box.low) & (points < box.high), axis=1)


def matched_vector(
    target: Submodule, source: Submodule, shared: Rays, water: WaterSurface | None, *, steps: int = 100, rays: int = 512
) -> nn.Embedding:
    """The appearance vector with which a submodule matches another along rays to places that both show.

    All else of both is unchanged. Raises ValueError if the submodule has no vectors.

    ``source``: one whose renderer has a single vector: the appearance to match.
    """
    rng, place = np.random.default_rng(0), target.renderer.model.place
    source_cells = source.cells.to(place)

    def draw() -> Paths:
        some = shared[rng.integers(len(shared.view), size=rays)]
        paths, source_paths = some.paths(water, target.box).to(place), some.paths(water, source.box).to(place)
        with torch.no_grad():
            samples = source.renderer.samples(source_paths, source_cells, SAMPLES, jitter=False)
            paths.rgb = source.renderer.render(source_paths, samples).rgb.clamp(max=1.0)
        return paths

    return fitted_vectors(target.renderer, 1, target.cells, draw, steps=steps)


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
    rays: int = 512,
) -> bool:
    """Match a submodule to another; False: they share no ground, and it gets the mean of its own vectors."""
    shared = shared_rays(cameras, bed, target.box, source.box, water)
    if shared is None:
        target.renderer.appearance = single_vector(vectors_of(target).mean(dim=0))
    else:
        target.renderer.appearance = matched_vector(target, source, shared, water, steps=steps, rays=rays)
    return shared is not None
