"""Tie points of the bed, each measured to a fraction of a pixel in many photographs.

A coarse sweep gives approximate heights of the bed. At well textured places a window of one photograph is projected
over a level piece of bed, through the water, into the others, where least-squares matching refines its position. The
heights of the sweep are approximate values only; what is measured is the position of the window in each photograph.

Matching is the inverse compositional form (S. Baker and I. Matthews, IJCV 56(3), 2004, section 3.2), of a shift alone,
with brightness and contrast free: steps are solved in the template, (S, S) samples at whole pixels of the window in its
own photograph, whose slopes stay as they are.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter

from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted
from fields.sweep.matching import PASSES
from fields.sweep.sweep import find_range, sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.views import cells_of, overlaps
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints, least_track
from survey.plan.area import limits, local_area, within
from survey.plan.choices import Choices
from survey.plan.plan import Plan, make_plan
from survey.plan.sweep_block import camera_of, load_block

# The coarse sweep: approximate heights of the bed. Beside steps, where there are no windows, nothing more is searched.
_SWEPT = (PASSES[0], replace(PASSES[1], fuse=True, discontinuities=None))
# Of the time of a search for windows, about.
_OF_SWEEP = 0.5
# Least number of photographs with windows that see each place: steep ones, and oblique ones from each quarter.
_TIMES_SEEN = (2, 1)
# Most photographs in which a window is searched for, and the angles between directions of view: windows at wider angles
# match less often, and did not make the water more certain.
_MOST_OTHERS = 24
_WIDEST_DEG = 40.0
_NARROWEST_DEG = 3.0
# A window is left out where the relief under it has more than this many pixels of parallax.
_RELIEF_PX = 2.0
# Half the side of a window [px]: 13 x 13 hold texture enough, and little relief.
RADIUS = 6
# Most steps, and how far [px] a window may end from where it was expected.
_STEPS, _FARTHEST_PX = 12, 4.0
# A step shorter than this [px] is below the noise of a photograph.
_DONE_PX = 0.005
# With a lower correlation (NCC) a window shows another surface.
_ALIKE = 0.85
# A window keeps this far [px] from masked pixels. The cubic spline carries their fill over to its neighbours, less by a
# factor of 0.27 from pixel to pixel: after five, a thousandth is left, less than a grey level.
_CLEAR_PX = 5

Area = tuple[float, float, float, float]


@dataclass(frozen=True)
class Density:
    most: int  # The best textured ones
    apart_px: int  # Least distance between them, so that each sees a separate piece of bed


# For an adjustment, and for the means over photographs.
DENSE, SPARSE = Density(250, 20), Density(100, 30)


@dataclass(frozen=True)
class _Windows:
    """Windows of one photograph: K of them, each of S*S samples."""

    view: int
    corners: np.ndarray  # (K, 2) [px]: their middles
    height: np.ndarray  # (K,) [m] over the water plane
    points: np.ndarray  # (K, 3) [m], local: of the middles on the bed
    templates: np.ndarray  # (K, S*S): grey values
    slopes: np.ndarray  # (K, S*S, 2) [1/px]: of the grey values, along x and y
    others: list[int]  # Views in which they are searched for


def measure_tie_points(
    block: Block,
    bound: tuple[float, float],
    area: Area | None,
    advance: Callable[[float], None],
    density: Density = DENSE,
) -> TiePoints:
    """Tie points of a block, in pixels of its images, of three photographs or more, of two both.

    Its water is only the start; the bed is searched between ``bound`` [m] over the water plane, as of
    `fields.sweep.sweep.find_range`, and windows are chosen in the area (x0, y0, x1, y1) [m], local.
    """
    block.set_overlap_height(0.5 * (bound[0] + bound[1]))
    chosen, shares = block.cover(*_TIMES_SEEN, area), [0.0]

    def swept(share: float) -> None:
        advance(_OF_SWEEP * (share - shares[-1]))
        shares.append(share)

    maps = sweep(block, chosen, SweepSettings(bound, _SWEPT), swept)
    # Two photographs at a time, so that the gradients and splines of no more are in memory.
    with ThreadPoolExecutor(2) as pool:
        of_maps = pool.map(partial(_windows_of, block, area=area, density=density), maps)
        windows = [w for w in of_maps if len(w.corners)]
        parts: list[list[tuple[np.ndarray, int, np.ndarray]]] = [
            [(np.arange(len(w.corners)), w.view, w.corners)] for w in windows
        ]
        for other, found in enumerate(pool.map(partial(_found_in, block, windows), range(len(block.cameras)))):
            for i, index, pixels in found:
                parts[i].append((index, other, pixels))
            advance((1.0 - _OF_SWEEP) / len(block.cameras))
    return _concatenate(windows, parts, least_track(len(block.cameras)))


def _found_in(block: Block, windows: list[_Windows], other: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Matches in a photograph: numbers of windows (K,), and their positions (K, 2) [px]."""
    camera, water = block.cameras[other], block.water
    asking = [i for i, w in enumerate(windows) if other in w.others]
    if not asking:
        return []
    image, parts = prepare_image(block.images[other]), []
    for i in asking:
        w = windows[i]
        offsets = _warp(block.cameras[w.view], camera, w.corners, w.height, water)
        found, ok = match(image, w.templates, w.slopes, camera.project(w.points, water), offsets)
        parts.append((i, np.flatnonzero(ok), found[ok]))
    return parts


