"""Refractive plane sweep, coarse to fine: a height per pixel of every matched view.

Heights are measured over the water plane along its normal (over local z = 0 in a dry survey), so that a hypothesis
passes the shoreline without a step. Every pass tries heights about those that the pass before found; from the
second on the hypotheses follow the relief (`fields.sweep.kernels`), so that windows do not flatten what is known.

The range of heights comes from a full sweep of a few views at thumbnail size.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import cv2
import numpy as np
from scipy import ndimage

from fields.sweep.block import Block
from fields.sweep.fusion import PEERS, ComparedViews, fuse
from fields.sweep.images import masked_means, median_above, newly_visible
from fields.sweep.kernels.arrays import Job, host, run_job, run_jobs
from fields.sweep.kernels.rays import compare_heights
from fields.sweep.kernels.stack import Hypotheses, ViewStack
from fields.sweep.maps import HeightMap, Maps, OrderedMaps, StoreFactory, trusted
from fields.sweep.matching import MATCHED_NCC, POINTS_SHARE, Pass, Reference, match_with_adaptive_windows
from fields.sweep.tiles import PART_SIDE_PX
from fields.sweep.view_pass import MatchedView, SweepSettings, ViewPass, match_pass, pixels_of, refine_part, view_passes
from fields.sweep.views import Footprint

THUMBNAIL_PX = 128
NUM_VIEWS = 8
NUM_NEIGHBOURS = 8
WINDOW_RADIUS = 3
# A thumbnail pixel counts where half of its neighbours correlate this well in such windows, and the best height is not
# the first or the last hypothesis. In wider windows the threshold falls in proportion to chance correlation.
CONFIDENT_NCC = 0.7
MIN_PIXELS = 200
# With fewer height hypotheses, of which the first and the last count for nothing, a range is narrow already.
_FEWEST_HYPOTHESES = 9
# Chance matches are uniform between the limits. Of so many bins, those with less than this share of the mean count hold
# chance matches alone; bins with more than that, by so many standard deviations, hold bed, and so do bins connected to
# them, such as a mast.
_PARTS, _CHANCE, _SIGMAS = 60, 0.25, 4.0


def find_range(block: Block, limits: tuple[float, float]) -> tuple[float, float]:
    """Heights [m] over the water plane between which the bed lies.

    Raises ValueError if too few pixels match. ``limits`` (low, high) [m]: range of heights searched. Returns (low,
    high) [m]: the 0.5 and 99.5 % quantiles of the heights that match well and continue around, without those that are
    no more frequent than chance, widened by a quarter of their distance and one step. The limits themselves, where
    thumbnails resolve too few heights between them.
    """
    scale = min(1.0, THUMBNAIL_PX / block.cameras[0].width)
    stack = block.stack(scale)
    chosen = block.cover(1, 0)
    # Of a tile perhaps none: its windows hold heights at which no view shows it.
    chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, NUM_VIEWS).astype(int))] if chosen else []
    heights, steps, radius = [np.empty(0)], [0.0], WINDOW_RADIUS
    for view in chosen:
        others = block.neighbours(view, NUM_NEIGHBOURS)
        if not others:
            continue
        step = 0.5 / (scale * block.parallax(view, others, 0.5 * (limits[0] + limits[1])))
        count = int(np.ceil((limits[1] - limits[0]) / step)) + 1
        if count < _FEWEST_HYPOTHESES:
            block.release(scale)
            return limits
        start = np.full((stack.height, stack.width), limits[0], dtype=np.float32)
        reference = Reference(stack, view, others, radius)
        job = match_with_adaptive_windows(reference, Hypotheses(start, step, count))
        (z, score, curvature), radius = run_job(block.device, job)
        confident = CONFIDENT_NCC * (2 * WINDOW_RADIUS + 1) / (2 * radius + 1)
        # A chance match is isolated; the bed continues in the pixels around.
        supported = np.abs(z - cv2.medianBlur(z, 5)) < step
        heights.append(z[(score > confident) & (curvature > 0.0) & supported])
        steps.append(step)
    block.release(scale)
    matched = np.concatenate(heights)
    if matched.size < MIN_PIXELS:
        raise ValueError(
            f"only {matched.size} thumbnail pixels match between views at heights from {limits[0]:.1f} to "
            f"{limits[1]:.1f} m over the water; check that poses, water level and images belong together and that "
            "the bed shows texture"
        )
    low, high = np.quantile(without_chance_matches(matched, limits), [0.005, 0.995])
    margin = 0.25 * (high - low) + max(steps)
    return max(float(low - margin), limits[0]), min(float(high + margin), limits[1])


def without_chance_matches(found: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Heights (N,) [m] without those in isolated bins of the histogram that hold no more than chance."""
    count, edges = np.histogram(found, bins=_PARTS, range=limits)
    chance = count[count < _CHANCE * count.mean()]
    rate = float(chance.mean()) if len(chance) else 0.0
    groups, _ = ndimage.label(count > 0)
    bed = np.isin(groups, np.unique(groups[count > rate + _SIGMAS * np.sqrt(rate)]))
    return found[bed[np.clip(np.searchsorted(edges, found, side="right") - 1, 0, _PARTS - 1)]]


