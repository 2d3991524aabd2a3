"""Refractive plane sweep, coarse to fine: a height per pixel of every matched view.

Heights are measured over the water plane along its normal (over local z = 0 in a dry survey), so that a hypothesis
passes the shoreline without a step. Every pass tries heights about those that the pass before found; from the
second on the hypotheses follow the relief (`fields.sweep.kernels`), so that windows do not flatten what is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fields.device import Device, memory_bytes
from fields.image_store import LazyImages
from fields.sweep.block import Block
from fields.sweep.fusion import PEERS, ComparedViews, confirm, fuse
from fields.sweep.images import image_backend
from fields.sweep.kernels.backend import Job, kernels, run_jobs
from fields.sweep.kernels.stack import ViewStack, largest
from fields.sweep.maps import HeightMap, Keep, Maps, OrderedMaps, trusted, upsample_map
from fields.sweep.passes import MATCHED_NCC, POINTS_SHARE, Pass
from fields.sweep.tiles import PART_SIDE_PX
from fields.sweep.view_pass import Search, ViewPass, match_pass, pixels_of, refine_part, view_passes
from fields.sweep.views import Footprint

# Share of the memory of a device that maps may take; a pixel of a map takes four float32.
_SHARE, _PIXEL_BYTES = 0.5, 16
# A pass is finer than a map with so many times its pixels along a side: sizes of halved images are rounded.
_FINER = 1.2
# Size of a part: four pixels a side.
_SCALE = 0.25


def device_map_store(device: Device, keep: Keep, room_bytes: int | None = None) -> Keep:
    """Factory of map stores for the kernels of a device; ``keep`` is that of stores on the host.

    Maps on the device take ``room_bytes``, by default half of its memory.
    """
    if not device.apart:
        return keep
    room = _Budget(int(_SHARE * memory_bytes(device)) if room_bytes is None else room_bytes)
    return lambda: DeviceMaps(device, keep(), room)


def to_host_maps(device: Device, maps: Maps, keep: Keep) -> Maps:
    """Maps moved to the memory of the host; the store on the device is emptied."""
    if not device.apart:
        return maps
    found = keep()
    for view in list(maps):
        found[view] = image_backend(device).download(maps.pop(view))
    return found


class _Budget:
    """Memory budget in bytes that several stores share."""

    def __init__(self, num_bytes: int):
        self.left = num_bytes


class DeviceMaps(MutableMapping[int, HeightMap]):
    """Maps by view, on the device while there is room, the others on the host.

    Parameters
    ----------
    on_host : store of the maps that do not fit
    """

    def __init__(self, device: Device, on_host: Maps, room: _Budget):
        self._device, self._on_host, self._budget = device, on_host, room
        self._held: dict[int, HeightMap] = {}

    def __getitem__(self, view: int) -> HeightMap:
        if view in self._held:
            return self._held[view]
        return image_backend(self._device).upload(self._device, self._on_host[view])

    def __setitem__(self, view: int, m: HeightMap) -> None:
        self.pop(view, None)
        if _bytes_of(m) <= self._budget.left:
            self._budget.left -= _bytes_of(m)
            self._held[view] = m
        else:
            self._on_host[view] = image_backend(self._device).download(m)

    def __delitem__(self, view: int) -> None:
        if view in self._held:
            self._budget.left += _bytes_of(self._held.pop(view))
        else:
            del self._on_host[view]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted({*self._held, *self._on_host}))

    def __len__(self) -> int:
        return len(self._held) + len(self._on_host)

    def __contains__(self, view: object) -> bool:
        return view in self._held or view in self._on_host


def _bytes_of(m: HeightMap) -> int:
    rows, columns = m.height.shape
    return _PIXEL_BYTES * rows * columns


@dataclass(frozen=True)
class EarlierMaps:
    """Maps of an earlier sweep of the same bound, at a smaller scale or the same."""

    # mapping of view to HeightMap: views that have one keep its heights and confirm those of the others
    maps: Mapping[int, HeightMap]
    again: Collection[int] = ()  # views of ``maps`` that go on from there, with the finer passes


def sweep(
    block: Block,
    chosen: list[int],
    search: Search,
    progress: Callable[[float], None],
    *,
    earlier: EarlierMaps | None = None,
    keep: Keep = dict,
) -> OrderedMaps:
    """Sweep the chosen views, coarse to fine.

    Parameters
    ----------
    chosen : indices of the views that get a height map
    progress : called with the share done, 0 to 1
        Number of samples (pixels x hypotheses x compared views) of all passes, which take nearly all of the time.
    keep : callable
        Factory of the stores of maps between passes; default in memory.

    Returns
    -------
    OrderedMaps of HeightMap at the scale of the last pass, in the order of `chosen`
        Views that overlap with no other are left out.
    """
    earlier = EarlierMaps({}) if earlier is None else earlier
    store = device_map_store(block.device, keep)
    maps = store()
    work = _begin(block, chosen, search, earlier, maps)
    views = sorted({each.view for of_pass in work for each in of_pass} | set(maps))
    peers = {view: block.neighbours(view, PEERS, among=views) for view in views}
    state = _Sweep(block, search, work, peers, progress)
    passes = search.passes
    for number, pass_ in enumerate(passes):
        refined = state.match(number, maps)
        if state.fused[number]:
            maps = state.fuse(number, maps, refined, store)
        if number + 1 == len(passes) or passes[number + 1].scale != pass_.scale:
            block.release(pass_.scale)
    confirm(block, maps, {view: peers[view] for view in set(maps) - state.views[-1]})
    swept = to_host_maps(block.device, maps, keep)
    return OrderedMaps(swept, [view for view in chosen if view in swept])


def _begin(
    block: Block, chosen: list[int], search: Search, earlier: EarlierMaps, maps: Maps
) -> list[Sequence[ViewPass]]:
    """Views that take part in each pass; the maps that chosen views have from an earlier sweep go into ``maps``."""
    size = (block.cameras[0].width, block.cameras[0].height)
    again, widths = earlier.again, dict[int, int]()
    for view, m in earlier.maps.items():
        if view in chosen:
            known = m if view in again else upsample_map(m, size)
            maps[view], widths[view] = image_backend(block.device).upload(block.device, known), m.height.shape[1]
    return [
        view_passes(
            block,
            [v for v in chosen if _takes_part(size, pass_, widths.get(v), v in again)],
            pass_,
            None if n else search.bound,
        )
        for n, pass_ in enumerate(search.passes)
    ]


class _Sweep:
    """State of a sweep from pass to pass: window radii, parts to refine, and the share of samples that is done.

    Parameters
    ----------
    work : views that take part in each pass
    peers : the views that confirm the heights of each view

    Attributes
    ----------
    views : of each pass, as sets
    fused : number of samples that fusion after each pass takes; 0 where there is none
    """

    def __init__(
        self,
        block: Block,
        search: Search,
        work: Sequence[Sequence[ViewPass]],
        peers: Mapping[int, list[int]],
        progress: Callable[[float], None],
    ):
        self._block, self._search, self._work, self._peers, self._progress = block, search, work, peers, progress
        self.views = [{each.view for each in of_pass} for of_pass in work]
        self.fused = [
            sum(pixels_of(block, pass_, v) * len(peers[v]) for v in mine) if pass_.fuse else 0
            for pass_, mine in zip(search.passes, self.views, strict=True)
        ]
        # Radius of the windows of each view less that of its pass [px].
        self._wider = dict.fromkeys(peers, 0)
        self._wanted: dict[int, np.ndarray] = {}
        self._done, self._total, self._reported = 0.0, 0.0, 0.0

    def match(self, number: int, maps: Maps) -> dict[int, Any]:
        """Match the views of a pass into ``maps``; the refined pixels of views of which only parts were matched."""
        block, pass_, work, wider = self._block, self._search.passes[number], self._work[number], self._wider
        if pass_.points_only and not self._wanted:
            self._wanted = predict_selected_pixels(block, maps)
        wanted, refined = self._wanted, dict[int, Any]()
        parts = {each.view for each in work if each.view in wanted and not wider[each.view]}
        to_do = sum(self.fused[number:]) + _samples(self._search.passes[number:], self._work[number:], wider)
        self._total = self._done + to_do
        # A generator: each job holds a map.
        jobs: Iterator[Job[tuple[HeightMap, Any]]] = (
            refine_part(block, pass_, each, maps[each.view], wanted[each.view])
            if each.view in parts
            else match_pass(block, pass_, each, self._search, maps.get(each.view), wider[each.view])
            for each in work
        )
        found = run_jobs(block.device, jobs, _views_in_queue(block, pass_))
        for each, (m, of_view) in zip(work, found, strict=True):
            maps[each.view] = m
            samples = _samples([pass_], [[each]], wider)
            if each.view in parts:
                refined[each.view] = of_view
            else:
                if of_view > wider[each.view]:
                    # Matched again.
                    self._done, self._total = self._done + samples, self._total + samples
                wider[each.view] = of_view
            self._report(samples)
        return refined

    def fuse(self, number: int, maps: Maps, refined: dict[int, Any], store: Keep) -> Maps:
        """Maps after fusion of those of a pass; of views in ``refined`` these pixels alone take part."""
        block, pass_, views = self._block, self._search.passes[number], self.views[number]
        block.release(pass_.scale)
        if pass_.in_area:
            # The others neither confirm nor are confirmed.
            for view in views - set(refined):
                refined[view] = image_backend(block.device).indices_of(maps[view].score > MATCHED_NCC)
        compared = {
            view: ComparedViews(self._peers[view], refined.get(view))
            for view in views
            if view not in refined or len(refined[view])
        }
        goes_on = number + 1 < len(self._search.passes)
        fused = fuse(block, maps, pass_.scale, compared, store, goes_on=goes_on)
        self._report(self.fused[number])
        return fused

    def _report(self, samples: float) -> None:
        """Count samples as done. The share never falls, although views that are matched again add to the total."""
        self._done += samples
        self._reported = max(self._reported, self._done / self._total)
        self._progress(self._reported)


def _samples(passes: Sequence[Pass], work: Sequence[Sequence[ViewPass]], wider: Mapping[int, int]) -> float:
    """Samples of passes as they count for the progress.

    Views whose windows had to be ``wider`` are matched as a whole where others are in tiles about their points.
    """
    return sum(
        each.samples * (POINTS_SHARE if pass_.points_only and not wider[each.view] else 1.0)
        for pass_, of_pass in zip(passes, work, strict=True)
        for each in of_pass
    )


def _views_in_queue(block: Block, pass_: Pass) -> int:
    """Number of views in the queue: two where the images that both need stay in the cache."""
    return 2 if block.stack(pass_.scale).packed.values.most >= 2 * (pass_.neighbours + 1) else 1


def _takes_part(size: tuple[int, int], pass_: Pass, width: int | None, again: bool) -> bool:
    """Whether a view takes part in a pass: one that has a map of some width only if it goes on, in finer passes."""
    return width is None or (again and pass_.scale * size[0] > _FINER * width)


def predict_selected_pixels(block: Block, maps: Mapping[int, HeightMap]) -> dict[int, np.ndarray]:
    """Parts of each view that will become points, (height, width) bool at a quarter of the size.

    They have trusted pixels, and no steeper view has trusted ones that agree with them. Empty where images are smaller
    than a tile of `fields.sweep.tiles.PART_SIDE_PX`: there are no parts of these.
    """
    if min(min(camera.width, camera.height) for camera in block.cameras) < PART_SIDE_PX:
        return {}
    order = sorted(maps, key=lambda view: block.cameras[view].cam_from_local[2][2])
    cameras = [block.cameras[view].scaled(_SCALE) for view in order]
    backend, shapes = image_backend(block.device), [(camera.height, camera.width) for camera in cameras]

    def trusted_heights(m: HeightMap, shape: tuple[int, int]) -> Any:
        """Mean of the trusted heights in each part of a map [m]; NaN without any."""
        return backend.masked_means(m.height, trusted(m), shape)

    known = {view: trusted_heights(maps[view], shape) for view, shape in zip(order, shapes, strict=True)}
    extents = {view: backend.min_max(height) for view, height in known.items()}
    ground = {
        view: Footprint.of(camera, block.water, extent)
        for camera, (view, extent) in zip(cameras, extents.items(), strict=True)
        if extent is not None
    }
    heights = ViewStack.build(
        block.device,
        cameras,
        LazyImages(lambda number: known[order[number]], len(order), largest(cameras), 1),
        block.water,
    )
    wanted = {}
    for number, view in enumerate(order):
        against = None
        steeper = [
            n for n in range(number) if view in ground and order[n] in ground and ground[view].meets(ground[order[n]])
        ]
        middle = backend.median_above(known[view], -math.inf) if steeper else None
        if middle is not None:
            tolerance = block.agreement_tolerance(view, block.neighbours(view, 8, among=order), middle)
            against, _, _ = kernels(block.device).compare_heights(heights, number, steeper, tolerance)
        wanted[view] = backend.newly_visible(block.device, known[view], against)
    return wanted
