"""Tile of a survey as a job of its own, whose views are windows of photographs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fields.image_store import GreyImages
from fields.sweep.block import Block
from fields.sweep.views import ground_points
from survey.plan.area import Area, flattened, grown, limits
from survey.plan.sweep_block import backend
from survey.plan.tiling import places_of
from survey.run.job import Job
from survey.run.windows import (
    BedSearch,
    Window,
    WindowStore,
    has_own_ranges,
    survey_over,
    windows_of,
)

if TYPE_CHECKING:
    from refract import FlatWater, PinholeCamera
    from survey.folder.survey import Survey
    from survey.progress import Progress, Step

# Parts of a job that a tile takes from the survey as they are.
_OF_SURVEY = (
    *("name", "frame", "water_settings", "ties", "priors", "control", "freed", "water_colour", "true_colour", "code"),
)


class TileJob(Job):
    """The part of a job that a tile is.

    Its survey has the views that show the tile, cut to their windows at the size that is worked on, and where the water
    is no plane the one that fits it there; settings and what else belongs to the survey are those of the whole. In a
    survey larger than a kilometre each tile has a range of heights of its own.
    """

    bed_search: BedSearch

    def __init__(self, survey_job: Job, number: int, found: BedSearch):
        if (tiling := survey_job.plan.tiling) is None:
            raise ValueError("expected a job with tiles")
        self.survey_job, self.number, self.bed_search, self._tiling = survey_job, number, found, tiling
        survey, self.cell = survey_job.survey, tiling.cell(number)
        self.whole_camera: PinholeCamera | None = survey_job.cameras[0]
        own_range = has_own_ranges(tiling)
        if own_range:
            survey = survey_over(survey, grown(tiling.ground(number, 0.0), max(survey_job.plan.footprint_m)))
        survey, (lowest, highest) = over_own_plane(survey, self.ground)
        self.plan, self._limits = replace(survey_job.plan, image_scale=1.0), survey_job.limits
        # The bound of the survey is over its plane.
        self._bound = found.bound[0] - highest, found.bound[1] - lowest
        if own_range:
            # The height of dry ground may be known from how far views are apart, which one alone does not tell.
            is_alone = survey.water is None and len(survey.views) < 2
            self._limits = limits(flattened(survey_job.survey) if is_alone else survey)
            self._bound = self._limits if found.bounds is None else found.bounds[number]
        # One for each view
        self.windows = self._windows(survey.water) if found.windows is None else found.windows[number]
        views = tuple(
            replace(
                survey_job.survey.views[w.view],
                camera=survey_job.cameras[w.view].cropped(w.row, w.column, w.height, w.width),
            )
            for w in self.windows
        )
        self.survey, self.chosen = replace(survey, views=views), survey_job.chosen
        self.progress: Any = _ProgressOfTile(survey_job.progress, number, len(tiling))
        self.workspace, self.scratch = None, None
        self.waits_for_kernels = survey_job.waits_for_kernels
        self._hashed, self._hashed_of = {}, (None, None)

    def _windows(self, water: FlatWater | None) -> list[Window]:
        """Windows of the photographs that show the tile."""
        survey_job, own = self.survey_job, self._tiling.ground(self.number, 0.0)
        showing = survey_job.outlines.may_show(water, own, self._bound)
        cameras = {view: survey_job.cameras[view] for view in showing}
        footprints = survey_job.outlines.footprints(showing, water, self._bound)
        return windows_of(cameras, water, own, self.ground, self._bound, footprints)

    @property
    def is_void(self) -> bool:
        """Whether too few views show the tile, or none of them looks down at it."""
        if len(self.windows) < 2 or not self.views_to_match:
            return True
        return bool(np.isnan(ground_points([view.camera for view in self.survey.views], 0.0)).all())

    def stage_name(self, name: str) -> str:
        """The name of a stage of the tile."""
        return f"{name}_tile{self.number + 1}"

    @property
    def views_to_match(self) -> list[int]:
        """Views of the whole survey that show the tile, by their numbers here."""
        number_of = {window.view: number for number, window in enumerate(self.windows)}
        return [number_of[view] for view in self.bed_search.views if view in number_of]

    @property
    def ground(self) -> Area:
        """Rectangle of the tile with its rim."""
        return self._tiling.ground(self.number, self._tiling.rim)

    @property
    def own_ground(self) -> Area:
        """Rectangle that holds the points of the tile."""
        return self._tiling.cell(self.number)

    @property
    def limits(self) -> tuple[float, float]:
        """Search limits of the whole survey; of the tile itself where it has a range of its own."""
        return self._limits

    @property
    def bound(self) -> tuple[float, float]:
        """Bound of the bed, over the plane of the tile."""
        return self._bound

    @property
    def hashes(self) -> dict[str, tuple[str, str, str | None]]:
        """Hashes of the photographs of the whole survey."""
        return self.survey_job.hashes

    @cached_property
    def photographs(self) -> Any:
        """Windows in colour."""
        views = {
            view.name: (self.survey_job.survey.views[window.view], window)
            for view, window in zip(self.survey.views, self.windows, strict=True)
        }
        return WindowStore(self.survey_job.photographs, views, self.survey_job.plan.image_scale)

    @cached_property
    def block(self) -> Block:
        """The windows in grey, in memory."""
        survey_block = self.survey_job.block
        images = (survey_block.images.window(window.view, *window.part) for window in self.windows)
        cameras = [view.camera for view in self.survey.views]
        white = [survey_block.saturated[window.view] for window in self.windows]
        middle = 0.5 * sum(self.bound)
        return Block(
            backend(self.plan),
            cameras,
            GreyImages(images, of_one_size=False),
            self.survey.water,
            middle,
            white,
            self.ground,
        )

    def over_whole(self, view: int, row: np.ndarray, column: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Heights (N,) [m] of pixels of a window over the water of the whole survey, from those over its own."""
        own, water = self.survey.water, self.survey_job.survey.water
        if own == water:
            return heights
        paths = self.survey.views[view].camera.paths(np.column_stack([column + 0.5, row + 0.5]), own)
        xyz = paths.at_height(heights.astype(np.float64), own)
        over = xyz[:, 2] if water is None else (xyz - np.array(water.point)) @ np.array(water.up)
        return over.astype(heights.dtype)

    def release(self) -> None:
        """As `Job.release`; forget the windows, and photographs that the next tile may not see."""
        super().release()
        self.__dict__.pop("block", None)
        self.survey_job.photographs.clear()

    def hash_of_part(self, name: str) -> str:
        """`Job.hash_of_part`; what belongs to the survey is hashed for all tiles together."""
        is_shared = name in _OF_SURVEY or (name == "heights" and not has_own_ranges(self._tiling))
        return self.survey_job.hash_of_part(name) if is_shared else super().hash_of_part(name)


