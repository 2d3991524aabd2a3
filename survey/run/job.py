"""Data shared by the stages of a run: survey, plan, photographs, and the hashes of their parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from threading import Event
from typing import Any

from fields.sweep.block import Block
from fields.sweep.kernels.arrays import release
from fields.sweep.maps import HeightMap, Sources
from refract import PinholeCamera
from survey.adjust.starts import PoseRecovery, recover_poses
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.images import ImageStore
from survey.plan.area import AREA_MARGIN_M, Area, grown, limits, local_area
from survey.plan.choices import Choices
from survey.plan.plan import Plan
from survey.plan.sweep_block import camera_of, cameras_of_block, load_block
from survey.progress import Progress
from survey.run.stored import ArrayFiles
from survey.stage_key import code_hash, stage_key


@dataclass(frozen=True)
class Window:
    """Part of a photograph at the size that is worked on, by its first row and column."""

    view: int
    row: int
    column: int
    height: int
    width: int

    @property
    def part(self) -> tuple[slice, slice]:
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


@dataclass(frozen=True)
class BedSearch:
    """Heights and photographs of the search for the bed."""

    bound: tuple[float, float]  # (low, high) [m]: heights over the water plane between which the bed lies
    views: list[int]  # Those that get height maps
    # Bound of each tile over a plane of its own [m], where tiles have ranges of their own
    bounds: tuple[tuple[float, float], ...] | None = None
    windows: tuple[list[Window], ...] | None = None  # Those of each tile, where they are known


def colour_of(survey: Survey) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Absorption [1/m] and veiling light (linear, 1 for white) of red, green and blue; None where not known."""
    water = survey.config.water
    return (None, None) if water is None else (water.absorption_per_m, water.veiling_light)


def _water(job: Job) -> Any:
    departure = job.survey.observations.departure
    return job.survey.water if departure is None else (job.survey.water, departure.points, departure.stds)


def _water_settings(job: Job) -> Any:
    water = job.survey.config.water
    return None if water is None else replace(
        water, absorption_per_m=None, veiling_light=None
    ), job.survey.observations.tide


def _priors(job: Job) -> Any:
    return dict(job.survey.observations.priors), job.survey.config.cameras, job.survey.provenance.contradiction


# Parts of a `Job` that stages depend on: in words, and what is hashed.
PARTS: dict[str, tuple[str, Callable[[Job], Any]]] = {
    "photographs": ("the photographs or masks", lambda job: [job.hashes[view.name] for view in job.survey.views]),
    "cameras": ("poses or lenses", lambda job: [(view.name, view.camera, view.lens) for view in job.survey.views]),
    "water": ("the water", _water),
    "water_settings": ("level, slopes or index in survey.toml", _water_settings),
    "ties": ("the matches of structure from motion", lambda job: job.survey.observations.ties),
    "priors": ("positions, or the standard deviations of poses", _priors),
    "control": ("the control points", lambda job: (job.survey.observations.control, job.survey.observations.ground)),
    "freed": ("--calibrate-water", lambda job: job.chosen.calibrate_water),
    "heights": ("the range of heights", lambda job: job.limits),
    "area": ("the area", lambda job: job.area if job.cell is None else (job.cell, job.ground)),
    "tiles": ("the tiles (--tiles, --memory)", lambda job: job.plan.tiling),
    "frame": ("the local frame", lambda job: job.survey.frame),
    "name": ("the name of the survey", lambda job: job.survey.name),
    "size": ("the size that images are worked on", lambda job: job.plan.image_scale),
    "gsd": ("the ground sampling distance", lambda job: job.plan.gsd_m),
    "refined": ("which pixels the sweep refines (--field, or --quality)", lambda job: job.plan.solves),
    "coverage": ("the number of views per place (--quality, or the program)", lambda job: job.plan.recipe.times_seen),
    "rays": (
        "the rays that the field learns from (--quality, or the program)",
        lambda job: (job.plan.field, job.plan.recipe.rays_per_cell),
    ),
    "boxes": ("whether the bed is looked for in boxes beside edges (--field)", lambda job: job.plan.boxes),
    "device": ("the device", lambda job: job.plan.device),
    "water_colour": ("the colour of the water", lambda job: colour_of(job.survey)),
    "true_colour": ("--true-colour", lambda job: colour_of(job.survey) if job.chosen.true_colour else None),
    "code": ("the program", lambda _job: code_hash()),
}


