"""The photographs and height maps of a run as an image-based field, for novel views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fields.image_based import ImageBasedField, Source, heights_over
from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap, trusted
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, flight_of
from survey.export.occlusion import exposure_gains
from survey.files.json_values import read_json_object
from survey.photos.images import load_image, load_mask
from survey.run.flight import Flight
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored

# Heights that differ by fewer ground sampling distances are of the same surface.
_TOLERANCE_GSD = 3.0
# Bytes of photographs and maps that are kept at once; those that a place is blended of, always.
_MOST_BYTES, _FEWEST = 1_000_000_000, 8
# Points of the bed by which exposures are compared.
_COMPARED = 20_000


def image_based_field(
    run: LoadedRun, survey: str | None, cameras: Sequence[PinholeCamera], *, dry: bool, advance: Callable[[], object]
) -> ImageBasedField:
    """The photographs of a run as other cameras see them, those that some cameras need at a common exposure.

    Parameters
    ----------
    survey : str or None
        Folder of the survey, if it was moved since the run.
    cameras : sequence of PinholeCamera
        That are to be rendered, local.
    dry : bool
        They look through air alone.
    advance : callable
        Called after each of the photographs that are compared.

    Raises
    ------
    SurveyError
        If the run has no height maps, or a photograph is not there any more.
    """
    flight = flight_of(run, survey)
    maps = _HeightMaps(run, flight)
    points = flight.frame.local_from_crs(_some(run.columns("points_crs")["points_crs"]))
    views = [flight.views[view] for view in maps.views]
    load = lru_cache(max(_MOST_BYTES // maps.source(0).num_bytes, _FEWEST))(maps.source)
    field = ImageBasedField(
        cameras=[view.camera for view in views],
        water=flight.water,
        load=load,
        height=float(np.median(heights_over(points, flight.water))),
        tolerance=_TOLERANCE_GSD * run.place.gsd_m,
        gains=np.ones((len(views), 3)),
    )
    needed = sorted({number for camera in cameras for number in field.sources_of(camera, dry=dry)})
    gains = field.gains.copy()
    gains[needed] = _gains(field, needed, points, advance)
    return replace(field, gains=gains)


class _HeightMaps:
    """The height maps of a run, with the solver's heights where it has them, and their photographs.

    Attributes
    ----------
    views : list of int
        Of the flight: those that have a map.
    """

    def __init__(self, run: LoadedRun, flight: Flight):
        self._flight = flight
        self._swept = Stored(run.folder.load_stage("sweep") / MAPS, HeightMap)
        solved = run.folder.load_stage("solver") / SOLVED if "solver" in run.stages else None
        self._solved = None if solved is None else Stored(solved, SolvedMap)
        self._scale = float(read_json_object(run.folder.plan_path)["image_scale"])
        self.views = self._swept.views
        if not self.views:
            raise SurveyError(f"the run {run.folder.path} has no height maps; give the same `bathynerf process` again")

    def source(self, number: int) -> Source:
        """The photograph of the map of a number."""
        view = self._flight.views[self.views[number]]
        height_map = self._swept[number]
        confirmed = trusted(height_map)
        if self._solved is not None:
            height_map, _ = self._solved[number].over(height_map)
        # Maps of smaller photographs are padded.
        camera = view.camera.scaled(self._scale)
        heights = np.where(confirmed, height_map.height, np.float32(np.nan))[: camera.height, : camera.width]
        return Source(view.camera, load_image(view), load_mask(view), self._scale, heights)


def _some(points: np.ndarray) -> np.ndarray:
    return points[:: max(len(points) // _COMPARED, 1)]


def _gains(
    field: ImageBasedField, numbers: Sequence[int], points: np.ndarray, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) that bring the colours of some photographs to their common exposure, by what they show at points
    (N, 3), local."""
    heights = heights_over(points, field.water)
    shown = np.full((len(numbers), len(points), 3), np.nan, dtype=np.float32)
    for row, number in enumerate(numbers):
        source = field.load(number)
        seen = source.observe(points, field.water)
        use = seen.inside & seen.agrees(heights, field.tolerance)
        shown[row, use] = np.log(np.maximum(source.colours(seen.uv[use]), 1.0))
        advance()
    return np.exp(-exposure_gains(shown))