def _windows_of(block: Block, height_map: HeightMap, area: Area | None, density: Density) -> _Windows:
    view, water = height_map.view, block.water
    camera, image = block.cameras[view], block.images[view]
    corners, height = _corners(image, camera, height_map, _usable_pixels(block, height_map, area), density)
    points = camera.paths(corners, water).at_height(height, water)
    templates, slopes = _templates(image, corners)
    others = _neighbours_of(block, view, points) if len(points) else []
    return _Windows(view, corners, height, points, templates, slopes, others)


def _usable_pixels(block: Block, height_map: HeightMap, area: Area | None) -> np.ndarray:
    """Pixels of a height map (height, width) bool whose height is trusted, without a step beside it, in the area."""
    camera, height = block.cameras[height_map.view], height_map.height
    parallax = block.parallax(height_map.view, block.neighbours(height_map.view, 8), float(np.median(height)))
    kernel = np.ones((7, 7))
    relief = cv2.dilate(height, kernel) - cv2.erode(height, kernel)
    usable = trusted(height_map) & (relief * parallax < 2 * _RELIEF_PX)
    if area is not None:
        small = camera.scaled(_SWEPT[-1].scale)
        points = small.paths(small.pixel_centres(), block.water).at_height(height, block.water)
        usable &= within(points.reshape(-1, 3), area).reshape(usable.shape)
    return usable


def _corners(image: np.ndarray, camera: PinholeCamera, height_map: HeightMap, usable: np.ndarray, density: Density):
    """Textured pixel centres (K, 2) of a view at the usable pixels of its height map, and heights (K,)."""
    size = (camera.width, camera.height)
    mask = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    # A window and the slopes at its rim lie inside the photograph and hold no masked pixel.
    edge = RADIUS + 2
    mask[:edge], mask[-edge:], mask[:, :edge], mask[:, -edge:] = 0, 0, 0, 0
    known = cv2.erode(np.isfinite(image).astype(np.uint8), np.ones((2 * edge + 1, 2 * edge + 1), np.uint8))
    mask[known == 0] = 0
    grey = np.nan_to_num(image)
    found = cv2.goodFeaturesToTrack(grey, density.most, 0.02, density.apart_px, mask=mask, blockSize=2 * RADIUS + 1)
    corners = np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64)
    full = cv2.resize(height_map.height, size, interpolation=cv2.INTER_LINEAR)
    columns, lines = corners.T.astype(int)
    return corners + 0.5, full[lines, columns].astype(np.float64)


def _templates(image: np.ndarray, corners: np.ndarray):
    """Windows (K, S*S) about pixel centres, and their slopes (K, S*S, 2) per pixel along x and y."""
    dy, dx = np.gradient(image)
    x, y = window()
    columns, lines = (corners - 0.5).round().astype(int).T
    at = (lines[:, None] + y, columns[:, None] + x)
    return image[at].astype(np.float64), np.stack([dx[at], dy[at]], axis=-1).astype(np.float64)


