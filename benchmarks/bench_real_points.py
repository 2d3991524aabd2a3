"""How good are depths of real points that straight rays made? Straight, times the index, per camera, and bent rays.

python benchmarks/bench_real_points.py DATA [--every N] [--noise PX] [--seed N]

DATA is the folder with `real/pyBathySfM` and `real/palau_coral_heights` (docs/evaluation.md says where they are from).

1. pyBathySfM: 64,920 points of a stream bed that structure from motion found with straight rays, with the level over
   each and 31 camera poses. Nobody measured that bed, so that its points are held against what the package itself makes
   of them.
   Which cameras made a point is not known: all that have it in their frame, or those within 35 degrees and 100 m, as
   the package has it.
2. The same stream with a truth: the bed that bent rays find there is photographed through the water by the same
   cameras, pixels get noise, straight rays meet in points, and all methods correct these. Also ten times as deep.
3. Palau: heights of 51 coral heads, measured by tape. The poses of that flight are not published: a level block of a
   usual drone stands for them.
"""

from __future__ import annotations

import argparse
import gzip
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from baselines import per_camera, times_index
from scipy.spatial.transform import Rotation

from refract import FlatWater, project

# What pyBathySfM takes for the stream, and its filter: cameras within these of a point.
STREAM_INDEX, NEAR_DEG, NEAR_M = 1.337, 35.0, 100.0
# Sea water at 28 degrees.
SEA_INDEX = 1.339
# A DJI Phantom 4 Pro: 8.8 mm before 13.2 x 8.8 mm.
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 5472, 3648, 3648.0
# Steps of Gauss and Newton; the last moves a point by less than a micrometre.
STEPS, STEP_M = 6, 1e-4
POINTS_AT_ONCE = 4000
TO_95 = 1.959964


@dataclass(frozen=True)
class Block:
    """N points of a bed and the V cameras that see them; the water lies at height 0 over each point.

    Attributes
    ----------
    centres : (N, V, 3) float64 [m]
        Of the cameras, above the water over each point.
    turns : (V, 3, 3)
        From the axes of the points to those of the cameras: x right, y down, z forward.
    seen : (N, V) bool
    index : float
        Of the water.
    """

    centres: np.ndarray
    turns: np.ndarray
    seen: np.ndarray
    index: float

    def part(self, rows: slice) -> Block:
        """That of some of the points."""
        return replace(self, centres=self.centres[rows], seen=self.seen[rows])

    def pixels(self, points: np.ndarray, *, bent: bool) -> np.ndarray:
        """Where points (N, 3) appear, (N, V, 2) [px] from the middle of the image, with bent or straight rays."""
        water = FlatWater((0.0, 0.0, 0.0), n_water=self.index) if bent else None
        rays = np.asarray(project(points[:, None], self.centres, water).direction)
        in_cam = np.einsum("nvi,vji->nvj", rays, self.turns)
        return FOCAL_PX * in_cam[..., :2] / in_cam[..., 2:]

    def incidence(self, points: np.ndarray) -> np.ndarray:
        """Angle (N, V) [rad] between the vertical and the straight lines to the cameras."""
        away = self.centres - points[:, None]
        return np.arctan2(np.hypot(away[..., 0], away[..., 1]), away[..., 2])

    def near(self, points: np.ndarray) -> Block:
        """The block with those cameras alone that the filter of pyBathySfM keeps."""
        away = self.centres - points[:, None]
        level = np.hypot(away[..., 0], away[..., 1])
        near = (self.incidence(points) <= math.radians(NEAR_DEG)) & (level <= NEAR_M)
        return replace(self, seen=self.seen & near)


def meet(block: Block, start: np.ndarray, observed: np.ndarray, *, bent: bool) -> tuple[np.ndarray, np.ndarray]:
    """Where rays through pixels (N, V, 2) [px] meet by least squares, (N, 3) [m], and its standard deviation per pixel
    of noise, of the height (N,) [m/px].
    """
    points, stds = np.empty_like(start), np.empty(len(start))
    for first in range(0, len(start), POINTS_AT_ONCE):
        rows = slice(first, first + POINTS_AT_ONCE)
        points[rows], stds[rows] = _meet(block.part(rows), start[rows], observed[rows], bent=bent)
    return points, stds


def _meet(block: Block, points: np.ndarray, observed: np.ndarray, *, bent: bool) -> tuple[np.ndarray, np.ndarray]:
    weight = block.seen[..., None].astype(np.float64)
    inverse = np.full((len(points), 3, 3), np.nan)
    for _ in range(STEPS):
        design = np.stack([_derivative(block, points, axis, bent=bent) for axis in np.eye(3)], axis=-1)
        design, miss = design * weight[..., None], (observed - block.pixels(points, bent=bent)) * weight
        inverse = np.linalg.inv(np.einsum("nvpi,nvpj->nij", design, design))
        points = points + np.einsum("nij,nvpj,nvp->ni", inverse, design, miss)
    return points, np.sqrt(inverse[:, 2, 2])


