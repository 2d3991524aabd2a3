"""Tiles of a survey, rectangles of the ground that are processed one after the other, and the plan of a run with them.

The number of tiles is chosen by the memory that is free, with that of the processes that compute them.

Where the water is not a plane, each tile has its own plane. Rays that are bent at a plane a distance d away from the
water intersect (n - 1) d too high or low, which is corrected when points are made (`survey.run.points`). In addition
they shift sideways by ``d (tan a - n tan b)``, with ``sin a = n sin b``, oblique rays more than steep ones. Where that
exceeds a share of a pixel, photographs no longer match.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain

import numpy as np

from fields.models import IN_LAYER
from fields.sweep.block import Overlap
from fields.sweep.views import ground_points
from survey import machine
from survey.display.quantities import bytes_of, length, room, size
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.area import AREA_MARGIN_M, Area, Tiling, flattened, grown, local_area
from survey.plan.choices import Choices
from survey.plan.heights import dry_ground
from survey.plan.plan import Decision, Plan, make_plan
from survey.plan.sweep_block import camera_of
from survey.plan.workload import POINT_BYTES, Amounts, Workload, amounts_of_run, memory_of, workload_of
from survey.water.tides import GRAZING_DEG

# Overlap of maps beyond a tile [ground sampling distances]: windows of the solver with their halo (8), and the
# neighbourhood of points (4). Windows of the sweep are added, in pixels of each photograph.
RIM_GSD = 8.0
# Largest distance between the rays of a point: how far they are skew [px] (= ground sampling distances).
MOST_SKEW_PX = 0.25
# A range of heights is used for no more than this [m] along a side.
RANGE_M = 1000.0
# Places along each side of a tile.
_PLACES = 16
# What the tiles of a run share, in the folder of a stage.
SHARED = "shared.json"
# Of the free memory, what a run plans to take.
_SHARE_OF_FREE = 0.8
# Tiles are no smaller than this many footprints: rims and windows would be most of the work. Where the memory does not
# suffice otherwise, they may be smaller: windows of a quarter of a photograph along each side.
_LEAST_FOOTPRINTS, _LEAST_FOR_MEMORY = 0.5, 1.0 / 16.0
# Numbers of tiles up to this one are all tried where water is not a plane.
_FEW = 12
# Cores that one process makes good use of: the solver has no more threads.
_CORES_OF_WORKER = 4
# What a run without Dask is told.
NO_DASK = "--workers and --scheduler need Dask, which is not installed: pip install 'bathynerf[cluster]'"
# Photographs that stand for all where the size of windows is looked at.
_SAMPLE = 50
# Heights of the bed span about this share of the flying height; they are not known yet.
_RELIEF = 0.1
# Windows beside the middle of photographs, with their margins, may take a quarter more than those that are looked at.
_MORE = 1.25
# Beside the points while bed and report are made.
_REPORT_BYTES = 480e6


@dataclass(frozen=True)
class TileChoice:
    """Tiles of a run, and the processes that compute them."""

    tiling: Tiling | None  # None for one piece
    decisions: tuple[Decision, ...]  # On tiles, and on workers where there are tiles and several were asked for
    memory_bytes: float  # At the peak of the run, of all its processes
    workers: int = 1  # 1 for the process of the run itself


def plan_run(
    survey: Survey,
    chosen: Choices,
    *,
    aim: Decision | None = None,
    chooses_workers: bool = False,
    earlier_tiles: int | None = None,
) -> tuple[Plan, Workload, tuple[str, ...]]:
    """Plan and workload of a run on a survey whose poses are known, and warnings where tiles are not accurate enough.

    ``aim`` is how quality and image scale were chosen; ``chooses_workers`` whether a number of processes for tiles
    is chosen where none is given; ``earlier_tiles`` that of an unfinished run that goes on.
    """
    plan = make_plan(survey, chosen)
    amounts = amounts_of_run(survey, plan)
    workload = workload_of(survey, plan, amounts)
    tiles = choose_tiles(survey, plan, chosen, workload, amounts, earlier=earlier_tiles)
    tiles = with_workers(tiles, chosen, chooses=chooses_workers)
    decisions = (*plan.decisions, *(() if aim is None else (aim,)), *tiles.decisions)
    plan = replace(plan, decisions=decisions, tiling=tiles.tiling, workers=tiles.workers)
    return plan, replace(workload, memory_bytes=int(tiles.memory_bytes)), tile_warnings(survey, plan)


def choose_tiles(
    survey: Survey, plan: Plan, chosen: Choices, workload: Workload, amounts: Amounts, *, earlier: int | None = None
) -> TileChoice:
    """Tiles of a survey by its memory, with the workload in one piece and the amounts of the run.

    ``earlier`` is the number of tiles of an unfinished run that goes on.
    """
    require_dask(chosen)
    why = ""
    if plan.field in IN_LAYER:
        why = f"a run with --field {plan.field} is in one piece"
        if chosen.tiles is not None and chosen.tiles > 1:
            raise SurveyError(f"--tiles {chosen.tiles}, but {why}; leave one out")
    elif chosen.tiles == 1:
        why = "--tiles 1 is one piece"
    if why:
        if (asked := _asks_for_workers(chosen)) is not None:
            raise SurveyError(f"{asked}, but {why}; leave one out")
        return _one_piece(workload, "set by --tiles" if chosen.tiles == 1 else why)
    if chosen.tiles is None:
        return _as_needed(survey, plan, chosen, workload, amounts, earlier)
    tiling = Tiling.of(ground_of(survey, plan), chosen.tiles, RIM_GSD * plan.gsd_m)
    decision = Decision("tiles", str(chosen.tiles), f"set by --tiles, {_size_of(tiling)} each")
    return TileChoice(tiling, (decision,), _memory(survey, plan, tiling, amounts))


def _one_piece(workload: Workload, reason: str) -> TileChoice:
    return TileChoice(None, (Decision("tiles", "1", reason),), float(workload.memory_bytes))


def _as_needed(
    survey: Survey, plan: Plan, chosen: Choices, workload: Workload, amounts: Amounts, earlier: int | None
) -> TileChoice:
    """As few tiles as memory, workers, water and ranges of heights allow; one piece where it serves for all of them."""
    ground, one = ground_of(survey, plan), float(workload.memory_bytes)
    for_workers = max(1 if chosen.scheduler is None else 2, chosen.workers or 1)
    for_geometry, why = _for_geometry(survey, plan, ground)
    budget, source = _budget(chosen)
    in_one = f"in one piece the run takes about {size(one)} of memory"
    if one <= budget and max(for_workers, for_geometry) == 1:
        # How much is free changes from one moment to the next, the plan of a survey does not.
        is_free = "free" if chosen.memory is None else f"within the {room(budget)} of --memory"
        return _one_piece(workload, f"{in_one}, which is {is_free}")
    needed = "one for each worker at least" if one <= budget else f"{in_one}, and {room(budget)} {source}"
    if for_geometry > for_workers:
        needed = why
    # Workers of a scheduler have memory of their own.
    budget /= 1 if chosen.scheduler is not None else chosen.workers or 1
    best = _one_piece(workload, f"{needed}; the ground is too small for tiles")
    least = max(for_workers, for_geometry)
    counts = _counts(ground, max(_most_tiles(ground, plan, _LEAST_FOR_MEMORY), least))
    # That of an unfinished run and the least for the geometry come first.
    tried = [*filter(None, [earlier]), *[for_geometry] * (for_geometry == least > 1), *counts]
    # About square ones may all be fewer than there are workers.
    for count in [count for count in tried if count >= max(least, 2)] or [least] * (least > 1):
        tiling = Tiling.of(ground, count, RIM_GSD * plan.gsd_m)
        memory = _memory(survey, plan, tiling, amounts)
        if best.tiling is None or memory < 0.98 * best.memory_bytes:
            reason = f"{needed}; in tiles of {_size_of(tiling)} about {size(memory)}"
            best = TileChoice(tiling, (Decision("tiles", str(count), reason),), memory)
        if memory <= budget:
            break
    return best


def _most_tiles(ground: Area, plan: Plan, least_footprints: float = _LEAST_FOOTPRINTS) -> int:
    return int((ground[2] - ground[0]) * (ground[3] - ground[1]) / (least_footprints * np.prod(plan.footprint_m)))


def _for_geometry(survey: Survey, plan: Plan, ground: Area) -> tuple[int, str]:
    """Least number of tiles in which one range of heights serves, and a plane for the water or is off least; why."""
    for_ranges = math.prod(math.ceil((ground[axis + 2] - ground[axis]) / RANGE_M) for axis in (0, 1))
    most = _most_tiles(ground, plan)
    # A river is long: few tiles of it are not square.
    counts = sorted({*range(2, min(most, _FEW) + 1), *_counts(ground, most)})
    tilings = (Tiling.of(ground, count, RIM_GSD * plan.gsd_m) for count in counts)
    tried = []
    for tiling, px in ray_skew_px(survey, plan, ground, chain([None], tilings)):
        tried.append((px, 1 if tiling is None else len(tiling)))
        if px <= MOST_SKEW_PX:
            break
    if not tried or for_ranges > min(tried)[1]:
        return for_ranges, "a range of heights serves for a kilometre"
    return min(tried)[1], f"rays of a point bent at one plane are skew by up to {tried[0][0]:.2g} px"


def has_dask() -> bool:
    """Whether Dask is installed, and what makes its keys."""
    return find_spec("distributed") is not None and find_spec("cryptography") is not None


def require_dask(chosen: Choices) -> None:
    """Raise where workers are asked for and Dask is not installed."""
    if _asks_for_workers(chosen) is not None and not has_dask():
        raise SurveyError(NO_DASK)


def _asks_for_workers(chosen: Choices) -> str | None:
    """Name of the option that asks for worker processes."""
    if chosen.scheduler is not None:
        return f"--scheduler {chosen.scheduler}"
    return None if chosen.workers in (None, 1) else f"--workers {chosen.workers}"


def with_workers(found: TileChoice, chosen: Choices, *, chooses: bool = False) -> TileChoice:
    """Tiles with the processes that are asked for; else, if it ``chooses``, as many as the machine has room for."""
    tiling = found.tiling
    if tiling is None:
        return found
    if chosen.scheduler is not None:
        decision = Decision("workers", "of a scheduler", f"set by --scheduler {chosen.scheduler}")
        return replace(found, decisions=(*found.decisions, decision))
    if chosen.workers is not None:
        number, reason = min(chosen.workers, len(tiling)), "set by --workers"
        if number < chosen.workers:
            reason = f"--workers {chosen.workers}, but there are no more tiles"
    else:
        cores = machine.num_cores()
        number = min(cores // _CORES_OF_WORKER, len(tiling), int(_budget(chosen)[0] // found.memory_bytes))
        if not chooses or number < 2 or not has_dask():
            return found
        reason = f"{cores} cores, of which a process uses {_CORES_OF_WORKER}, and {size(found.memory_bytes)} for each"
    decisions = (*found.decisions, Decision("workers", str(number), reason))
    return TileChoice(tiling, decisions, number * found.memory_bytes, number)


def _counts(ground: tuple[float, float, float, float], most: int) -> list[int]:
    """Candidate numbers of tiles that are about square, ascending."""
    ratio = (ground[2] - ground[0]) / (ground[3] - ground[1])
    found = set()
    for rows in range(1, most + 1):
        columns = max(round(rows * ratio), 1)
        found |= {count for count in (rows * columns, rows * (columns + 1)) if 1 < count <= most}
        if rows * columns > most:
            break
    return sorted(found)


def _budget(chosen: Choices) -> tuple[float, str]:
    """Memory that a run may take [bytes], and where that is from."""
    if chosen.memory is not None:
        return bytes_of(chosen.memory), "are allowed (--memory)"
    return _SHARE_OF_FREE * machine.free_memory_bytes(), f"may be taken ({_SHARE_OF_FREE:.0%} of what is free)"


def _size_of(tiling: Tiling) -> str:
    width, height = tiling.x[1] - tiling.x[0], tiling.y[1] - tiling.y[0]
    return f"{length(width)} x {length(height)}"


def _memory(survey: Survey, plan: Plan, tiling: Tiling, amounts: Amounts) -> float:
    """Memory at the peak of a run in tiles [bytes]."""
    extent = np.array([tiling.x[-1] - tiling.x[0], tiling.y[-1] - tiling.y[0]])
    own = np.array([tiling.x[1] - tiling.x[0], tiling.y[1] - tiling.y[0]]) + 2.0 * tiling.rim
    footprint = np.array(plan.footprint_m)
    window = _MORE * window_pixels(survey, plan, (float(own[0]), float(own[1])))
    # Photographs are spread over the ground; those that show a tile begin half a footprint beyond it.
    share = float(np.prod(np.minimum((own + footprint) / (extent + footprint), 1.0)))
    of_views, of_maps = (
        np.quantile(np.minimum(window, amounts.view_px.max()), np.linspace(1.0, 0.0, max(math.ceil(share * count), 1)))
        for count in (len(amounts.view_px), len(amounts.map_px))
    )
    of_tile = replace(amounts, view_px=of_views, map_px=of_maps, points=amounts.points / len(tiling))
    return max(memory_of(of_tile), _REPORT_BYTES + POINT_BYTES * amounts.points)


def window_pixels(survey: Survey, plan: Plan, sides: tuple[float, float]) -> np.ndarray:
    """Pixels (K,) of the windows in which some photographs show a rectangle of the ground in their middle.

    It has sides (east, north) [m]; bounding boxes of it are larger in photographs that are turned or tilted.
    """
    survey = flattened(survey)
    views = [survey.views[k] for k in np.unique(np.linspace(0, len(survey.views) - 1, _SAMPLE).astype(int))]
    cameras = [camera_of(view, plan) for view in views]
    if survey.water is None:
        level = dry_ground(survey).height
    else:
        level = float(np.median([survey.water.height(*camera.centre[:2]) for camera in cameras]))
    middles = ground_points(cameras, level)
    outline = np.array([(x, y, z) for z in (0.0, -1.0) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)])
    found = []
    for camera, middle in zip(cameras, middles, strict=True):
        around = outline * (*sides, _RELIEF * (camera.centre[2] - level))
        pixels, size = camera.project(middle + around, survey.water), (camera.width, camera.height)
        box = np.clip(pixels.max(axis=0), 0.0, size) - np.clip(pixels.min(axis=0), 0.0, size)
        # All of a photograph whose middle shows no ground, or where something of the rectangle cannot be projected.
        found.append(float(np.prod(box)) if np.isfinite(pixels).all() else float(np.prod(size)))
    return np.array(found)


def ground_of(survey: Survey, plan: Plan) -> Area:
    """Rectangle of the ground that a survey wants: its bounds, or what two views see at the rough height of the bed."""
    area = local_area(survey)
    if area is not None:
        return grown(area, AREA_MARGIN_M)
    survey = flattened(survey)
    height = 0.0 if survey.water is not None else dry_ground(survey).height
    overlap = Overlap([camera_of(view, plan) for view in survey.views], survey.water, height)
    seen = overlap.cells[overlap.seen.sum(axis=0) >= 2, :2]
    seen = seen if len(seen) else overlap.cells[:, :2]
    # The bed may lie lower, so that views show more of it: half of a footprint.
    reach = 0.5 * max(plan.footprint_m)
    return (*(seen.min(axis=0) - reach).tolist(), *(seen.max(axis=0) + reach).tolist())


def places_of(ground: Area) -> np.ndarray:
    """Even places (M, 2) [m], local, in a rectangle."""
    x, y = (np.linspace(ground[axis], ground[axis + 2], _PLACES) for axis in range(2))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def ray_skew_px(
    survey: Survey, plan: Plan, ground: Area, tilings: Iterable[Tiling | None]
) -> Iterator[tuple[Tiling | None, float]]:
    """Each of several tilings of a ground, with the largest distance [px] between rays of a point in its tiles."""
    departure = survey.observations.departure
    if survey.water is None or departure is None:
        return
    over, per_m = departure.interpolated(ground), _skew_per_m(survey)
    for tiling in tilings:
        most = 0.0
        for number in range(1 if tiling is None else len(tiling)):
            places = places_of(ground if tiling is None else tiling.ground(number, tiling.rim))
            departures = over(places)
            if tiling is not None:
                design = np.column_stack([np.ones(len(places)), places - places.mean(axis=0)])
                departures = departures - design @ np.linalg.lstsq(design, departures, rcond=None)[0]
            most = max(most, float(np.abs(departures).max()))
        yield tiling, most * per_m / plan.gsd_m


def tile_warnings(survey: Survey, plan: Plan) -> tuple[str, ...]:
    """A warning where the planes of the tiles do not approximate the water well enough."""
    if survey.water is None or survey.observations.departure is None:
        return ()
    _, px = next(ray_skew_px(survey, plan, ground_of(survey, plan), [plan.tiling]))
    if px <= MOST_SKEW_PX:
        return ()
    planes = "one plane" if plan.tiling is None else "the planes of the tiles"
    return (
        f"rays bent at {planes} for the water of [water] surface "
        f"are skew by up to {px:.2g} px, expected at most {MOST_SKEW_PX:g}: heights there may be wrong or "
        "missing; take more tiles (--tiles), or photographs that look down more steeply",
    )


def _skew_per_m(survey: Survey) -> float:
    """``tan a - n tan b`` of the most oblique ray of the photographs [-]."""
    water = survey.water
    if water is None:
        return 0.0
    cosines = []
    for view in survey.views:
        rays = view.camera.directions(view.camera.outline())
        cosines.append(float(np.nanmin(-(rays @ np.array(water.up)))))
    cosine = max(min(cosines), np.cos(np.radians(GRAZING_DEG)))
    sine = np.sqrt(1.0 - cosine**2)
    in_water = sine / water.n_water
    return float(sine / cosine - water.n_water * in_water / np.sqrt(1.0 - in_water**2))