def _warp(camera, other_camera, corners, height, water: FlatWater | None) -> np.ndarray:
    """Offsets of the samples of windows in another view from their middle, on a level bed: (K, 2, S*S) [px].

    Exact at nine nodes and a parabola between them: over a window the perspective bends by hundredths of a pixel,
    always to the same side, and its next term is a hundred times smaller.
    """
    nodes = np.array([(x, y) for y in (-RADIUS, 0.0, RADIUS) for x in (-RADIUS, 0.0, RADIUS)])
    ends = camera.paths(corners[:, None] + nodes, water).at_height(height[:, None], water)
    ends = other_camera.project(ends, water)
    ends = ends - ends[:, 4:5]
    parabola = _powers(*window()) @ np.linalg.inv(_powers(*nodes.T))
    return np.einsum("sn,kna->kas", parabola, ends)


def _powers(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    x, y = x / RADIUS, y / RADIUS
    return np.stack([x**i * y**j for j in range(3) for i in range(3)], axis=-1)


def _neighbours_of(block: Block, view: int, points: np.ndarray) -> list[int]:
    """Views whose direction to the middle of the points differs usefully, spread over the angles."""
    middle = np.nanmedian(points, axis=0)
    rays = np.array([camera.centre for camera in block.cameras]) - middle
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[view], -1.0, 1.0)))
    overlap = overlaps(block.seen, view) if len(cells_of(block.seen, view)) else np.zeros(len(rays))
    usable = [o for o in np.argsort(-overlap) if o != view and overlap[o] > 0.2]
    usable = [o for o in usable if _NARROWEST_DEG < angle[o] < _WIDEST_DEG]
    # The farthest from those already taken, so that they come from all around.
    chosen = [view]
    while usable and len(chosen) <= _MOST_OTHERS:
        gaps = [min(float(np.linalg.norm(rays[o] - rays[c])) for c in chosen) for o in usable]
        chosen.append(usable.pop(int(np.argmax(gaps))))
    return [int(o) for o in chosen[1:]]


def _concatenate(windows: list[_Windows], parts, least: int) -> TiePoints:
    """All windows as one, those with so many measurements or more."""
    if not windows:
        return TiePoints(np.zeros((0, 3)), np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2)))
    first = np.cumsum([0, *(len(w.points) for w in windows)])
    rows = [(shift + index, view, px) for shift, part in zip(first, parts, strict=False) for index, view, px in part]
    point = np.concatenate([index for index, _, _ in rows])
    view = np.concatenate([np.full(len(index), view) for index, view, _ in rows])
    pixel = np.concatenate([pixels for _, _, pixels in rows])
    order = np.argsort(point, kind="stable")
    points = np.concatenate([w.points for w in windows])
    ties = TiePoints(points, point[order], view[order], pixel[order], least)
    return ties.only(np.isfinite(points).all(axis=1)[ties.point])


def measure_windows(survey: Survey, *, device: str = "auto", advance: Callable[[float], None]) -> TiePoints:
    """Windows of a survey as tie points, after its photographs are loaded."""
    plan = make_plan(survey, Choices(device=device))
    return measure_loaded_windows(survey, plan, *load_photographs(survey, plan), advance)


def load_photographs(survey: Survey, plan: Plan) -> tuple[Block, tuple[float, float]]:
    """The photographs of a survey, and the range of heights over the water plane [m] in which its bed lies."""
    block = load_block(survey, plan, lambda _amount: None)
    try:
        return block, find_range(block, limits(survey))
    except ValueError as error:
        raise SurveyError(str(error)) from error


def measure_loaded_windows(
    survey: Survey,
    plan: Plan,
    block: Block,
    bound: tuple[float, float],
    advance: Callable[[float], None],
    *,
    sparse: bool = False,
) -> TiePoints:
    """Windows of a survey whose photographs are loaded, and of which the range of heights is known.

    ``sparse`` takes fewer windows: as many as means over photographs need.
    """
    ties = measure_tie_points(block, bound, local_area(survey), advance, SPARSE if sparse else DENSE)
    full = [(view.camera, camera_of(view, plan)) for view in survey.views]
    enlarge = np.array([(camera.fx / used.fx, camera.fy / used.fy) for camera, used in full])
    return replace(ties, pixel=ties.pixel * enlarge[ties.view])