def _derivative(block: Block, points: np.ndarray, axis: np.ndarray, *, bent: bool) -> np.ndarray:
    ahead, behind = (block.pixels(points + side * STEP_M * axis, bent=bent) for side in (1.0, -1.0))
    return (ahead - behind) / (2.0 * STEP_M)


@dataclass(frozen=True)
class Depths:
    """Depths (N,) [m] of the same points by each method, and the standard deviation of those by bent rays [m/px]."""

    straight: np.ndarray
    times_index: np.ndarray
    per_camera: np.ndarray
    bent: np.ndarray
    bent_std_per_px: np.ndarray

    def methods(self) -> dict[str, np.ndarray]:
        """By the names of the table."""
        return {
            "straight": self.straight,
            "times index": self.times_index,
            "per camera (Dietrich)": self.per_camera,
            "bent rays, least squares": self.bent,
        }


def corrected(block: Block, straight: np.ndarray, observed: np.ndarray | None = None) -> Depths:
    """All corrections of points (N, 3) that straight rays made.

    Parameters
    ----------
    block : Block
    straight : (N, 3) [m]
    observed : (N, V, 2) [px], optional
        Where the photographs show them; by default where straight rays put the points into them.
    """
    depth = -straight[:, 2]
    if observed is None:
        observed = block.pixels(straight, bent=False)
    start = straight * [1.0, 1.0, block.index]
    bent, std = meet(block, start, observed, bent=True)
    return Depths(
        depth,
        times_index(depth, block.index),
        per_camera(depth, block.incidence(straight), block.seen, block.index),
        -bent[:, 2],
        std,
    )


@dataclass(frozen=True)
class Stream:
    """The sample of pyBathySfM: points (N, 3), and for both sets of cameras the block and its own depths (N,) [m]."""

    straight: np.ndarray
    every: tuple[Block, np.ndarray]
    near: tuple[Block, np.ndarray]


def read_stream(folder: Path, every: int = 1) -> Stream:
    """The sample, every so many of its points."""
    table = _table(folder / "pyBathySfM_output_n1.337.csv.gz")[::every]
    cameras = np.genfromtxt(folder / "BathySfM_SampleCameras.csv", delimiter=",", names=True)
    points = np.column_stack([table["x"], table["y"], table["sfm_z"]])
    places = np.column_stack([cameras["x"], cameras["y"], cameras["z"]])
    turns = np.array([_turn(*row) for row in zip(cameras["yaw"], cameras["pitch"], cameras["roll"], strict=True)])
    # Each point counts from the water over it, and all from the middle of the points.
    middle = np.append(points[:, :2].mean(axis=0), 0.0)
    level = np.column_stack([np.zeros((len(table), 2)), table["w_surf"]])
    centres = (places - middle)[None] - level[:, None]
    straight = points - middle - level
    rays = np.einsum("nvi,vji->nvj", straight[:, None] - centres, turns)
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = np.abs(FOCAL_PX * rays[..., :2] / rays[..., 2:]) < 0.5 * np.array([WIDTH_PX, HEIGHT_PX])
    block = Block(centres, turns, inside.all(axis=2) & (rays[..., 2] > 0.0), STREAM_INDEX)
    return Stream(straight, (block, table["h_avg"]), (block.near(straight), table["h_filt"]))


