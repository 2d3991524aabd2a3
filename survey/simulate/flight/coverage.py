"""Coverage of the bed by a planned block through the water, whether the block determines the water level, a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO

import matplotlib.figure
import numpy as np

from refract import PinholeCamera
from survey.display.palette import BLUE, INK, OBLIQUE, SOFT
from survey.simulate.flight.patterns import Site

# Points along each axis of the area at which views are counted.
_POINTS = 41
# Simulated tie points along each axis.
_TIES = 9
# Step of level and point [m] for finite differences: the projection is smooth over metres.
_STEP = 1e-3
# Systematic image errors of calibrated cameras that no adjustment removes [px].
SYSTEMATIC_PX = 0.1
# A level that systematic errors can shift by more than this is not observed [m]: the bed would follow by a third to a
# half as much, beyond the vertical uncertainty of 0.25 m that IHO S-44 allows its special order at the surface.
_LEVEL_KNOWN_M = 0.5
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
    # [px/m]: root mean square residual of the rays of a point per metre of error in the water level, after the point
    # has been intersected again. None for a dry block.
    level_px_per_m: float | None

    @property
    def masked_level_error_m(self) -> float | None:
        """Error of the level that systematic image errors can mask [m]."""
        return None if self.level_px_per_m is None else SYSTEMATIC_PX / max(self.level_px_per_m, 1e-9)

    @property
    def warnings(self) -> list[str]:
        """Warnings about the flight, as sentences."""
        found = []
        hidden = self.masked_level_error_m
        if hidden is not None and hidden > _LEVEL_KNOWN_M:
            found.append(
                f"the block cannot observe the water level: an error of {min(hidden, 99.0):.1f} m changes image "
                f"residuals by only {SYSTEMATIC_PX:g} px. Measure the level, or fly oblique views that cross "
                '(patterns "oblique", "five" or "outer")'
            )
        few = float((self.num_views < 3).mean())
        if few > 0.0:
            found.append(
                f"{100.0 * few:.0f} % of the area is seen by fewer than three photographs; give more overlap, or a "
                "smaller area"
            )
        return found


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
    sensitivity = None if site.water is None else _level_sensitivity(cameras, site)
    return BedCoverage(footprints, east, north, num_views, sensitivity)


def _footprint(camera: PinholeCamera, site: Site) -> np.ndarray:
    """East and north (5, 2) [m] of the corners of an image on the bed, through the water."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]) * (camera.width, camera.height)
    path = camera.paths(corners, site.water)
    bed = site.level - site.depth_m
    if site.water is None:
        t = (bed - camera.centre[2]) / path.air_direction[:, 2]
        return (camera.centre + t[:, None] * path.air_direction)[:, :2]
    t = (bed - path.crossing[:, 2]) / path.water_direction[:, 2]
    return (path.crossing + t[:, None] * path.water_direction)[:, :2]


def _level_sensitivity(cameras: Sequence[PinholeCamera], site: Site) -> float:
    """Root mean square residual per metre of error in the level: `BedCoverage.level_px_per_m`.

    Per point, with J the derivatives of its pixels by its position and l those by the level, the residual is
    ``l - J (J'J)^-1 J' l``.
    """
    half = 0.45 * np.array(site.size_m)
    x, y = (c.ravel() for c in np.meshgrid(*(np.linspace(-h, h, _TIES) for h in half)))
    points = np.stack([x, y, np.full(x.size, site.level - site.depth_m)], axis=-1)
    seen = np.array([camera.sees(camera.project(points, site.water)) for camera in cameras])

    def pixels(moved: np.ndarray, views: Sequence[PinholeCamera] = cameras) -> np.ndarray:
        return np.array([camera.project(moved, site.water) for camera in views])

    steps = _STEP * np.eye(3)
    by_point = np.stack([(pixels(points + s) - pixels(points - s)) / (2.0 * _STEP) for s in steps], axis=-1)
    # Water that rises by dz is water at rest with cameras and points lower by dz.
    up = np.array([0.0, 0.0, 1.0])
    lowered = [replace(camera, centre=camera.centre - _STEP * up) for camera in cameras]
    by_level = (pixels(points - _STEP * up, lowered) - pixels(points)) / _STEP
    left, count = 0.0, 0
    for k in range(len(points)):
        views = seen[:, k]
        if views.sum() < 3:
            continue
        j, level = by_point[views, k].reshape(-1, 3), by_level[views, k].ravel()
        residual = level - j @ np.linalg.lstsq(j, level, rcond=None)[0]
        left, count = left + residual @ residual, count + len(residual)
    return float(np.sqrt(left / count)) if count else 0.0


def picture(cameras: Sequence[PinholeCamera], cover: BedCoverage, site: Site) -> bytes:
    """Plan view as PNG: number of views of the bed, footprints, and cameras with their viewing direction."""
    figure = matplotlib.figure.Figure(figsize=(_SIDE_IN, _SIDE_IN), layout="constrained")
    axes = figure.add_subplot()
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
    axes.set_title(f"{len(cameras)} photographs from {height:.1f} m, bed {site.depth_m:.1f} m deep", fontsize=10)
    axes.legend(loc="upper right", fontsize=8)
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