class _ProgressOfTile:
    """Progress of a run with the tile in the names of its parts; what is noted of a tile is a detail."""

    def __init__(self, progress: Progress, number: int, count: int):
        self._progress, self._number, self._count = progress, number, count

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Step]:
        """`Progress.stage` with the tile in the name."""
        with self._progress.stage(name, total, part=(self._number, self._count)) as step:
            yield step

    def note(self, text: str) -> None:
        """Report a note as `Progress.detail`, with the tile."""
        self._progress.detail(f"tile {self._number + 1}: {text}")

    detail = note

    def warn(self, text: str) -> None:
        """`Progress.warn` with the tile."""
        self._progress.warn(f"tile {self._number + 1}: {text}")


def over_own_plane(survey: Survey, ground: Area) -> tuple[Survey, tuple[float, float]]:
    """A survey over the plane that fits its water best on some ground, and how much higher [m] this is, (low, high).

    As it is where the water of the survey is a plane.
    """
    water, departure = survey.water, survey.observations.departure
    if water is None or departure is None:
        return survey, (0.0, 0.0)
    places = places_of(ground)
    plane = departure.tangent(places, water)
    higher = plane.height(*places.T) - water.height(*places.T)
    observations = replace(survey.observations, departure=departure.over(water, plane))
    return replace(survey, water=plane, observations=observations), (float(higher.min()), float(higher.max()))
