"""The photographs and height maps of a run as an image-based field, for novel views."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fields.image_based import MAPS as MAPS_OF_A_TILE
from fields.image_based import SOURCES, ImageBasedField, Source, heights_over
from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap, trusted
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, flight_of
from survey.export.orthophoto import exposure_gains
from survey.files.json_values import read_json_object
from survey.photos.images import load_image, load_mask
from survey.run.flight import Flight
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored

# Heights that differ by fewer ground sampling distances are of the same surface.
_TOLERANCE_GSD = 3.0
# Bytes of photographs and maps that are kept at once; those that a tile of a view needs, always.
_MOST_BYTES, _FEWEST = 1_000_000_000, SOURCES + MAPS_OF_A_TILE
# Points of the bed by which exposures are compared.
_COMPARED = 20_000
# Prior of the change of colours with the path: 0 +- 1 per metre, where single colours deviate by 0.1 [m²].
_PRIOR_M2 = 0.1**2


def image_based_field(
    run: LoadedRun, survey: str | None, cameras: Sequence[PinholeCamera], *, dry: bool, advance: Callable[[], object]
) -> ImageBasedField:
    """The photographs of a run as an image-based field, brought to a common exposure, to render cameras, local.

    `survey` names the folder of the survey, if it was moved since the run; `dry` leaves the water out; `advance` is
    called after each of the photographs that are compared.
    """
    flight = flight_of(run, survey)
    mapped, source = _photographs(run, flight)
    points_crs = run.columns("points_crs")["points_crs"]
    points = flight.frame.local_from_crs(points_crs[:: max(len(points_crs) // _COMPARED, 1)])
    load = lru_cache(max(_MOST_BYTES // source(min(mapped)).num_bytes, _FEWEST))(source)
    field = ImageBasedField(
        cameras=[view.camera for view in flight.views],
        water=flight.water,
        load=load,
        mapped=frozenset(mapped),
        height=float(np.median(heights_over(points, flight.water))),
        tolerance=_TOLERANCE_GSD * run.bed_header.gsd_m,
        gains=np.ones((len(flight.views), 3)),
    )
    needed = sorted({number for camera in cameras for number in field.sources_of(camera, dry=dry)})
    gains = field.gains.copy()
    gains[needed] = _gains(field, needed, points, advance)
    return replace(field, gains=gains)


def _photographs(run: LoadedRun, flight: Flight) -> tuple[dict[int, int], Callable[[int], Source]]:
    """The place among the height maps of each view that has one, and the photograph of a number with its map.

    Heights are those of the solver where it has them.
    """
    swept, solved = Stored(run.folder.load_stage("sweep") / MAPS, HeightMap), None
    if "solver" in run.stages:
        solved = Stored(run.folder.load_stage("solver") / SOLVED, SolvedMap)
    scale = float(read_json_object(run.folder.plan_path)["image_scale"])
    mapped = {view: place for place, view in enumerate(swept.views)}
    if not mapped:
        raise SurveyError(f"the run {run.folder.path} has no height maps; run the same `bathynerf process` again")

    def source(number: int) -> Source:
        view, heights = flight.views[number], None
        if number in mapped:
            height_map = swept[mapped[number]]
            confirmed = trusted(height_map)
            if solved is not None:
                height_map, _ = solved[mapped[number]].over(height_map)
            # Maps of smaller photographs are padded.
            small = view.camera.scaled(scale)
            heights = np.where(confirmed, height_map.height, np.float32(np.nan))[: small.height, : small.width]
        return Source(view.camera, load_image(view), load_mask(view), scale, heights)

    return mapped, source


def _gains(
    field: ImageBasedField, numbers: Sequence[int], points: np.ndarray, advance: Callable[[], object]
) -> np.ndarray:
    """Factors (V, 3) that bring photographs to a common exposure, from their colours at points (N, 3), local.

    Attenuation along oblique paths in water is not part of the exposure, and stays."""
    heights = heights_over(points, field.water)
    shown = np.full((len(numbers), len(points), 3), np.nan, dtype=np.float32)
    lengths = np.zeros(shown.shape[:2], dtype=np.float32)
    for row, number in enumerate(numbers):
        source = field.load(number)
        seen = source.observe(points, field.water)
        # Without a map of its own a photograph may show something in front: few points, against a median.
        use = seen.inside & (seen.agrees(heights, field.tolerance) | (source.heights is None))
        shown[row, use] = np.log(np.maximum(source.colours(seen.uv[use]), 1.0))
        if field.water is not None:
            path = source.camera.paths(seen.uv[use].astype(np.float64), field.water)
            length = np.linalg.norm(points[use] - path.crossing, axis=1)
            lengths[row, use] = np.where(heights[use] < 0.0, length, 0.0)
        advance()
    return np.exp(-log_exposures(shown, lengths))


def log_exposures(shown: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Logarithms (V, 3) of the exposures of photographs, after the attenuation by water is taken out."""
    return exposure_gains(shown - attenuation_per_metre(shown, lengths) * lengths[..., None])


def attenuation_per_metre(shown: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Change (3,) [1/m], at most 0, of colours with the lengths of their paths in water.

    From logarithms of the colours (V, K, 3) of K points in V views, NaN where a view does not show a point, over path
    lengths (V, K) [m]. Least squares with unknown colours of points and exposures of views: the regression of colours
    on path lengths after removal of point and view effects from both (Frisch-Waugh-Lovell). Where lengths depend on the
    view alone, exposures explain everything.
    """
    known = np.isfinite(shown[..., 0]).astype(np.float64)
    length = _two_way_residuals(known, lengths)
    change = np.einsum("vk,vkc->c", length, np.nan_to_num(shown)) / (np.sum(length**2) + _PRIOR_M2)
    return np.minimum(change, 0.0)


def _two_way_residuals(known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Residuals (V, K) of values to the least-squares sum of an effect of each view and one of each point.

    Of those that are `known` (1, else 0); 0 elsewhere.
    """
    count = np.maximum(known.sum(axis=0), 1.0)

    def centred(values: np.ndarray) -> np.ndarray:
        return known * (values - (known * values).sum(axis=0) / count)

    residual = centred(values)
    # Normal equations of the views, from which the points are eliminated; singular, since a constant may go to either.
    normal = np.diag(known.sum(axis=1)) - (known / count) @ known.T
    of_view = np.linalg.lstsq(normal, residual.sum(axis=1), rcond=1e-10)[0]
    return residual - centred(of_view[:, None])
