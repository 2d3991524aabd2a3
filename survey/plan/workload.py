"""Time, memory and disk space of a run, estimated before anything is computed.

Times are by rates on one core with AVX-512 and the speed-up on several, from runs of data/quick, river and wreck_water
in draft and standard quality and of a drawn survey of 8 small photographs: 5.7 to 107 s on two idle cores, which the
sum meets within a tenth. Memory is that of the arrays which docs/performance.md names: 0.5 GB (quick) to 3.4 GB (20
megapixels) measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fields.models import IN_LAYER
from fields.occluded.holes import SIDE_GSD
from fields.sweep.block import Overlap
from fields.sweep.kernels.stack import FEWEST_KEPT, KEPT_BYTES
from fields.sweep.matching import PASSES, POINTS_SHARE, before_solver
from survey import machine
from survey.display.quantities import room, size
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.area import AREA_MARGIN_M, flattened, grown, local_area
from survey.plan.choices import RECIPES, Choices, image_scale
from survey.plan.heights import dry_ground
from survey.plan.plan import Plan
from survey.plan.sweep_block import camera_of
from survey.progress import rough
from survey.sfm.features import FEATURES_PX
from survey.sfm.pairs import pairs_about

# Imports and hashes of any run.
_START_S = 2.5
# Samples of the sweep (pixels x hypotheses x neighbours) per core and second, by Dr.Jit on LLVM, including the search
# beside steps; usual number of hypotheses of its first pass.
_SAMPLES_PER_CORE_S, _FIRST_HYPOTHESES = 55e6, 25
# Compilation of kernels, on all cores; the range of heights.
_KERNELS_S, _RANGE_S = 2.0, 2.0
# Check of poses with this many photographs, and adjustment with all, at most at this size [Mpx]; times once, and per
# megapixel.
_CHECKED, _MOST_MPX = 10, 6.0
_CHECK_S, _ADJUST_S = (2.5, 0.1), (2.0, 2.0)
# Structure from motion: features per megapixel and matching per pair, on all cores; mapping per photograph, on one.
_FEATURES_S, _PAIR_S, _PLACING_S = 0.3, 0.02, 0.1
SFM_PARTS = ("Features", "Matches", "Structure from motion")
# Decoding a megapixel; the report, once; bed and report, per point.
_DECODING_S, _REPORT_S, _POINT_S = 0.02, 2.0, 3e-6
# Of the solver: once, and per pixel of a height map. Of a trained field, per cell of one ground sampling distance.
_SOLVER_S, _FIELD_S_PER_CELL = (1.4, 1.2e-6), 2.3e-4
# Of boxes beside edges: one of a sample of so many, by two cores. Whether the others are searched shows there.
_BOX_S, _MOST_BOXES, _BOX_CORES = 0.4, 32, 2
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
_DISK_OF_MAP, _DISK_OF_CELL, _DISK_AT_LEAST, _DISK_OF_SFM = 18, 210, 30e6, 2e6
# With more views than this, choosing those that cover the bed takes too long here: all count, as a bound.
_MOST_VIEWS = 2000
# For real photographs with noise, glitter or little texture, which need wider windows than simulated ones.
_HARD_MATCHING_TIME = "three to five times as long"
# Without poses: cells of the bed per pixel, since with the usual overlap a place is seen ten times or more.
_OWN_GROUND = 0.1


@dataclass(frozen=True)
class Amounts:
    """Amounts of work of a run on V photographs, of which M get a height map."""

    photographs_px: np.ndarray  # (V,): pixels of each, as it is
    view_px: np.ndarray  # (V,): at the scale of the run
    map_px: np.ndarray  # (M,)
    points: float  # Of the bed, one for each ground sampling distance squared, at most
    poses: str  # "check", "refine" or "fixed": what is done with them first
    field: str  # "solver", "off" or a model of `fields.models.IN_LAYER`
    has_boxes: bool = False
    # Whether these are upper bounds: poses are not known yet, or there are too many views to choose from
    is_bound: bool = False


def parts_s(amounts: Amounts, num_cores: int) -> dict[str, float]:
    """Times [s] of the parts of a run on idle cores, by the names of their stages, in order."""
    num_views, whole_mpx, map_px = len(amounts.view_px), amounts.photographs_px.sum() / 1e6, float(amounts.map_px.sum())
    parts = {"Images": _DECODING_S * whole_mpx}
    solves, mpx = amounts.field != "off", min(whole_mpx, num_views * _MOST_MPX)
    if amounts.poses == "check":
        parts["Poses"] = _CHECK_S[0] + _CHECK_S[1] * mpx * min(_CHECKED / num_views, 1.0)
    elif amounts.poses == "refine":
        parts = {"Adjustment": _ADJUST_S[0] + _ADJUST_S[1] * mpx} | parts
    passes = before_solver(PASSES) if solves else PASSES
    samples = map_px * sum(
        p.scale**2 * (p.hypotheses or _FIRST_HYPOTHESES) * p.neighbours * (POINTS_SHARE if p.points_only else 1.0)
        for p in passes
    )
    parts["Sweep"] = _RANGE_S + (_KERNELS_S + samples / _SAMPLES_PER_CORE_S) / num_cores
    if solves:
        parts["Solver"] = (_SOLVER_S[0] + _SOLVER_S[1] * map_px) / num_cores
    if amounts.field in IN_LAYER:
        parts["Field"] = _FIELD_S_PER_CELL * amounts.points / num_cores
    parts["Points"] = 0.5 * _POINT_S * amounts.points
    if amounts.has_boxes:
        sample = min(amounts.points / SIDE_GSD**2, _MOST_BOXES)
        parts["Boxes beside edges"] = _BOX_S * sample / min(num_cores, _BOX_CORES)
    return parts | {"Report": _REPORT_S + 0.5 * _POINT_S * amounts.points}


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
    cores, count = machine.num_cores(), len(sizes_px)
    of_sfm = _FEATURES_S * features_mpx / cores, _PAIR_S * pairs_about(count) / cores, _PLACING_S * count
    found = _workload(amounts, dict(zip(SFM_PARTS, of_sfm, strict=True)) | parts_s(amounts, cores))
    return replace(found, disk_bytes=found.disk_bytes + int(_DISK_OF_SFM * len(sizes_px)))


def _workload(amounts: Amounts, parts: Mapping[str, float]) -> Workload:
    return Workload(
        num_views=len(amounts.view_px),
        num_maps=len(amounts.map_px),
        seconds=_START_S + sum(parts.values()) if parts else None,
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


def room_warnings(workload: Workload, run_folder: Path, *, refuses: bool = False) -> list[str]:
    """Warnings where the disk of the run folder or the memory will not suffice.

    Raises SurveyError where the run ``refuses`` what is sure: too small a disk, or limits of this process.
    """
    warnings, needs = list[str](), f"the run needs {workload.bound_words}"
    stored = run_folder.glob("stages/**/*") if run_folder.is_dir() else ()
    room_bytes = machine.free_disk_bytes(run_folder) + sum(path.stat().st_size for path in stored if path.is_file())
    if workload.disk_bytes > room_bytes:
        warnings.append(
            f"{needs}{size(workload.disk_bytes)} in {run_folder}, and {room(room_bytes)} are free there; free some, "
            "name a run folder elsewhere with -o, or use a lower --quality"
        )
        if refuses and not workload.is_bound:
            raise SurveyError(warnings[0])
    free = machine.free_memory_bytes()
    if workload.memory_bytes > free:
        is_limited = machine.allowed_memory_bytes() <= free
        cause = (
            f"limits of this process (ulimit -v, -d) leave {room(free)}; raise them"
            if is_limited
            else f"{room(free)} are free: the system may stop it; close other programs"
        )
        warnings.append(
            f"{needs}{size(workload.memory_bytes)} of memory, and {cause}, use a lower --quality, or give [area] bounds"
        )
        if is_limited and refuses and not workload.is_bound:
            raise SurveyError(warnings[-1])
    return warnings


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
