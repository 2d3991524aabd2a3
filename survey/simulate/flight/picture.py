"""A picture of a flight plan: camera positions, and how many views cover the bed."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import matplotlib.figure
import numpy as np

from refract import PinholeCamera
from survey.display.palette import BLUE, INK, OBLIQUE, SOFT
from survey.simulate.flight.coverage import Coverage
from survey.simulate.flight.patterns import Site

_LOOKS_DOWN = np.cos(np.radians(7.0))
_SIDE_IN = 7.0


def picture(cameras: Sequence[PinholeCamera], cover: Coverage, site: Site) -> bytes:
    """A plan view as PNG: views of the bed as shades, footprints, cameras with their direction of view."""
    figure = matplotlib.figure.Figure(figsize=(_SIDE_IN, _SIDE_IN), layout="constrained")
    axes = figure.add_subplot()
    most = max(int(cover.num_views.max()), 1)
    shades = axes.pcolormesh(cover.east, cover.north, cover.num_views, cmap="YlGnBu", vmin=0, vmax=most)
    figure.colorbar(shades, label="views of the bed through the water", shrink=0.7)
    for corners in cover.footprints:
        axes.plot(*corners.T, color=SOFT, linewidth=0.4, alpha=0.6)
    centres = np.array([camera.centre for camera in cameras])
    forward = np.array([camera.cam_from_local[2] for camera in cameras])
    down = -forward[:, 2] > _LOOKS_DOWN
    axes.plot(*centres[:, :2].T, color=INK, linewidth=0.6, alpha=0.7)
    axes.plot(*centres[down, :2].T, "o", color=BLUE, markersize=4, label="looks down")
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
