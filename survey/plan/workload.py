"""Time, memory and disk space of a run, estimated before anything is computed.

Time is that of `survey.plan.rates`, memory that of the arrays which docs/performance.md names: 0.5 GB (quick) to
3.4 GB (20 megapixels) measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fields.models import IN_LAYER
from fields.sweep.block import Overlap
from fields.sweep.kernels.stack import FEWEST_KEPT, KEPT_BYTES
from survey import machine
from survey.display.quantities import room, size
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.area import AREA_MARGIN_M, flattened, grown, local_area
from survey.plan.choices import Choices
from survey.plan.heights import dry_ground
from survey.plan.plan import Plan
from survey.plan.rates import SFM_PARTS, START_S, Amounts, parts_s, sfm_s
from survey.plan.recipe import RECIPES, image_scale
from survey.plan.sweep_block import camera_of
from survey.progress import rough
from survey.sfm.settings import FEATURES_PX, pairs_about

# Libraries and kernels, with the samples of height hypotheses, whose number at a time is fixed.
_BASE_BYTES = 480e6
# Per pixel of every view, its grey image; of its colours, and these at most; whole photographs while they are decoded.
_BYTES_OF_VIEW, _BYTES_OF_COLOURS, _MOST_COLOURS, _BYTES_OF_DECODING = 1, 3, 100e6, 14
# Cached images in float32, and packed images or height maps that are compared: bytes per pixel, at most in all, least
# number of images.
_READ, _COMPARED, _SURFACES = (4, 30e6, 2), (4, KEPT_BYTES, FEWEST_KEPT), (5, 200e6, 21)
# Per pixel of all height maps during the sweep, and the most pixels in memory.
_BYTES_OF_MAPS, _MOST_MAPS = 18, 75e6
# Arrays of a view that is worked on, per pixel, of the two that take turns where heights are fused; tiles that are
# solved at a time.
_BYTES_OF_WORK, _BYTES_OF_TILES = 2 * 80, 150e6
# Per pixel of all height maps: which become points, and which are taken.
_BYTES_OF_MASKS = 0.25
# Per point of the bed, while all of them are gathered, and while the report is written.
POINT_BYTES = 130
# Per cell of one ground sampling distance: factors, their gradients and moments; rays drawn at once, of so many cells.
_BYTES_OF_FIELD, _BYTES_OF_RAYS, _RAYS_OF_CELLS = 400, 1000, 500_000
# On the disk, per pixel of a height map and per cell of the bed; pictures, report and log; structure from motion.
_DISK_OF_MAP, _DISK_OF_CELL, _DISK_AT_LEAST, _DISK_OF_SFM = 18, 210, 30e6, 4e6
# With more views than this, choosing those that cover the bed takes too long here: all count, as a bound.
_MOST_VIEWS = 2000
# For real photographs with noise, glitter or little texture, which need wider windows than simulated ones.
_HARD_MATCHING_TIME = "three to five times as long"
# Without poses: cells of the bed per pixel, since with the usual overlap a place is seen ten times or more.
_OWN_GROUND = 0.1


@dataclass(frozen=True)
class Workload:
    """Estimated time, memory and disk space of a run."""

    num_views: int  # Photographs
    num_maps: int  # How many of them get a height map
    seconds: float | None  # On `num_cores` idle cores; None on a device whose rate was not measured
    num_cores: int
    memory_bytes: int  # At the peak, in main memory
    disk_bytes: int  # Of the run folder
    # Whether this is an upper bound: poses are not known yet, or there are too many views to choose from here, and all
    # of them count
    is_bound: bool = False
    # Of the seconds those of each part, by the name of its stage, in order; empty where they are not known
    parts_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def bound_words(self) -> str:
        """ "At most" for a bound, "about" for an estimate."""
        return "at most " if self.is_bound else "about "

    def __str__(self) -> str:
        """The workload in words, as `check` and `process` say it."""
        rooms = f"{self.bound_words}{size(self.memory_bytes)} of memory and {size(self.disk_bytes)} on the disk"
        maps = f"{self.num_maps} of {self.num_views} views get a height map"
        if self.seconds is None:
            return f"{rooms}; {maps}; no time was measured on such a device"
        cores = f"{self.num_cores} idle core{'s' * (self.num_cores > 1)}"
        if SFM_PARTS[0] in self.parts_s:
            of_sfm = f"{rough(sum(self.parts_s[name] for name in SFM_PARTS))} of them for structure from motion"
            hard = f"{_HARD_MATCHING_TIME} where photographs match badly"
            return f"about {rough(self.seconds)} on {cores}, {of_sfm}, and {hard}; {rooms}"
        return f"{self.bound_words}{rough(self.seconds)} on {cores}, {rooms}; {maps}"


def workload_of(survey: Survey, plan: Plan, amounts: Amounts | None = None) -> Workload:
    """The estimate for a survey whose poses are known, by its `amounts_of_run` where these are known."""
    amounts = amounts_of_run(survey, plan) if amounts is None else amounts
    return _workload(amounts, parts_s(amounts, machine.num_cores()) if plan.device == "llvm" else {})


def workload_of_images(sizes_px: Sequence[tuple[int, int]], chosen: Choices) -> Workload:
    """Estimate for photographs of some sizes without poses: a bound of memory and disk, time with their poses."""
    recipe, scale = RECIPES[chosen.quality], chosen.image_scale
    if scale is None:
        scale = min(image_scale(width, height, recipe.megapixels) for width, height in sizes_px)
    areas = np.array([width * height for width, height in sizes_px])
    pixels, field = areas * scale**2, recipe.field
    points = _OWN_GROUND * float(pixels.sum())
    amounts = Amounts(areas, pixels, pixels, points, "refine", field, has_boxes=field == "solver", is_bound=True)
    features_mpx = sum(w * h * min(1.0, FEATURES_PX / max(w, h)) ** 2 for w, h in sizes_px) / 1e6
    cores = machine.num_cores()
    parts = sfm_s(features_mpx, len(sizes_px), pairs_about(len(sizes_px)), cores) | parts_s(amounts, cores)
    found = _workload(amounts, parts)
    return replace(found, disk_bytes=found.disk_bytes + int(_DISK_OF_SFM * len(sizes_px)))


def _workload(amounts: Amounts, parts: Mapping[str, float]) -> Workload:
    return Workload(
        num_views=len(amounts.view_px),
        num_maps=len(amounts.map_px),
        seconds=START_S + sum(parts.values()) if parts else None,
        num_cores=machine.num_cores(),
        memory_bytes=int(memory_of(amounts)),
        disk_bytes=int(_DISK_AT_LEAST + _DISK_OF_MAP * amounts.map_px.sum() + _DISK_OF_CELL * amounts.points),
        is_bound=amounts.is_bound,
        parts_s=parts,
    )


def amounts_of_run(survey: Survey, plan: Plan) -> Amounts:
    """Amounts of work of a run on a survey whose poses are known."""
    photographs = np.array([view.lens.width * view.lens.height for view in survey.views])
    survey = flattened(survey)
    cameras = [camera_of(view, plan) for view in survey.views]
    pixels = np.array([camera.width * camera.height for camera in cameras])
    chosen = list(range(len(cameras)))
    area, points = local_area(survey), _OWN_GROUND * float(pixels.sum())
    if len(cameras) <= _MOST_VIEWS:
        bed = 0.0 if survey.water is not None else dry_ground(survey).height
        try:
            overlap = Overlap(cameras, survey.water, bed)
        except ValueError as error:
            raise SurveyError(str(error)) from error
        chosen = overlap.cover(*plan.recipe.times_seen, area)
        num_covered = int((overlap.seen.sum(axis=0) >= 2).sum())
        sides = [np.diff(np.unique(overlap.cells[:, axis])).min() for axis in (0, 1)]
        points = num_covered * float(sides[0] * sides[1]) / plan.gsd_m**2
    if area is not None:
        x0, y0, x1, y1 = grown(area, AREA_MARGIN_M)
        points = min(points, (x1 - x0) * (y1 - y0) / plan.gsd_m**2)
    is_bound = len(cameras) > _MOST_VIEWS
    return Amounts(
        photographs, pixels, pixels[chosen], points, plan.pose_choice, plan.field, plan.boxes, is_bound=is_bound
    )


def require_room(workload: Workload, run_folder: Path) -> list[str]:
    """Warnings where the free memory will not suffice, or the disk may not."""
    words = _disk_warning(workload, run_folder) or _limit_warning(workload)
    if words is not None and not workload.is_bound:
        raise SurveyError(words)
    return room_warnings(workload, run_folder)


def room_warnings(workload: Workload, run_folder: Path) -> list[str]:
    """Warnings where the disk of the run folder or the free memory will not suffice."""
    disk = _disk_warning(workload, run_folder)
    warnings = [text for text in (disk, _limit_warning(workload)) if text is not None]
    free = machine.free_memory_bytes()
    if workload.memory_bytes > free:
        warnings.append(
            f"the run needs {workload.bound_words}{size(workload.memory_bytes)} of memory, and {room(free)} are free: "
            "the system may stop it; close other programs, use a lower --quality, or give [area] bounds"
        )
    return warnings


def _disk_warning(workload: Workload, run_folder: Path) -> str | None:
    stored_bytes = (
        sum(p.stat().st_size for p in run_folder.glob("stages/**/*") if p.is_file()) if run_folder.is_dir() else 0
    )
    free = machine.free_disk_bytes(run_folder) + stored_bytes
    if workload.disk_bytes <= free:
        return None
    return (
        f"the run needs {workload.bound_words}{size(workload.disk_bytes)} in {run_folder}, and {room(free)} are free "
        "there; free some, name a run folder elsewhere with -o, or use a lower --quality"
    )


def _limit_warning(workload: Workload) -> str | None:
    allowed = machine.allowed_memory_bytes()
    if workload.memory_bytes <= allowed:
        return None
    return (
        f"the run needs {workload.bound_words}{size(workload.memory_bytes)} of memory, and limits of this process "
        f"leave {room(max(allowed, 0.0))} (ulimit -d, ulimit -v); raise them, use a lower --quality, or give [area] "
        "bounds"
    )


def memory_of(amounts: Amounts) -> float:
    """Peak memory [bytes]: that of the largest stage with the data that all stages hold."""
    pixels, of_maps = amounts.view_px, amounts.map_px
    everything, masks = float(pixels.sum()), _BYTES_OF_MASKS * float(of_maps.sum())
    held = _BYTES_OF_VIEW * everything + min(_BYTES_OF_COLOURS * everything, _MOST_COLOURS)
    # As they are, and smaller or with small holes closed.
    read = 2.0 * _kept(pixels, _READ)
    maps = min(_BYTES_OF_MAPS * float(of_maps.sum()), _MOST_MAPS)
    sweep = read + maps + _kept(pixels, _COMPARED) + _BYTES_OF_WORK * float(pixels.max())
    of_field = amounts.points if amounts.field in IN_LAYER else 0.0
    trained = _BYTES_OF_FIELD * of_field + _BYTES_OF_RAYS * min(of_field, _RAYS_OF_CELLS)
    solver = _kept(of_maps, _SURFACES) + _BYTES_OF_TILES + masks if amounts.field != "off" else 0.0
    bed = read + masks + POINT_BYTES * amounts.points
    decoding = _BYTES_OF_DECODING * float(amounts.photographs_px.max())
    return _BASE_BYTES + held + max(decoding, sweep + trained, solver, bed)


def _kept(pixels: np.ndarray, of_what: tuple[float, float, int]) -> float:
    """Bytes of images of so many pixels each of which the last few are kept; see `fields.image_store`."""
    each, budget, fewest = of_what
    return each * min(float(np.sum(pixels)), max(budget / each, fewest * float(np.max(pixels))))
