"""Which windows and which views choose the true height of points, told it beforehand beside the height of their map?

For a sample of the visible points: the view that shows a point best, level windows about its pixel at heights within
two steps of the true one and of the one in the map, correlated with neighbour views. The right height wins where the
best correlation lies within `NEAR_M` of the truth. More than this no rule of choice can find with such windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import igl
import numpy as np
from bench_sweep import Case

from evaluation.completeness import is_reached
from fields.image_store import LazyImages
from fields.sweep.bed import unique_pixels
from fields.sweep.kernels.drjit_scoring import NOISE_VARIANCE
from fields.sweep.kernels.stack import ViewStack, largest
from fields.sweep.map_points import MapPoints
from fields.sweep.maps import HeightMap
from refract import FlatWater
from survey.simulate.ground.shapes import TriangleMesh

NEAR_M = 0.05
# Between hypotheses [px], and how many beside the two heights count.
STEP_PX, BESIDE = 0.5, 2
# Pixels about a point that its windows read.
REACH_PX = 4
NEIGHBOURS = 12
# Radius of a window, how far it may be shifted, number of neighbours, and how many of them count (0: the better half).
CHOICES = [(r, shift, *views) for (r, shift), views in product(
    ((1, 0), (2, 0), (2, 2)), ((8, 0), (8, 2), (12, 2)))]  # fmt: skip


@dataclass
class Windows:
    """A swept survey with its true surface (local frame).

    Attributes
    ----------
    case : Case
    maps : list of HeightMap
    surface : TriangleMesh
    """

    case: Case
    maps: list[HeightMap]
    surface: TriangleMesh

    @property
    def water(self) -> FlatWater | None:
        return self.case.block.water

    def classes(self, visible: np.ndarray, under: np.ndarray) -> dict[str, np.ndarray]:
        """Visible points (N, 3) by what became of them: masks (N,)."""
        block, maps = self.case.block, self.maps
        cameras = [block.cameras[m.view] for m in maps]
        images = LazyImages(lambda number: maps[number].height, len(maps), largest(cameras), 1)
        stack = ViewStack.build(block.device, cameras, images, block.water)

        def places(masks) -> np.ndarray:
            frame = stack.kernel_water
            return MapPoints.of(stack, masks).xyz.T.astype(float) @ frame.from_local + frame.origin

        found = is_reached(visible, places(unique_pixels(block, maps, self.case.plan.gsd_m)), tolerance_m=NEAR_M)
        somewhere = is_reached(visible, places(np.isfinite(m.height) for m in maps), tolerance_m=NEAR_M)
        return {
            "under a surface, in no map": under & ~somewhere,
            "under a surface, in a map and no point": under & somewhere & ~found,
            "under a surface, found": under & found,
            "others, found": ~under & found,
        }

    def shares(self, points: np.ndarray) -> list[float]:
        """Share of points (N, 3) at which the right height wins, for each of `CHOICES`."""
        normals = self._normals(points)
        won: list[list[bool]] = [[] for _ in CHOICES]
        cosine = np.stack([self._cosine(number, points, normals) for number in range(len(self.maps))])
        for place, number in enumerate(cosine.argmax(axis=0)):
            if cosine[number, place] > 0.0:
                for target, right in zip(won, self._wins(int(number), points[place]), strict=True):
                    target.append(right)
        return [float(np.mean(each)) if each else float("nan") for each in won]

    def _normals(self, points: np.ndarray) -> np.ndarray:
        _, face, _ = igl.point_mesh_squared_distance(points, self.surface.vertices, self.surface.faces)
        return self.surface.normals[np.asarray(face)]

    def _cosine(self, number: int, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Cosine (N,) between the ray of a view in the water and the normals; 0 where it does not see the point."""
        camera = self.case.block.cameras[self.maps[number].view]
        at, found = camera.project(points, self.water), np.zeros(len(points))
        size, rim = np.array([camera.width, camera.height]), REACH_PX + 2.0
        index = np.flatnonzero((np.isfinite(at) & (at > rim) & (at < size - rim)).all(axis=1))
        start = camera.paths(at[index], self.water).crossing
        way = points[index] - start
        length = np.linalg.norm(way, axis=1)
        way /= length[:, None]
        first, _ = self.surface.hit(start, way, length + 1.0)
        found[index] = np.where(first > length - 0.01, np.maximum(-(way * normals[index]).sum(axis=1), 0.0), 0.0)
        return found

    def _wins(self, number: int, point: np.ndarray) -> list[bool]:
        block, m = self.case.block, self.maps[number]
        camera, views = block.cameras[m.view], [each.view for each in self.maps]
        column, row = np.floor(camera.project(point[None], self.water)[0]).astype(int)
        side = np.arange(-REACH_PX, REACH_PX + 1)
        across, down = np.meshgrid(side, side)
        pixels = np.stack([column + 0.5 + across.ravel(), row + 0.5 + down.ravel()], axis=-1)
        others = block.neighbours(m.view, NEIGHBOURS, candidates=views)
        truth, known = self._height(point), float(m.height[row, column])
        step = STEP_PX / block.parallax(m.view, others, truth)
        beside = step * np.arange(-BESIDE, BESIDE + 1)
        heights = np.concatenate([truth + beside, known + beside])
        path = camera.paths(pixels, self.water)
        at = np.stack([path.at_height(np.full(len(pixels), h), self.water) for h in heights])
        window = np.s_[row - REACH_PX : row + REACH_PX + 1, column - REACH_PX : column + REACH_PX + 1]
        patch = block.images[m.view][window].astype(float)
        seen = np.stack([self._sampled(other, at).reshape(len(heights), len(side), len(side)) for other in others])
        right = np.abs(heights - truth) < NEAR_M
        return [bool(right[_score(patch, seen[:count], radius, shift, best).argmax()])
                for radius, shift, count, best in CHOICES]  # fmt: skip

    def _height(self, point: np.ndarray) -> float:
        water = self.water
        return float(point[2] if water is None else (point - np.array(water.point)) @ np.array(water.up))

    def _sampled(self, view: int, at: np.ndarray) -> np.ndarray:
        """Grey values of a photograph at points (heights, pixels, 3); NaN outside."""
        camera = self.case.block.cameras[view]
        place = camera.project(at.reshape(-1, 3), self.water)
        inside = ((place > 1.0) & (place < (camera.width - 1.0, camera.height - 1.0))).all(axis=1)
        x, y = (np.where(inside, each, 0.0).reshape(at.shape[:2]).astype(np.float32) - 0.5 for each in place.T)
        values = cv2.remap(self.case.block.images[view], x, y, cv2.INTER_LINEAR).astype(float)
        return np.where(inside.reshape(at.shape[:2]), values, np.nan)