def _turn(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """From east, north, up to a camera of the sample, whose Euler angles turn north, east, up (3, 3)."""
    axes = Rotation.from_euler("ZYX", [yaw, 90.0 - pitch, -roll], degrees=True).as_matrix()
    forward, side, up = axes.T[:, [1, 0, 2]]
    return np.stack([side, -up, forward])


def _table(path: Path) -> np.ndarray:
    with gzip.open(path, "rt") as stream:
        return np.genfromtxt(stream, delimiter=",", names=True)


@dataclass(frozen=True)
class Repeated:
    """The stream photographed again, of a bed that is known: depths (N,) [m].

    `from_points` are by bent rays from the straight points alone, as of points whose photographs are not at hand.
    """

    truth: np.ndarray
    found: Depths
    from_points: np.ndarray
    noise_px: float

    @property
    def inside(self) -> float:
        """Share of the heights by bent rays within 1.96 of their standard deviations."""
        std = self.noise_px * self.found.bent_std_per_px
        return float((np.abs(self.found.bent - self.truth) <= TO_95 * std).mean())


def repeated(block: Block, bed: np.ndarray, noise_px: float, seed: int) -> Repeated:
    """Photograph a bed (N, 3) [m] through the water, with noise, and correct where straight rays meet."""
    noise = noise_px * np.random.default_rng(seed).standard_normal((*block.seen.shape, 2))
    observed = block.pixels(bed, bent=True) + noise
    straight, _ = meet(block, bed / [1.0, 1.0, block.index], observed, bent=False)
    return Repeated(-bed[:, 2], corrected(block, straight, observed), corrected(block, straight).bent, noise_px)


def usual_block(depth: float, flying: float = 40.0) -> tuple[Block, np.ndarray]:
    """A level block with 80 and 70 % of overlap over points (N, 3) of a bed, of the camera above, over the sea."""
    wide, long = flying * WIDTH_PX / FOCAL_PX, flying * HEIGHT_PX / FOCAL_PX
    x, y = np.meshgrid(np.arange(-6, 7) * 0.3 * wide, np.arange(-9, 10) * 0.2 * long)
    centres = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, flying)])
    east, north = np.meshgrid(np.linspace(0.0, 0.3, 10) * wide, np.linspace(0.0, 0.2, 10) * long)
    bed = np.column_stack([east.ravel(), north.ravel(), np.full(east.size, -depth)])
    turns = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(centres), 3, 3))
    everyone = np.broadcast_to(centres, (len(bed), *centres.shape))
    block = Block(everyone, turns, np.ones((len(bed), len(centres)), dtype=bool), SEA_INDEX)
    inside = np.abs(block.pixels(bed, bent=True)) < 0.5 * np.array([WIDTH_PX, HEIGHT_PX])
    return replace(block, seen=inside.all(axis=2)), bed


def palau(folder: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Heights (51,) [m] of coral heads by tape, and by each method from those on the raw surface model."""
    path = folder / "IM_GCP.csv"
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    raw = 0.01 * table["DEM_Height"]
    # Where depth is small against the flying height all methods are factors, of depths and so of their differences.
    block, bed = usual_block(float(np.median(-table["Measured_depth"])))
    straight, _ = meet(block, bed, block.pixels(bed, bent=True), bent=False)
    found = corrected(block, straight)
    factors = {name: float(np.median(depth / found.straight)) for name, depth in found.methods().items()}
    methods = {f"{name} (x {factor:.3f})": factor * raw for name, factor in factors.items()}
    return 0.01 * table["Measured_height"], methods | {
        "corrected by its authors": 0.01 * table["DEM_Height_refraction"]
    }


def main() -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with real/pyBathySfM and real/palau_coral_heights")
    parser.add_argument("--every", type=int, default=1, help="use every so many of the points of the stream")
    parser.add_argument("--noise", type=float, default=0.5, help="of pixels, one standard deviation [px]")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    stream = read_stream(options.data / "real" / "pyBathySfM", options.every)
    say(f"pyBathySfM: {len(stream.straight)} real points of a stream, index {STREAM_INDEX}")
    for which, (block, theirs) in (("all cameras", stream.every), (f"within {NEAR_DEG:g} deg", stream.near)):
        real = corrected(block, stream.straight)
        views = block.seen.sum(axis=1)
        say(f"\n{which}, {views.min()} to {views.max()} for a point: against the depths that pyBathySfM gives")
        factor = {name: float(np.median(depth / real.straight)) for name, depth in real.methods().items()}
        table({f"{name} (x {factor[name]:.3f})": depth for name, depth in real.methods().items()}, theirs)
        bed = np.column_stack([stream.straight[:, :2], -real.bent])
        for deeper in (1.0, 10.0):
            known = repeated(block, bed * [1.0, 1.0, deeper], options.noise, options.seed)
            low, high = np.quantile(known.truth, [0.05, 0.95])
            say(f"\n{which}, photographed again: {low:.2f} to {high:.2f} m deep, noise of {options.noise:g} px")
            table(known.found.methods() | {"the same, of the points alone": known.from_points}, known.truth)
            say(f"  heights by bent rays within 1.96 of their standard deviations: {100.0 * known.inside:.1f} %")
    truth, methods = palau(options.data / "real" / "palau_coral_heights")
    say(f"\nPalau: heights of {len(truth)} coral heads against a tape, index {SEA_INDEX}")
    table(methods, truth)


def table(methods: dict[str, np.ndarray], truth: np.ndarray) -> None:
    """Print mean, standard deviation and root mean square of what methods err, in millimetres."""
    width = max(len(name) for name in methods)
    say(f"  {'':{width}}  mean [mm]  std [mm]  rmse [mm]")
    for name, depth in methods.items():
        error = 1000.0 * (depth - truth)
        rms = math.sqrt(float(np.mean(error**2)))
        say(f"  {name:{width}}  {error.mean():9.2f}  {error.std():8.2f}  {rms:9.2f}")


def say(line: str) -> None:
    """Print a line."""
    sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