@dataclass(frozen=True)
class PreparedImage:
    spline: np.ndarray  # (height, width) float32: coefficients of its cubic spline
    clear: np.ndarray  # (height, width) bool: where samples of a window may lie, away from masked pixels


def prepare_image(image: np.ndarray) -> PreparedImage:
    """Prepare a photograph (height, width) for matching; masked pixels are NaN."""
    masked = ~np.isfinite(image)
    if masked.all():
        return PreparedImage(np.zeros_like(image), ~masked)
    if masked.any():
        # A single NaN would make the whole spline NaN. The value of the nearest pixel causes no ringing at the edge.
        lines, columns = distance_transform_edt(masked, return_distances=False, return_indices=True)
        image = image[lines, columns]
    near = cv2.dilate(masked.astype(np.uint8), np.ones((2 * _CLEAR_PX + 1, 2 * _CLEAR_PX + 1), np.uint8))
    return PreparedImage(spline_filter(image, order=3, output=np.float32), near == 0)


def window() -> tuple[np.ndarray, np.ndarray]:
    """Places x and y of the samples of a window from its middle, (S*S,) each [px]."""
    y, x = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    return x.ravel(), y.ravel()


def match(image: PreparedImage, templates, slopes, expected, offsets) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares matching of K windows in another photograph: positions (K, 2) [px], and which of them match, (K,).

    Templates (K, S*S) and slopes (K, S*S, 2) are the windows and their gradients per pixel along x and y, expected are
    the approximate positions (K, 2) [px] of their middles, offsets (K, 2, S*S) [px] those of their samples from these.
    """
    x, y = window()
    affine = np.einsum("kas,bs->kab", offsets, np.stack([x / (x @ x), y / (y @ y)]))
    centred = templates - templates.mean(axis=1, keepdims=True)
    norm = np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)
    unit = centred / norm
    free = slopes - slopes.mean(axis=1, keepdims=True)
    free = free - unit[..., None] * np.einsum("ks,ksa->ka", unit, free)[:, None]
    hessian = np.einsum("ksa,ksb->kab", free, free)
    inverse = np.linalg.inv(hessian + 1e-6 * np.eye(2))
    at = expected.copy()
    height, width = image.spline.shape
    reach = np.abs(offsets).max(axis=2) + 2.0
    moved = np.full(len(at), np.inf)
    alike = np.full(len(at), -1.0)
    usable = np.isfinite(at).all(axis=1)
    for _ in range(_STEPS):
        inside = (at > reach).all(axis=1) & (at < np.array([width, height]) - reach).all(axis=1)
        usable &= inside & (np.linalg.norm(at - expected, axis=1) < _FARTHEST_PX)
        active = np.nonzero(usable & (moved > _DONE_PX))[0]
        if not len(active):
            break
        # Pixel centres are at 0.5; array indices count from the centre of the first one.
        places = at[active, :, None] - 0.5 + offsets[active]
        values = map_coordinates(image.spline, places[:, ::-1].transpose(1, 0, 2), order=3, prefilter=False)
        values = values.astype(np.float64)
        values = values - values.mean(axis=1, keepdims=True)
        length = np.maximum(np.linalg.norm(values, axis=1), 1e-9)
        alike[active] = np.einsum("ks,ks->k", values, unit[active]) / length
        gain = np.einsum("ks,ks->k", values, unit[active]) / norm[active, 0]
        gain = np.where(np.abs(gain) > 1e-3, gain, 1e-3)
        difference = values / gain[:, None] - centred[active]
        step = np.einsum("kab,ksb,ks->ka", inverse[active], free[active], difference)
        step = np.einsum("kab,kb->ka", affine[active], step)
        at[active] -= step
        moved[active] = np.linalg.norm(step, axis=1)
    found = usable & (moved <= _DONE_PX) & (alike > _ALIKE)
    # All samples of a window, which lie inside the photograph, are to be clear of masked pixels.
    columns, lines = np.floor(at[found][:, :, None] + offsets[found]).astype(int).transpose(1, 0, 2)
    found[found] = image.clear[lines, columns].all(axis=1)
    return at, found