_SCALE = 0.25  # Size of a part: four pixels a side


def sweep(
    block: Block,
    chosen: list[int],
    settings: SweepSettings,
    progress: Callable[[float], None],
    *,
    make_store: StoreFactory = dict,
) -> OrderedMaps:
    """Sweep the chosen views, coarse to fine.

    ``chosen``: indices of the views that get a height map. ``progress``: called with the share done, 0 to 1, number of
    samples (pixels x hypotheses x compared views) of all passes, which take nearly all of the time. ``make_store``:
    factory of the stores of maps between passes; default in memory. Returns OrderedMaps of HeightMap at the scale of
    the last pass, in the order of `chosen`: views that overlap with no other are left out.
    """
    maps = make_store()
    work = [view_passes(block, chosen, p, None if n else settings.bound) for n, p in enumerate(settings.passes)]
    views = sorted({each.view for of_pass in work for each in of_pass})
    peers = {view: block.neighbours(view, PEERS, candidates=views) for view in views}
    state = _Sweep(block, settings, work, peers, progress)
    passes = settings.passes
    for number, pass_ in enumerate(passes):
        refined = state.match(number, maps)
        if state.fused[number]:
            maps = state.fuse(number, maps, refined, make_store)
        if number + 1 == len(passes) or passes[number + 1].scale != pass_.scale:
            block.release(pass_.scale)
    return OrderedMaps(maps, [view for view in chosen if view in maps])