class Job:
    """State of a survey between the stages: survey, plan, photographs and tiles.

    Its survey has the water, and the colour of this, that earlier stages found. Structure from motion keeps its files
    in ``workspace``; photographs that do not stay in memory lie in ``scratch``, which tiles need.
    """

    survey: Survey
    chosen: Choices
    plan: Plan

    def __init__(
        self,
        survey: Survey,
        chosen: Choices,
        plan: Plan,
        progress: Progress,
        *,
        workspace: Path | None = None,
        scratch: Path | None = None,
    ):
        self.survey, self.chosen, self.plan, self.progress = survey, chosen, plan, progress
        self.workspace, self.scratch = workspace, scratch
        # Of a tile the job of the whole survey, the camera of a whole photograph, and the rectangle of its points.
        self.survey_job: Job = self
        self.whole_camera: PinholeCamera | None = None
        self.cell: Area | None = None
        # Set when a wait for kernels begins that is long enough for another thread to hold the GIL.
        self.waits_for_kernels = Event()
        self.bed_search: BedSearch | None = None  # Once heights and photographs of the search are known
        self.parts: Sequence[Job] = (self,)  # The tiles, once the search is known
        self.outlines: Any = None  # Those of the photographs, for tiles: `survey.run.tile_job.Outlines`
        # The survey with the level that is asked for, while the bed is that of an earlier one.
        self.asked: Survey | None = None
        # Adjustments that differ by what is given of the level alone; windows of the first are used again
        self.adjusted_before: list[Path] = []
        self._hashed: dict[str, str] = {}
        # Of which survey and plan these are.
        self._hashed_of: tuple[object, object] = (None, None)

    def use_survey(self, survey: Survey) -> None:
        """Replace the survey by one of the same photographs, e.g. with adjusted water."""
        # What determines the rays of the photographs and the search volume.
        names = ("cameras", "water", "size", "device", "heights")
        before = [self.hash_of_part(name) for name in names]
        self.survey = survey
        self.plan = self.plan.again(survey, self.chosen)
        for name in ("limits", "area", "ground", "own_ground"):
            self.__dict__.pop(name, None)
        if [self.hash_of_part(name) for name in names] != before:
            self.outlines = None
            for name in ("block", "bound", "cameras"):
                self.__dict__.pop(name, None)

    def search_bed(self, search: BedSearch, tiles: Sequence[Job] = ()) -> None:
        """Let the job, or its tiles, search the bed at these heights by these photographs."""
        self.bed_search, self.parts = search, tiles or (self,)
        if "block" in self.__dict__ and not tiles:
            self.block.set_overlap_height(0.5 * sum(search.bound))

    def stage_name(self, name: str) -> str:
        return name

    @cached_property
    def photographs(self) -> ImageStore:
        """The photographs in colour, decoded once."""
        return ImageStore()

    @cached_property
    def block(self) -> Block:
        """The grey images with their cameras, loaded when the first stage needs them."""
        with self.progress.stage("Images", len(self.survey.views)) as stage:
            store_array = None if self.plan.tiling is None or self.scratch is None else ArrayFiles(self.scratch)
            block = load_block(self.survey, self.plan, stage.advance, self.photographs, store_array)
        if self.bed_search is not None and self.plan.tiling is None:
            block.set_overlap_height(0.5 * sum(self.bed_search.bound))
        return block

    @cached_property
    def cameras(self) -> list[PinholeCamera]:
        """Cameras of the block, at the scale of the plan."""
        return cameras_of_block(self.survey, self.plan)

    def release(self) -> None:
        """Return memory that the last stage no longer uses to the system, so that the next one's comes not on top."""
        if "block" in self.__dict__:
            release(self.block.device)

    @property
    def search(self) -> PoseRecovery | None:
        """Structure from motion for poses of a file that are too inaccurate; None without a workspace."""
        if self.workspace is None:
            return None
        return partial(recover_poses, workspace=self.workspace, report=self.progress.note)

    @cached_property
    def bound(self) -> tuple[float, float]:
        """Heights [m] over the water plane of the bed, by thumbnails; `fields.sweep.sweep.find_range`."""
        return self.range_within(self.limits) if self.bed_search is None else self.bed_search.bound

    def range_within(self, limits: tuple[float, float]) -> tuple[float, float]:
        """Heights [m] over the water plane of the bed within limits, by thumbnails."""
        from fields.sweep.sweep import find_range

        try:
            return find_range(self.block, limits)
        except ValueError as error:
            raise SurveyError(str(error)) from error

    @property
    def is_void(self) -> bool:
        """Whether too few views show a tile."""
        return False

    @cached_property
    def area(self) -> Area | None:
        """Rectangle (x0, y0, x1, y1) [m], local, that is wanted; None for all."""
        return local_area(self.survey)

    @cached_property
    def ground(self) -> Area | None:
        """The same with a margin, for the points; of a tile with its rim."""
        return None if self.area is None else grown(self.area, AREA_MARGIN_M)

    @cached_property
    def own_ground(self) -> Area | None:
        """The same, without what a tile shares with others."""
        return self.ground

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Heights [m] over the water plane between which the bed is searched; `survey.plan.area.limits`."""
        return limits(self.survey)

    @cached_property
    def views_to_match(self) -> list[int]:
        """Views that get a height map."""
        if self.bed_search is None:
            raise ValueError("expected a job whose bed search is known")
        return self.bed_search.views

    def sources(self, maps: Sequence[HeightMap]) -> Sources:
        """Photographs with their height maps and the water, at the plan's scale: training data of field and colour."""
        survey, plan = self.survey, self.plan
        return Sources(
            [camera_of(survey.views[m.view], plan) for m in maps],
            maps,
            [self.photographs.load(survey.views[m.view], scale=plan.image_scale) for m in maps],
            survey.water,
            *colour_of(survey),
        )

    def hash_of_part(self, name: str) -> str:
        """The hash of one of `PARTS`, made once for a survey and a plan: 1000 cameras take a tenth of a second."""
        if self._hashed_of[0] is not self.survey or self._hashed_of[1] is not self.plan:
            self._hashed, self._hashed_of = {}, (self.survey, self.plan)
        if name not in self._hashed:
            self._hashed[name] = stage_key(PARTS[name][1](self))
        return self._hashed[name]

    @cached_property
    def hashes(self) -> dict[str, tuple[str, str, str | None]]:
        """Name and hashes of each photograph and its mask, read whole, several at a time."""
        views = self.survey.views
        paths = [path for view in views for path in (view.path, view.mask_path) if path is not None]
        with ThreadPoolExecutor() as pool:
            content = dict(zip(paths, pool.map(stage_key, paths), strict=True))
        return {
            view.name: (view.name, content[view.path], None if view.mask_path is None else content[view.mask_path])
            for view in views
        }
