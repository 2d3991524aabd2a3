"""Coverage of the bed by a planned block through the water, and its picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract import PinholeCamera
from survey.compare.canvas import canvas, save, write_title
from survey.display.palette import BLUE, INK, OBLIQUE, SOFT
from survey.simulate.flight.patterns import Site

# Points along each axis of the area at which views are counted.
_POINTS = 41
# Largest tilt of a nadir photograph [deg].
NADIR_DEG = 7.0
_SIDE_IN = 7.0


@dataclass(frozen=True)
class BedCoverage:
    """Coverage of the bed by a block of photographs."""

    footprints: np.ndarray  # (views, 5, 2) [m], local: east and north of the corners of each image on the bed, closed
    # east, north: (columns,), (rows,) [m], local
    east: np.ndarray
    north: np.ndarray
    num_views: np.ndarray  # (rows, columns): of a bed at its mean depth

    @property
    def unseen_share(self) -> float:
        """Share of the area that fewer than three photographs see."""
        return float((self.num_views < 3).mean())


def coverage(cameras: Sequence[PinholeCamera], site: Site) -> BedCoverage:
    """Coverage of a level bed at the site's mean depth by a block."""
    half = 0.5 * np.array(site.size_m)
    east, north = (np.linspace(-h, h, _POINTS) for h in half)
    x, y = np.meshgrid(east, north)
    points = np.stack([x, y, np.full_like(x, site.level - site.depth_m)], axis=-1)
    num_views = np.zeros(x.shape, dtype=np.int64)
    for camera in cameras:
        num_views += camera.sees(camera.project(points, site.water))
    footprints = np.array([_footprint(camera, site) for camera in cameras])
    return BedCoverage(footprints, east, north, num_views)


def _footprint(camera: PinholeCamera, site: Site) -> np.ndarray:
    """East and north (5, 2) [m] of the corners of an image on the bed, through the water."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]) * (camera.width, camera.height)
    return camera.paths(corners, site.water).at_height(np.full(5, -site.depth_m), site.water)[:, :2]


def draw_flight(path: Path, cameras: Sequence[PinholeCamera], cover: BedCoverage, site: Site) -> None:
    """Plan view as PNG: number of views of the bed, footprints, and cameras with their viewing direction."""
    figure, axes = canvas(_SIDE_IN, _SIDE_IN)
    most = max(int(cover.num_views.max()), 1)
    shades = axes.pcolormesh(cover.east, cover.north, cover.num_views, cmap="YlGnBu", vmin=0, vmax=most)
    figure.colorbar(shades, label="views of the bed through the water", shrink=0.7)
    for corners in cover.footprints:
        axes.plot(*corners.T, color=SOFT, linewidth=0.4, alpha=0.6)
    centres = np.array([camera.centre for camera in cameras])
    forward = np.array([camera.cam_from_local[2] for camera in cameras])
    down = -forward[:, 2] > np.cos(np.radians(NADIR_DEG))
    axes.plot(*centres[:, :2].T, color=INK, linewidth=0.6, alpha=0.7)
    axes.plot(*centres[down, :2].T, "o", color=BLUE, markersize=4, label="nadir")
    if not down.all():
        axes.plot(*centres[~down, :2].T, "o", color=OBLIQUE, markersize=4, label="oblique")
        reach = (centres[~down, 2] - site.level)[:, None] * forward[~down, :2] / -forward[~down, 2:]
        axes.quiver(
            *centres[~down, :2].T, *reach.T, angles="xy", scale_units="xy", scale=2.0, width=0.002, color=OBLIQUE
        )
    axes.set(xlabel="east of the origin [m]", ylabel="north of the origin [m]", aspect="equal")
    height = float(np.median(centres[:, 2]) - site.level)
    write_title(axes, f"{len(cameras)} photographs from {height:.1f} m, bed {site.depth_m:.1f} m deep")
    axes.legend(loc="upper right", fontsize=8)
    save(figure, path)
