"""How well can the heights of a survey be known at all, and how near to that does the cloud come?

    python benchmarks/bench_bound.py [--scenes sand eight ...] [-o FOLDER]

Draws surveys that are hard: few photographs, flown low over deep water, bare sand. At places of the true bed the grey
levels of all photographs that see them change with the height of a window. Their changes less the mean of all
photographs (the albedo is not known) and less what noise adds to them, squared and summed over the window, over the
variance of the noise are the information on the height (bound of Cramer and Rao). With it goes what the window takes
from the relief. The noise is the sensor's alone, or what photographs differ by at the true height, which holds also
what is finer than their pixels: each folds it at another phase. Prints rows of Markdown for
docs/decisions.md: both bounds, and the cloud of standard quality; std of the inner 90 % of the errors.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from bench_solver import BATHYNERF, FINE, accuracy, inner90, raster_of
from scipy.ndimage import map_coordinates
from stress_factors import bare_sand

from evaluation.summary import MAD_TO_STD
from fields.solver.visibility import lookup
from geo import read_reference
from refract import PinholeCamera, crossing_point
from survey.folder.local_frame import water_plane
from survey.folder.survey import Survey, load_survey
from survey.photos.images import ImageStore
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.sidecars import StagedScene
from survey.simulate.writing import write_survey

NUM_PLACES = 1500
WINDOWS_PX = (3, 5, 7, 11, 15)
# Heights are changed by so much parallax to both sides [px]: texture is a pixel wide and more.
STEP_PX = 0.5
# The solver takes so many photographs of a place at most.
MOST_VIEWS = 20
# Of three channels with as much noise each, that of their brightness.
GREY_NOISE = math.hypot(0.299, 0.587, 0.114)


Staging = Callable[[StagedScene], StagedScene]


@dataclass(frozen=True)
class Case:
    """A survey to be drawn."""

    name: str
    scene: DrawnScene
    staging: Staging = lambda scene: scene


def _flown(flying_m: float, depth_m: float, side_m: float, num_views: int = 20, **more) -> DrawnScene:
    gsd = flying_m / 840.0
    fine = {"cell_m": min(gsd, 0.025), "texel_m": min(0.4 * gsd, 0.01)}
    scene = {"size_m": (side_m, 0.9 * side_m), "depth_m": depth_m, "flying_m": flying_m, "num_views": num_views}
    return DrawnScene(**scene, noise=2.0, seed=21, **fine, **more)


def _flooded(rise_m: float) -> Staging:
    """With more water, nearer to the cameras."""

    def flooded(scene: StagedScene) -> StagedScene:
        level = replace(scene.level, level_m=scene.level.known_level_m + rise_m)
        return replace(scene, level=level, renderer=replace(scene.renderer, water=water_plane(scene.frame, level)))

    return flooded


CASES = {
    "eight": Case("8 photographs, 20 m over 2.5 m", _flown(20.0, 2.5, 7.0, num_views=8)),
    "low": Case("flown 2.5 m over 3 m of water", _flown(3.7, 1.8, 1.8), _flooded(1.2)),
    "deep": Case("flown 8 m over 10 m of water", _flown(12.2, 5.8, 6.0), _flooded(4.2)),
    "sand": Case("bare sand", _flown(20.0, 2.5, 9.0, objects=False), lambda scene: bare_sand(scene, 1.0)),
}


class Bed:
    """The highest surface of the truth as a raster, local [m]."""

    def __init__(self, survey: Survey, truth: Path, gsd: float):
        mesh = read_reference(truth / "reference.ply")
        vertices = survey.frame.local_from_crs(mesh.vertices)
        self._heights, self._low, self._cell = raster_of(vertices, vertices, mesh.faces, gsd / FINE)

    def height(self, places: np.ndarray) -> np.ndarray:
        """Over places (..., 2)."""
        at = np.moveaxis((places[..., ::-1] - self._low[::-1]) / self._cell, -1, 0)
        return map_coordinates(self._heights, at, order=1, mode="nearest")

    def hides(self, points: np.ndarray, crossing: np.ndarray) -> np.ndarray:
        """Whether it lies between points (N, 3) and where their rays cross the water."""
        share = np.linspace(0.03, 0.97, 24)[:, None, None]
        along = points + share * (crossing - points)
        return (along[..., 2] < self.height(along[..., :2]) - self._cell).any(axis=0)


@dataclass(frozen=True)
class Seen:
    """Windows of the true bed, P of W x W points, in K photographs.

    Attributes
    ----------
    grey, change : (K, P, W, W) [grey levels], [grey levels/m]
        At the true height, and with the height of the window; NaN where a photograph does not show all of it.
    """

    grey: np.ndarray
    change: np.ndarray

    @classmethod
    def of(cls, survey: Survey, points: np.ndarray, hidden: np.ndarray, images: list[np.ndarray], step: float) -> Seen:
        """Of points (P, W, W, 3) in images (height, width); windows (K, P) that are hidden are left out."""
        up = np.array([0.0, 0.0, step])
        grey, change = [], []
        for view, image, behind in zip(survey.views, images, hidden, strict=True):
            at, over, under = (_values(view.camera, survey, image, points + h * up) for h in (0.0, 1.0, -1.0))
            whole = np.isfinite(at + over + under).all(axis=(1, 2)) & ~behind
            grey.append(np.where(whole[:, None, None], at, np.nan))
            change.append(np.where(whole[:, None, None], (over - under) / (2.0 * step), np.nan))
        return cls(np.stack(grey), np.stack(change))

    def differing(self, values: np.ndarray) -> np.ndarray:
        """Values (K, P, W, W) less the mean of all photographs, which the albedo takes."""
        known = np.isfinite(values)
        return values - np.nansum(values, axis=0) / np.maximum(known.sum(axis=0), 1)


def _values(camera: PinholeCamera, survey: Survey, image: np.ndarray, points: np.ndarray) -> np.ndarray:
    pixels = camera.project(points.reshape(-1, 3), survey.water)
    x, y = np.nan_to_num(pixels.T.astype(np.float32), nan=-1e3)
    return lookup(image, x, y, cv2.INTER_CUBIC).reshape(points.shape[:-1])


def bounds_of(survey: Survey, truth: Path, noise: float) -> dict[str, float]:
    """Std of the inner 90 % of the errors [m] that the best window leaves, by the noise that is counted."""
    gsd = float(np.median([-survey.water.depth(v.camera.centre) / v.camera.fx for v in survey.views]))
    bed, rng = Bed(survey, truth, gsd), np.random.default_rng(5)
    e0, n0, e1, n1 = survey.bounds
    low, high = (survey.frame.local_from_crs(np.array([[e, n, 0.0]]))[0, :2] for e, n in ((e0, n0), (e1, n1)))
    places = rng.uniform(low, high, (NUM_PLACES, 2))
    found: dict[str, list[float]] = {"sensor": [], "photographs": []}
    for width in WINDOWS_PX:
        points = _windows(bed, places, gsd, width)
        relief = points[..., 2] - points[:, width // 2, width // 2, None, None, 2]
        for name, information in _information(survey, bed, points, noise, rng).items():
            known = information > 0.0
            error = rng.standard_normal(known.sum()) / np.sqrt(information[known]) + relief[known].mean(axis=(1, 2))
            found[name].append(float(inner90(error).std()))
    return {name: min(each) for name, each in found.items()}


def _windows(bed: Bed, places: np.ndarray, gsd: float, width: int) -> np.ndarray:
    """Points (P, W, W, 3) of the true bed about places (P, 2)."""
    offset = gsd * (np.arange(width) - width // 2)
    plan = places[:, None, None] + np.stack(np.meshgrid(offset, offset), axis=-1)
    return np.concatenate([plan, bed.height(plan)[..., None]], axis=-1)


def _information(survey: Survey, bed: Bed, points: np.ndarray, noise: float, rng) -> dict[str, np.ndarray]:
    """Of the height of each window (P,) [1/m^2], by which noise; zero where fewer than two photographs see it."""
    middle = points[:, points.shape[1] // 2, points.shape[2] // 2]
    hidden = np.stack([bed.hides(middle, crossing_point(middle, v.camera.centre, survey.water)) for v in survey.views])
    store, step = ImageStore(), _step(survey, middle)
    images = [store.grey(view) for view in survey.views]
    seen = Seen.of(survey, points, hidden, images, step)
    white = [rng.standard_normal(image.shape).astype(np.float32) for image in images]
    of_white = Seen.of(survey, points, hidden, white, step)
    count = np.isfinite(seen.grey[:, :, 0, 0]).sum(axis=0)
    answer, chance = (np.nansum(each.differing(each.change) ** 2, axis=(0, 2, 3)) for each in (seen, of_white))
    # Photographs by turns, where there are more than are used.
    share = np.minimum(1.0, MOST_VIEWS / np.maximum(count, 1))
    stds = {"sensor": noise, "photographs": _misfit(seen) / _misfit(of_white)}
    return {
        name: np.where(count > 1, share * np.maximum(answer - std**2 * np.mean(chance[count > 1]), 0.0) / std**2, 0.0)
        for name, std in stds.items()
    }


def _step(survey: Survey, points: np.ndarray) -> float:
    """The height [m] that moves the image of a place by `STEP_PX`, in the middle."""
    raised = points + np.array([0.0, 0.0, 0.01])
    pixels = ([v.camera.project(p, survey.water) for v in survey.views] for p in (points, raised))
    moved = np.linalg.norm(np.subtract(*(np.stack(each) for each in pixels)), axis=-1)
    return 0.01 * STEP_PX / float(np.nanmedian(moved))


def _misfit(seen: Seen) -> float:
    """How far photographs are from each other at the true height, without the brightness of each window."""
    level = seen.grey - seen.grey.mean(axis=(2, 3), keepdims=True)
    return MAD_TO_STD * float(np.nanmedian(np.abs(seen.differing(level))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_bound_"))
    for key in options.scenes:
        case, survey_folder, run = CASES[key], folder / key, folder / f"{key}_run"
        write_survey(survey_folder, asdict(case.scene), lambda case=case: case.staging(stage_drawing(case.scene)))
        subprocess.run(
            [sys.executable, "-c", BATHYNERF, "process", str(survey_folder), "-o", str(run), "-qq"], check=True
        )
        truth = survey_folder / "truth"
        bounds = bounds_of(load_survey(survey_folder), truth, GREY_NOISE * case.scene.noise)
        shown = " | ".join(f"{1e3 * each:.2f} mm" for each in bounds.values())
        print(f"| {case.name} | {shown} | {accuracy(survey_folder, run, truth)} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
