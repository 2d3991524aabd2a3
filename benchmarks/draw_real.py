"""Draw docs/img/real-profile.png: the lake along its lidar profile, and its bed, from the runs of bench_real.py.

    python benchmarks/draw_real.py FOLDER

FOLDER is the work folder of bench_real.py in which greenland was measured. The blue strip is 1.96 times the stated
random standard deviation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from bench_real import DATA
from real_measures import LEVEL_M, LIDAR_INDEX, NORTH_M, STRIP_M, SURFACE_M, lidar_places

from geo import read_cloud

mpl.use("Agg")
from matplotlib import pyplot as plt

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "img" / "real-profile.png"
EAST_M, CELL_M, STEP_M, FEWEST = (560700.0, 560840.0), 2.0, 3.0, 50
COLOURS = {"bent": "#1f6fb4", "straight": "#d1662a"}


def main() -> None:
    """Draw the picture."""
    runs = {name: read_cloud(Path(sys.argv[1]) / "greenland" / name / "bathynerf" / "cloud.las") for name in COLOURS}
    east, north, height = lidar_places(DATA / "greenland_lake" / "lidar_profile_lon_lat_height.csv")
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 4.2), width_ratios=[1.7, 1.0], dpi=90)
    for name, cloud in runs.items():
        along, over, reach = _profile(cloud, east, north)
        left.plot(along, over, color=COLOURS[name], label=f"{name} rays")
        if name == "bent":
            left.fill_between(
                along, over - reach, over + reach, color=COLOURS[name], alpha=0.15, lw=0, label="1.96 std"
            )
    wet, dry = height < LEVEL_M - SURFACE_M, height > LEVEL_M + SURFACE_M
    true = np.where(wet, (height - LEVEL_M) / LIDAR_INDEX, height - LEVEL_M)
    shown = (wet | dry) & (north > NORTH_M[0]) & (north < NORTH_M[1])
    left.plot(north[shown] - NORTH_M[0], true[shown], "k.", ms=5, label="lidar over its index")
    left.axhline(0.0, color="#7fb2d6", lw=1)
    left.set(xlabel="north along the profile [m]", ylabel="height over the water [m]", ylim=(-7.0, 2.0))
    left.legend(frameon=False, fontsize=8)
    extent = [0.0, EAST_M[1] - EAST_M[0], 0.0, NORTH_M[1] - NORTH_M[0]]
    image = right.imshow(_raster(runs["bent"].points), origin="lower", extent=extent, vmin=-6.0, vmax=3.0)
    figure.colorbar(image, ax=right, label="height over the water [m]")
    right.plot(east[shown] - EAST_M[0], north[shown] - NORTH_M[0], "w-", lw=1)
    right.set(xlabel="east [m]", ylabel="north [m]")
    figure.tight_layout()
    figure.savefig(PICTURE)


def _profile(cloud, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along the profile: northing, median height over the water and 1.96 times the median std of each step [m]."""
    x, y, z = cloud.points.T
    order, std = np.argsort(north), np.asarray(cloud.extra["std"])
    beside = np.abs(x - np.interp(y, north[order], east[order])) < STRIP_M
    rows = []
    for first in np.arange(*NORTH_M, STEP_M):
        here = beside & (y >= first) & (y < first + STEP_M)
        if here.sum() > FEWEST:
            middle = first + 0.5 * STEP_M - NORTH_M[0]
            rows.append((middle, np.median(z[here]) - LEVEL_M, 1.96 * np.median(std[here])))
    return tuple(np.array(rows).T)


def _raster(points: np.ndarray) -> np.ndarray:
    """Mean height over the water in cells, the lowest northing first; NaN without a point."""
    edges = [np.arange(low, high + CELL_M, CELL_M) for low, high in (NORTH_M, EAST_M)]
    at = (points[:, 1], points[:, 0])
    total, *_ = np.histogram2d(*at, bins=edges, weights=points[:, 2] - LEVEL_M)
    count, *_ = np.histogram2d(*at, bins=edges)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


if __name__ == "__main__":
    main()