class _Sweep:
    """State of a sweep from pass to pass: window radii, parts to refine, and the number of samples that are done.

    ``work``: views that take part in each pass. ``peers``: the views that confirm the heights of each view. ``views``:
    of each pass, as sets. ``fused``: number of samples that fusion after each pass takes; 0 where there is none.
    """

    def __init__(
        self,
        block: Block,
        settings: SweepSettings,
        work: Sequence[Sequence[ViewPass]],
        peers: Mapping[int, list[int]],
        progress: Callable[[float], None],
    ):
        self._block, self._settings, self._work, self._peers, self._progress = block, settings, work, peers, progress
        self.views = [{each.view for each in of_pass} for of_pass in work]
        self.fused = [
            sum(pixels_of(block, pass_, v) * len(peers[v]) for v in views_of_pass) if pass_.fuse else 0
            for pass_, views_of_pass in zip(settings.passes, self.views, strict=True)
        ]
        # Of each view, radius of its windows less that of the pass.
        self._extra_radius_px = dict.fromkeys(peers, 0)
        self._selected: dict[int, np.ndarray] = {}
        matched = (_samples(pass_, each) for pass_, views in zip(settings.passes, work, strict=True) for each in views)
        self._done, self._total = 0.0, sum(self.fused) + sum(matched)

    def match(self, number: int, maps: Maps) -> dict[int, np.ndarray]:
        """Match the views of a pass into ``maps``; the refined pixels of views of which only parts were matched."""
        block, settings, work = self._block, self._settings, self._work[number]
        pass_, extra_px = settings.passes[number], self._extra_radius_px
        if pass_.points_only and not self._selected:
            self._selected = predict_selected_pixels(block, maps)
        selected, refined = self._selected, dict[int, np.ndarray]()
        # A generator: each job holds a map.
        jobs: Iterator[Job[MatchedView]] = (
            refine_part(block, pass_, each, maps[each.view], selected[each.view])
            if each.view in selected and not extra_px[each.view]
            else match_pass(block, pass_, each, settings, maps.get(each.view), extra_px[each.view])
            for each in work
        )
        # Two views in the queue where the images that both need stay in the cache.
        in_queue = 2 if block.stack(pass_.scale).packed.kept >= 2 * (pass_.neighbours + 1) else 1
        for each, matched in zip(work, run_jobs(block.device, jobs, in_queue), strict=True):
            maps[each.view] = matched.map
            if matched.refined_pixels is not None:
                refined[each.view] = matched.refined_pixels
            else:
                extra_px[each.view] = max(extra_px[each.view], matched.extra_radius_px)
            self._report(_samples(pass_, each))
        return refined

    def fuse(self, number: int, maps: Maps, refined: Mapping[int, np.ndarray], make_store: StoreFactory) -> Maps:
        """Maps after fusion of those of a pass, which are emptied; of views in ``refined`` these pixels take part."""
        block, pass_, views = self._block, self._settings.passes[number], self.views[number]
        block.release(pass_.scale)
        pixels = dict(refined)
        if pass_.in_area:
            # The others neither confirm nor are confirmed.
            for view in views - set(refined):
                pixels[view] = np.flatnonzero(maps[view].score > MATCHED_NCC)
        compared = {
            view: ComparedViews(self._peers[view], pixels.get(view))
            for view in views
            if view not in pixels or len(pixels[view])
        }
        is_intermediate = number + 1 < len(self._settings.passes)
        fused = fuse(block, maps, pass_.scale, compared, make_store, is_intermediate=is_intermediate)
        self._report(self.fused[number])
        return fused

    def _report(self, samples: float) -> None:
        self._done += samples
        self._progress(self._done / self._total)


def _samples(pass_: Pass, view: ViewPass) -> float:
    """Samples of a view as they count for the progress, without those of wider windows."""
    return view.samples * (POINTS_SHARE if pass_.points_only else 1.0)


def predict_selected_pixels(block: Block, maps: Mapping[int, HeightMap]) -> dict[int, np.ndarray]:
    """Parts of each view that will become points, (height, width) bool at a quarter of the size.

    They have trusted pixels, and no steeper view has trusted ones that agree with them. Empty where images are smaller
    than a tile of `fields.sweep.tiles.PART_SIDE_PX`: there are no parts of these.
    """
    if min(min(camera.width, camera.height) for camera in block.cameras) < PART_SIDE_PX:
        return {}
    order = sorted(maps, key=lambda view: block.cameras[view].cam_from_local[2][2])
    cameras = [block.cameras[view].scaled(_SCALE) for view in order]
    known = {
        view: masked_means(maps[view].height, trusted(maps[view]), (camera.height, camera.width))
        for view, camera in zip(order, cameras, strict=True)
    }
    ground = {
        view: Footprint.of(camera, block.water, (float(np.nanmin(known[view])), float(np.nanmax(known[view]))))
        for view, camera in zip(order, cameras, strict=True)
        if np.isfinite(known[view]).any()
    }
    heights = ViewStack.lazy(block.device, cameras, lambda number: known[order[number]], block.water)
    selected = {}
    for number, view in enumerate(order):
        against = None
        steeper = [
            n for n in range(number) if view in ground and order[n] in ground and ground[view].meets(ground[order[n]])
        ]
        middle = median_above(known[view], -math.inf) if steeper else None
        if middle is not None:
            tolerance = block.agreement_tolerance(view, block.neighbours(view, 8, candidates=order), middle)
            against = host(block.device, compare_heights(heights, number, steeper, tolerance)[0])
        selected[view] = newly_visible(known[view], against)
    return selected
