"""What `bench_survey_field.py` measures: masts apart from the bed, and held-out views over water pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates, percentile_filter
from scipy.spatial import cKDTree
from study_protocol import tops

from evaluation import distance_statistics, distance_to_mesh, image_quality, is_reached, psnr
from evaluation.images.inputs import largest_rectangle
from geo import read_cloud, read_reference
from refract import FlatWater, PinholeCamera
from survey.folder.survey import Survey, View, load_image, load_mask
from survey.plan.area import local_area, within
from survey.simulate.ground.shapes import TriangleMesh

# Neighbouring pixels whose points are further apart along the path than this many times their distance across it: a
# surface that rises by 79 degrees from the picture, or a step.
STEP = 5.0
REACH_PX = 5
FEW = 3
# A place is hidden from a photograph that sees something this much nearer [m]; its distances are known at every so many
# pixels.
HIDDEN_M, STRIDE = 0.05, 4
TOLERANCES_M = (0.05, 0.2)
# A point belongs to a mast if it rises this far above what covers a quarter of the disc of this diameter around it, in
# a raster of these cells: a deck beside the side of a hull does, and the top of a mast does not.
RISE_M, WIDE_M, CELL_M, COVERED = 0.5, 1.5, 0.1, 0.25
# Sightings are counted at one pixel in so many each way.
THINNED = 4
# The shortest side of an image that allows five scales.
SMALLEST_PX = 176


def true_points(
    camera: PinholeCamera, water: FlatWater | None, surface: TriangleMesh, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (rows, columns) [m] and points (rows, columns, 3) of one pixel in so many each way; NaN for none."""
    pixels = camera.pixel_centres()[stride // 2 :: stride, stride // 2 :: stride]
    flat = pixels.reshape(-1, 2)
    origin, direction = camera.centres(flat), camera.directions(flat)
    origin = np.broadcast_to(origin, direction.shape)
    before = np.full(len(flat), np.inf)
    if water is not None:
        paths = camera.paths(flat, water)
        before = np.where(paths.wet, paths.air_length, np.inf)
    distance, _ = surface.hit(origin, direction, before)
    points = origin + np.where(np.isfinite(distance), distance, np.nan)[:, None] * direction
    under = np.flatnonzero(~np.isfinite(distance) & np.isfinite(before))
    if under.size and water is not None:
        start, bent = paths.crossing[under], paths.water_direction[under]
        further, _ = surface.hit(start, bent, np.full(len(under), np.inf))
        points[under] = start + np.where(np.isfinite(further), further, np.nan)[:, None] * bent
        distance[under] = before[under] + further
    distance = np.where(np.isfinite(distance), distance, np.nan)
    return distance.reshape(pixels.shape[:2]), points.reshape(*pixels.shape[:2], 3)


def near_steps(distance: np.ndarray, focal_px: float, reach_px: int = REACH_PX) -> np.ndarray:
    """Which pixels (height, width) lie within ``reach_px`` of a step between neighbours."""
    step = np.zeros(distance.shape, dtype=bool)
    for before, after in (((slice(None), slice(-1)), (slice(None), slice(1, None))),
                          ((slice(-1), slice(None)), (slice(1, None), slice(None)))):  # fmt: skip
        near, far = distance[before], distance[after]
        jump = np.abs(far - near) > STEP * np.fmin(near, far) / focal_px
        step[before] |= jump
        step[after] |= jump
    return step if not step.any() else distance_transform_edt(~step) <= reach_px


def sightings(
    points: np.ndarray, cameras: Sequence[PinholeCamera], water: FlatWater | None, surface: TriangleMesh
) -> np.ndarray:
    """How many cameras see each of points (..., 3)."""
    flat, count = points.reshape(-1, 3), np.zeros(points[..., 0].size, dtype=int)
    known = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for camera in cameras:
        pixels = camera.project(flat[known], water)
        inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        rows = known[inside]
        if not rows.size:
            continue
        seen, _ = true_points(camera, water, surface, STRIDE)
        at = (pixels[inside].T[::-1] - 0.5 - STRIDE // 2) / STRIDE
        found = map_coordinates(seen, at, order=1, mode="nearest")
        count[rows] += found > _distances(camera, water, flat[rows]) - HIDDEN_M
    return count.reshape(points.shape[:-1])


def _distances(camera: PinholeCamera, water: FlatWater | None, points: np.ndarray) -> np.ndarray:
    """Path lengths (N,) [m] from a camera to points (N, 3) [m] that it sees."""
    if water is None:
        return np.linalg.norm(points - camera.centre, axis=1)
    paths = camera.paths(camera.project(points, water), water)
    return np.where(
        paths.wet,
        paths.air_length + np.linalg.norm(points - paths.crossing, axis=1),
        np.linalg.norm(points - camera.centre, axis=1),
    )


def is_mast(points: np.ndarray) -> np.ndarray:
    """Which points (N, 3) [m] of a surface, local, belong to masts, yards and other narrow objects: (N,) bool."""
    top, row, column = tops(points, CELL_M)
    nearest = distance_transform_edt(np.isinf(top), return_distances=False, return_indices=True)
    across = np.arange(-int(WIDE_M / CELL_M / 2), int(WIDE_M / CELL_M / 2) + 1)
    disc = np.add.outer(across**2, across**2) <= (WIDE_M / CELL_M / 2) ** 2
    around = percentile_filter(top[tuple(nearest)], 100.0 * (1.0 - COVERED), footprint=disc)
    return points[:, 2] - around[row, column] > RISE_M


def cloud_figures(cloud: Path, reference: Path, visible: Path, survey: Survey) -> dict:
    """Completeness over what cameras see, and the distances of the cloud from the truth, with masts apart."""
    frame, area = survey.frame, local_area(survey)
    points = frame.local_from_crs(read_cloud(cloud).points)
    mesh, seen = read_reference(reference), frame.local_from_crs(read_reference(visible).points)
    mast = is_mast(seen)
    figures = {"points": len(points), "mast_share": float(mast.mean())}
    for tolerance in TOLERANCES_M:
        reached = is_reached(seen, points, tolerance_m=tolerance)
        for name, part in (("all", np.ones(len(seen), bool)), ("bed", ~mast), ("masts", mast)):
            figures[f"complete_{name}_{tolerance}"] = float(reached[part].mean()) if part.any() else None
    inside = points[within(points, area)] if area is not None else points
    distances = distance_to_mesh(inside, frame.local_from_crs(mesh.vertices), mesh.faces).signed
    of_mast = mast[cKDTree(seen).query(inside, workers=-1)[1]]
    for name, part in (("all", np.ones(len(inside), bool)), ("bed", ~of_mast), ("masts", of_mast)):
        numbers = distance_statistics(distances[part])
        figures |= {f"mean_{name}": numbers.mean_inner90_m, f"std_{name}": numbers.std_inner90_m}
    return figures


def water_pixels(survey: Survey, view: View, deepest_m: float) -> np.ndarray:
    """Pixels (height, width) whose path lies over the bounds of the survey from the surface down to the deepest bed.

    Independent of the rendering, so that pixels it leaves black count.
    """
    path = view.camera.paths(view.camera.pixel_centres(), survey.water)
    area = local_area(survey)
    held = np.ones(path.wet.shape, dtype=bool)
    for height in (0.0, -deepest_m):
        at = path.at_height(np.full(held.shape, height), survey.water)
        held &= within(at.reshape(-1, 3), area).reshape(held.shape)
    mask = load_mask(view)
    return held if mask is None else held & mask


def view_figures(survey: Survey, view: View, picture: Path, deepest_m: float, weights: dict) -> dict:
    """Image quality of one rendered view over its water pixels; what needs a rectangle only where there is one."""
    with Image.open(picture) as image:
        rendered = np.asarray(image)
    photograph, found = load_image(view) / 255.0, rendered[..., :3] / 255.0
    mask, seen = water_pixels(survey, view, deepest_m), rendered[..., 3] > 0
    if not (mask & seen).any():
        return {"image": view.name, "pixels": 0}
    figures = {"image": view.name, "pixels": int(mask.sum()), "unseen_share": float((mask & ~seen).sum() / mask.sum())}
    figures["psnr_seen_db"] = psnr(photograph, found, mask & seen)
    rows, columns = largest_rectangle(mask)
    if min(rows.stop - rows.start, columns.stop - columns.start) < SMALLEST_PX:
        return figures | {"psnr_db": psnr(photograph, found, mask)}
    figures["rectangle_px"] = [columns.stop - columns.start, rows.stop - rows.start]
    return figures | image_quality(photograph, found, mask=mask, **weights)


def with_steps(
    figures: list[dict], survey: Survey, kept: list[View], reference: Path, pictures: Path, deepest_m: float
) -> None:
    """Add the PSNR [dB] beside steps of depth, away from them, and where few of the kept photographs see a place.

    Sightings are counted at one pixel in `THINNED` each way.
    """
    mesh = read_reference(reference)
    surface = TriangleMesh(survey.frame.local_from_crs(mesh.vertices), mesh.faces)
    by_name, cameras, some = {view.name: view for view in survey.views}, [view.camera for view in kept], []
    for each in (f for f in figures if f["pixels"]):
        view = by_name[each["image"]]
        with Image.open((pictures / view.name).with_suffix(".png")) as image:
            found = np.asarray(image)[..., :3] / 255.0
        photograph, mask = load_image(view) / 255.0, water_pixels(survey, view, deepest_m)
        distance, points = true_points(view.camera, survey.water, surface)
        beside, known = near_steps(distance, view.camera.fx), mask & np.isfinite(distance)
        for name, part in (("steps", known & beside), ("away", known & ~beside)):
            _add(each, name, photograph, found, known, part)
        thin = (slice(None, None, THINNED), slice(None, None, THINNED))
        some.append((each, photograph[thin][known[thin]], found[thin][known[thin]], points[thin][known[thin]]))
    if not some:
        return
    # Distances from all cameras are found once for all views.
    count = sightings(np.concatenate([points for *_, points in some]), cameras, survey.water, surface)
    ends = np.cumsum([len(points) for *_, points in some])[:-1]
    for (each, photograph, found, _), seen in zip(some, np.split(count, ends), strict=True):
        _add(each, "few", photograph, found, np.ones(len(seen), dtype=bool), seen <= FEW)


def _add(
    figures: dict, name: str, photograph: np.ndarray, found: np.ndarray, known: np.ndarray, part: np.ndarray
) -> None:
    figures[f"{name}_share"] = float(part.sum() / max(known.sum(), 1))
    if part.any():
        # As a picture of one row.
        figures[f"psnr_{name}_db"] = psnr(photograph[part][None], found[part][None])


def summary(views: list[dict]) -> dict:
    """Means over images, and the PSNR [dB] of all water pixels together."""
    views = [v for v in views if v["pixels"] > 0]
    names = sorted({k for v in views for k in v} - {"image", "pixels", "rectangle_px"})
    means = {name: float(np.mean([v[name] for v in views if name in v])) for name in names}
    count = np.array([v["pixels"] for v in views])
    mse = np.array([10.0 ** (-0.1 * v["psnr_db"]) for v in views])
    return {"images": len(views), **means, "psnr_pooled_db": float(-10.0 * np.log10((count * mse).sum() / count.sum()))}