def _score(patch: np.ndarray, seen: np.ndarray, radius: int, shift: int, best: int) -> np.ndarray:
    """Correlation (heights,) of windows of a patch with those seen by neighbours (K, heights, side, side)."""
    mean, other = _box(patch, radius), _box(seen, radius)
    variance = np.maximum(_box(patch**2, radius) - mean**2, NOISE_VARIANCE)
    others = np.maximum(_box(seen**2, radius) - other**2, NOISE_VARIANCE)
    ncc = (_box(seen * patch, radius) - mean * other) / np.sqrt(variance * others)
    ranked = -np.sort(-np.where(np.isnan(ncc), -2.0, ncc), axis=0)
    complete = (ranked > -1.5).sum(axis=0)
    half = np.maximum(np.ceil(0.5 * complete), np.minimum(complete, 2))
    counted = np.arange(len(ranked))[:, None, None, None] < (np.minimum(complete, best) if best else half)
    total = np.where(counted, ranked, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    middle = total.shape[-1] // 2
    near = slice(middle - shift, middle + shift + 1)
    return np.where(counted.any(axis=0), total, -1.0)[:, near, near].max(axis=(1, 2))


def _box(values: np.ndarray, radius: int) -> np.ndarray:
    """Means over whole windows of the last two axes."""
    width = 2 * radius + 1
    sums = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(1, 0), (1, 0)]).cumsum(axis=-1).cumsum(axis=-2)
    total = sums[..., width:, width:] - sums[..., :-width, width:] - sums[..., width:, :-width]
    return (total + sums[..., :-width, :-width]) / width**2


def table(windows: Windows, visible: np.ndarray, under: np.ndarray, sample: int) -> str:
    """Markdown: share of the points of each class at which the right height wins."""
    rng = np.random.default_rng(0)
    titles = [
        f"{2 * radius + 1} px{', shifted' if shift else ''}, {f'best {best}' if best else 'better half'} of {count}"
        for radius, shift, count, best in CHOICES
    ]
    classes = windows.classes(visible, under)
    columns = []
    for mask in classes.values():
        chosen = rng.permutation(np.flatnonzero(mask))[:sample]
        columns.append(windows.shares(visible[chosen]))
    lines = ["| windows and views | " + " | ".join(classes) + " |", "|---" * (1 + len(classes)) + "|"]
    counts = " | ".join(f"{int(mask.sum())}" for mask in classes.values())
    lines.append(f"| points | {counts} |")
    lines += [
        f"| {title} | " + " | ".join(f"{100 * column[row]:.0f} %" for column in columns) + " |"
        for row, title in enumerate(titles)
    ]
    return "\n".join(lines)
