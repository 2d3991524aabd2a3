"""Tile of a survey as a job of its own, whose views are the windows of photographs that show it.

All tiles are in the local frame of the survey: float32 holds a place to half a millimetre 5 km from its origin, where a
bed comes out 0.4 mm too high.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from fields.image_store import GreyImages
from fields.sweep.block import Block
from fields.sweep.view_pass import outline_of
from fields.sweep.views import Footprint, ground_points, pixels_in
from refract import FlatWater, PinholeCamera
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.images import ImageStore
from survey.plan.area import Area, Tiling, flattened, grown, limits, within
from survey.plan.sweep_block import backend
from survey.plan.tiling import places_of
from survey.progress import Progress
from survey.run.job import BedSearch, Job, Window

# Windows begin at whole pixels of images at a quarter of the size. Their rows there are whole vectors of 16 pixels:
# other widths would need other kernels.
_BEGIN_PX, _ROWS_PX, _COLUMNS_PX = 4, 8, 64
# Beyond what shows the ground: windows of the first pass, at a quarter of the size, and their surroundings.
_MARGIN_PX = 32
# Smaller windows would hold few tiles of the sweep; a photograph with less of a tile than this adds nothing to it.
_LEAST_PX, _LEAST_SEEN_PX = 128, 8
# Of rays nearer to the horizon than this sine nothing is certain; margin of a footprint, as a share of its extent, for
# the motion of a camera.
_LEAST_FALL, _MARGIN = 0.05, 0.05
# A survey that reaches further from its origin along x or y is larger than a kilometre [m].
_FAR_M = 500.0
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
    ground: Area

    def __init__(self, survey_job: Job, number: int, search: BedSearch):
        if (tiling := survey_job.plan.tiling) is None:
            raise ValueError("expected a job with tiles")
        plan = replace(survey_job.plan, image_scale=1.0)
        progress: Any = _progress_of_tile(survey_job.progress, number, len(tiling))
        super().__init__(survey_job.survey, survey_job.chosen, plan, progress)
        self.survey_job, self.number, self.bed_search = survey_job, number, search
        self.whole_camera, self.waits_for_kernels = survey_job.cameras[0], survey_job.waits_for_kernels
        # Rectangle of the points of the tile, and that with its rim.
        self.cell, self.ground = tiling.cell(number), tiling.ground(number, tiling.rim)
        self.own_ground, self._own = self.cell, tiling.ground(number, 0.0)
        self._has_own_range, survey = has_own_ranges(tiling), survey_job.survey
        if self._has_own_range:
            survey = survey_over(survey, grown(self._own, max(survey_job.plan.footprint_m)))
        survey, (lowest, highest) = over_own_plane(survey, self.ground)
        # The bound of the survey is over its plane.
        self.limits = survey_job.limits
        self.bound = search.bound[0] - highest, search.bound[1] - lowest
        if self._has_own_range:
            # The height of dry ground may be known from how far views are apart, which one alone does not tell.
            is_alone = survey.water is None and len(survey.views) < 2
            self.limits = limits(flattened(survey_job.survey) if is_alone else survey)
            self.bound = self.limits if search.bounds is None else search.bounds[number]
        # One for each view
        self.windows = self._windows(survey.water) if search.windows is None else search.windows[number]
        cameras = (survey_job.cameras[w.view].cropped(w.row, w.column, w.height, w.width) for w in self.windows)
        views = (survey_job.survey.views[w.view] for w in self.windows)
        cropped = tuple(replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True))
        self.survey = replace(survey, views=cropped)
        # Views of the whole survey that show the tile, by their numbers here.
        number_of = {window.view: place for place, window in enumerate(self.windows)}
        self.views_to_match = [number_of[view] for view in search.views if view in number_of]

    def _windows(self, water: FlatWater | None) -> list[Window]:
        survey_job, own = self.survey_job, self._own
        if survey_job.outlines is None:
            survey_job.outlines = Outlines(survey_job.cameras)
        showing = survey_job.outlines.may_show(water, own, self.bound)
        cameras = {view: survey_job.cameras[view] for view in showing}
        footprints = survey_job.outlines.footprints(showing, water, self.bound)
        return windows_of(cameras, water, own, self.ground, self.bound, footprints)

    @property
    def is_void(self) -> bool:
        """Whether too few views show the tile, or none of them looks down at it."""
        if len(self.windows) < 2 or not self.views_to_match:
            return True
        return bool(np.isnan(ground_points([view.camera for view in self.survey.views], 0.0)).all())

    def stage_name(self, name: str) -> str:
        return f"{name}_tile{self.number + 1}"

    @property
    def hashes(self) -> dict[str, tuple[str, str, str | None]]:
        return self.survey_job.hashes

    @cached_property
    def photographs(self) -> Any:
        views = {
            view.name: (self.survey_job.survey.views[window.view], window)
            for view, window in zip(self.survey.views, self.windows, strict=True)
        }
        return WindowStore(self.survey_job.photographs, views, self.survey_job.plan.image_scale)

    @cached_property
    def block(self) -> Block:
        of_survey = self.survey_job.block
        images = (of_survey.images.window(window.view, *window.part) for window in self.windows)
        cameras = [view.camera for view in self.survey.views]
        white = [of_survey.saturated[window.view] for window in self.windows]
        greys, middle = GreyImages(images, of_one_size=False), 0.5 * sum(self.bound)
        return Block(backend(self.plan), cameras, greys, self.survey.water, middle, white, self.ground)

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
        is_shared = name in _OF_SURVEY or (name == "heights" and not self._has_own_range)
        return self.survey_job.hash_of_part(name) if is_shared else super().hash_of_part(name)


def _progress_of_tile(progress: Progress, number: int, count: int) -> SimpleNamespace:
    """Progress of a run with the tile in the names of its parts; what is noted of a tile is a detail."""

    def said(say):
        return lambda text: say(f"tile {number + 1}: {text}")

    stage = partial(progress.stage, part=(number, count))
    return SimpleNamespace(
        stage=stage, note=said(progress.detail), detail=said(progress.detail), warn=said(progress.warn)
    )


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


def has_own_ranges(tiling: Tiling) -> bool:
    """Whether each tile of a survey has a range of heights of its own: where it is larger than a kilometre."""
    return max(map(abs, (*tiling.x, *tiling.y))) > _FAR_M


def survey_over(survey: Survey, ground: Area) -> Survey:
    """The survey with the views and matched points over some ground alone; with all views where none is over it."""
    views = tuple(view for view in survey.views if within(view.camera.centre[None], ground)[0])
    points = survey.observations.points
    points = None if points is None else points[within(points, ground)]
    return replace(survey, views=views or survey.views, observations=replace(survey.observations, points=points))


class Outlines:
    """Rays of the outlines of photographs, to leave out at once those that show nothing of a tile.

    Straight rays reach further than bent ones, so that no photograph is left out that shows it.
    """

    def __init__(self, cameras: Sequence[PinholeCamera]):
        self._centres = np.array([camera.centre for camera in cameras])
        outlines = [camera.outline() for camera in cameras]
        most = max(map(len, outlines))
        # Of equal length: the last place of a shorter one is repeated.
        rays = [
            camera.directions(np.pad(outline, ((0, most - len(outline)), (0, 0)), mode="edge"))
            for camera, outline in zip(cameras, outlines, strict=True)
        ]
        self._rays = np.array(rays)
        self._cameras, self._footprints = cameras, dict[tuple, dict[int, Footprint]]()

    def footprints(
        self, numbers: Sequence[int], water: FlatWater | None, bound: tuple[float, float]
    ) -> dict[int, Footprint]:
        """Footprints of cameras between two heights [m], worked out once for all tiles over one plane."""
        known = self._footprints.setdefault((water, bound), {})
        new = [number for number in numbers if number not in known]
        if new:
            found = Footprint.of_each([self._cameras[number] for number in new], water, bound)
            known.update(zip(new, found, strict=True))
        return {number: known[number] for number in numbers}

    def may_show(self, water: FlatWater | None, area: Area, bound: tuple[float, float]) -> list[int]:
        """Numbers of the cameras that may show an area between two heights [m] over a plane, or over z = 0."""
        centres, rays = self._centres, self._rays
        up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
        over = centres @ up if water is None else (centres - np.array(water.point)) @ up
        cos_nadir = -rays @ up
        is_certain = (cos_nadir > _LEAST_FALL).all(axis=1) & (over > bound[1])
        levels = np.array([bound[0], min(max(0.0, bound[0]), bound[1]), bound[1]])
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (over[:, None] - levels)[:, :, None] / cos_nadir[:, None]
        plan = (centres[:, None, None] + along[..., None] * rays[:, None])[..., :2].reshape(len(centres), -1, 2)
        low, high = np.minimum(plan.min(axis=1), centres[:, :2]), np.maximum(plan.max(axis=1), centres[:, :2])
        margin = _MARGIN * (high - low).max(axis=1, keepdims=True)
        meets = ((low - margin <= area[2:]) & (high + margin >= area[:2])).all(axis=1)
        return np.flatnonzero(meets | ~is_certain).tolist()


def windows_of(
    cameras: Mapping[int, PinholeCamera],
    water: FlatWater | None,
    own: Area,
    ground: Area,
    bound: tuple[float, float],
    footprints: Mapping[int, Footprint] | None = None,
) -> list[Window]:
    """Windows of the views that show a tile (x0, y0, x1, y1) [m], ``own`` without and ``ground`` with its rim.

    By cameras of one size; ``bound`` (low, high) [m] are the heights over the water plane between which the bed lies,
    ``footprints`` those of the cameras between them, where they are known.
    """
    found = []
    tile = Footprint(np.array(own[:2]), np.array(own[2:]))
    if footprints is None:
        footprints = dict(zip(cameras, Footprint.of_each(list(cameras.values()), water, bound), strict=True))
    # Of ground behind a camera nothing can be projected.
    meeting = [view for view in cameras if footprints[view].meets(tile)]
    outlines = [outline_of(area, water, bound) for area in (own, ground)]
    places = np.concatenate(outlines)
    pixels = pixels_in([cameras[view] for view in meeting], [places] * len(meeting), water)
    for view, of_both in zip(meeting, pixels, strict=True):
        camera, (of_own, of_ground) = cameras[view], np.split(of_both[:, ::-1], [len(outlines[0])])
        seen, box = _box(camera, of_own, 0), _box(camera, of_ground, _MARGIN_PX)
        if min(seen[2] - seen[0], seen[3] - seen[1]) < _LEAST_SEEN_PX:
            continue
        row, height = _side(box[0], box[2], camera.height, _ROWS_PX)
        column, width = _side(box[1], box[3], camera.width, _COLUMNS_PX)
        found.append(Window(view, row, column, height, width))
    return found


def _side(first: int, last: int, size: int, step: int) -> tuple[int, int]:
    """Begin and length of a window along an axis of an image that is so long."""
    begin = first // _BEGIN_PX * _BEGIN_PX
    length = min(max(-(-(last - begin) // step) * step, _LEAST_PX), size)
    return min(begin, size - length) // _BEGIN_PX * _BEGIN_PX, length


def _box(camera: PinholeCamera, seen: np.ndarray, margin: int) -> tuple[int, int, int, int]:
    """Top, left, bottom, right of an image about places (N, 2), (row, column) [px]; all of it if they are uncertain."""
    size = np.array([camera.height, camera.width])
    if not np.isfinite(seen).all():
        return 0, 0, camera.height, camera.width
    low, high = np.floor(seen.min(axis=0)) - margin, np.ceil(seen.max(axis=0)) + margin
    # Equal ones, or in the wrong order, where it is not seen.
    top, left = np.maximum(low, 0.0).clip(max=size).astype(int).tolist()
    bottom, right = np.minimum(high, size).clip(min=0.0).astype(int).tolist()
    return top, left, bottom, right


class WindowStore:
    """Photographs of an `ImageStore` of which only windows, cut at a scale, are seen.

    ``views`` has the whole photograph and its window, by name.
    """

    def __init__(self, store: ImageStore, views: Mapping[str, tuple[View, Window]], scale: float):
        self._store, self._views, self._scale = store, views, scale

    def load(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The window (height, width, 3) uint8, RGB, of a view; black beyond the photograph."""
        full_view, window = self._views[view.name]
        image = self._store.load(full_view, scale=self._scale)[window.part]
        rows, columns = window.height - image.shape[0], window.width - image.shape[1]
        return np.pad(image, ((0, rows), (0, columns), (0, 0))) if rows or columns else image
