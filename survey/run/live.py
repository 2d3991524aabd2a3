"""Intermediate height maps of the sweep for `bathynerf view`, written only while a viewer is open."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.errors import GeoError
from survey.run.flight import FLIGHT, save_flight
from survey.run.stored import save_arrays

if TYPE_CHECKING:
    from fields.sweep.maps import HeightMap
    from survey.run.job import Job

# Folder in a run that the viewer makes: it holds the current points of each map, and the cameras.
LIVE = ".live"
# Pixels of a map that are shown, and the score that they have at least.
_MOST_PIXELS, _LEAST_SCORE = 10_000, 0.7


class LiveMaps:
    """Points of height maps for the viewers of a run.

    Parameters
    ----------
    run : Path
        The folder of the run.
    job : Job
        Of the survey, or of a tile of it.
    stage : str
        Its name begins the names of the files: of a survey in tiles there is a sweep for each.
    """

    def __init__(self, run: Path, job: Job, stage: str):
        self._folder, self._job, self._stage = run / LIVE, job, stage

    def show(self, m: HeightMap) -> None:
        """Write the points of a map while a viewer is open; a full disk does not end the run."""
        if not self._folder.is_dir():
            return
        with suppress(GeoError, OSError):
            if not (self._folder / FLIGHT).is_file():
                save_flight(self._folder, self._job.whole.survey)
            xyz, rgb = self._points(m)
            save_arrays(self._folder / f"{self._stage}-{m.view}.npz", xyz=xyz, rgb=rgb)

    def _points(self, m: HeightMap) -> tuple[np.ndarray, np.ndarray]:
        """Points (K, 3) [m], local, and their colours (K, 3) uint8."""
        survey, rows, columns = self._job.survey, *m.height.shape
        step = int(np.ceil(np.sqrt(m.height.size / _MOST_PIXELS)))
        v, u = (each.ravel() for each in np.mgrid[step // 2 : rows : step, step // 2 : columns : step])
        # Maps of coarse passes are halved once or twice, and rounded to whole pixels.
        camera = self._job.block.cameras[m.view]
        ratio = 2.0 ** round(np.log2(columns / camera.width))
        camera = camera.scaled(ratio)
        rgb = self._job.photographs.load(survey.views[m.view], scale=self._job.plan.image_scale)
        known = (m.score[v, u] > _LEAST_SCORE) & np.isfinite(m.height[v, u])
        v, u = v[known], u[known]
        pixels = np.column_stack([u, v]) + 0.5
        xyz = camera.paths(pixels, survey.water).at_height(m.height[v, u].astype(np.float64), survey.water)
        # A smaller photograph is padded: there is nothing beyond it.
        at = (pixels / ratio).astype(np.int64)
        inside = (at < rgb.shape[1::-1]).all(axis=1) & np.isfinite(xyz).all(axis=1)
        return self._job.in_survey(xyz[inside]), rgb[at[inside, 1], at[inside, 0]]
