"""What structure from motion would make of the small survey, without running it."""

import sys
from types import SimpleNamespace

import numpy as np
from small_survey import E0, LEVEL, N0

from geo.frames import LocalFrame
from refract.lens import Lens
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.sfm.poses import SfmResult


def solved(monkeypatch, names):
    """Put a solver in the place of structure from motion, which has tests of its own; returns its calls."""
    calls = []

    def solve_poses(images, headers, cameras, crs, workspace, *, level_m, control, spare_control, report):
        focal_px = cameras.focal_px
        calls.append((list(images.values()), workspace, cameras.gps_height, cameras.size_px, focal_px))
        frame = LocalFrame(crs, (E0, N0, LEVEL))
        lens = Lens("SIMPLE_RADIAL", (focal_px or 90.0, 32.0, 24.0, -0.01), 64, 48)
        down = np.diag([1.0, -1.0, -1.0])
        views = tuple(
            View(name, images[name], lens.camera(np.array([3.0 * i, 0.0, 20.0]), down), lens)
            for i, name in enumerate(names)
        )
        ties = TiePoints(np.array([[1.0, 0.0, -2.0]]), np.zeros(3, int), np.arange(3), np.full((3, 2), 9.5))
        residuals = np.zeros((len(views), 3))
        return SfmResult(frame, views, ("placed by GPS",), residuals, ties)

    monkeypatch.setitem(sys.modules, "survey.sfm.poses", SimpleNamespace(solve_poses=solve_poses))
    return calls
