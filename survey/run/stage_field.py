"""Two optional stages, by torch: the absorption of the water, where survey.toml does not say it, and a field for views.

The field is a radiance field in a layer about the heights of the solver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap, Sources, trusted
from survey.errors import Findings, SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.plan.area import within
from survey.plan.sweep_block import device_word
from survey.progress import Step
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored

if TYPE_CHECKING:
    from fields.volume.layer import Layer
    from fields.volume.photographs import Photographs
    from fields.volume.train import VolumeFigures
    from refract import FlatWater, PinholeCamera
    from survey.plan.area import Area
    from survey.run.job import Job
    from survey.run.stored_field import RestoredField

COLOUR_FILE = "water_colour.json"
# Of each path inside the layer: the paper samples within +-s of the proxy surface.
SAMPLES = 8
# Half of the layer: so many cells, or so many times the median spread of the heights where that is more.
HALF_CELLS, HALF_SPREADS = 2.0, 3.0
# A pixel is used if its own height lies within this share of half of the layer.
INSIDE = 0.7
# Learning rates fall to this share of their start.
FINAL_RATE = 0.05
# Paths of a step: the more, the larger the layer, and fewer where there are not enough for this many steps.
BATCH, LARGE_BATCH, SMALL_BATCH, LARGE_LAYER, LEAST_STEPS = 16384, 65536, 2048, 500_000, 300


def train_field(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Train the field on the photographs that have a height map."""
    # Imported where it is needed, as below: it takes torch, whose import takes seconds.
    from survey.run.stored_field import save_layer_field

    swept, solved = Stored(needs["sweep"] / MAPS, HeightMap), Stored(needs["solver"] / SOLVED, SolvedMap)
    maps = [of_map.over(height_map)[0] for of_map, height_map in zip(solved, swept, strict=True)]
    with job.progress.stage("Field", 1.0) as stage:
        field, figures = trained(job, maps, stage)
    job.progress.note(f"field: {figures.psnr_db:.1f} dB after {figures.steps:,} steps")
    save_layer_field(folder, field)


def trained(job: Job, maps: Sequence[HeightMap], stage: Step) -> tuple[RestoredField, VolumeFigures]:
    """The field about heights, and the figures of its training; errors as `layer_about`."""
    plan, sources = job.plan, job.sources(maps)
    layer, photographs = layer_about(sources, plan.gsd_m, job.ground)
    steps, rays = steps_for(plan.recipe.rays_per_cell, int(layer.known.sum()))
    given = {"absorption": sources.absorption, "veil": sources.veil}
    return fit(layer, photographs, plan.field, steps, rays, device_word(plan), reporting(stage, rays), given)


def fit(
    layer: Layer,
    photographs: Photographs,
    model: str,
    steps: int,
    rays: int,
    device: str,
    progress: Callable[[float, list[float]], None] = lambda share, errors: None,
    given: dict[str, Any] | None = None,
) -> tuple[RestoredField, VolumeFigures]:
    """A field of a model in a layer, fitted to photographs in so many steps of so many paths, and its figures.

    ``given`` are absorption and veil of the water, where they are known.
    """
    from fields.volume.sampling import Cells
    from fields.volume.tensor import COLOUR_FIRST
    from fields.volume.train import Training, train_volume
    from survey.run.stored_field import RestoredField, VolumeRecipe

    water = cast("FlatWater | None", photographs.water)
    recipe = VolumeRecipe(model, 1, steps, seed=0, samples=SAMPLES, **(given or {}))
    renderer = recipe.renderer(layer, water, len(photographs.cameras), device)
    training = Training(
        steps=steps, rays=rays, samples=SAMPLES, refresh=(), final_rate=FINAL_RATE, falls_from=COLOUR_FIRST
    )
    cells, figures = train_volume(renderer, photographs, training, progress, cells=Cells.everywhere(layer, 1))
    return RestoredField(renderer, cells, recipe, water, steps), figures


def reporting(stage: Step, rays: int) -> Callable[[float, list[float]], None]:
    """Progress of a training of so many rays a step in a stage whose total is 1, with its error and pace in words."""
    from fields.volume.train import LAST_STEPS, psnr_db

    steps = count(1)

    def report(share: float, errors: list[float]) -> None:
        pace = next(steps) * rays / max(stage.seconds, 1e-9)
        detail = f"{psnr_db(errors[-LAST_STEPS:]):.1f} dB, {pace:,.0f} rays/s"
        stage.advance(share - stage.done, detail=detail)

    return report


def steps_for(rays_per_cell: float, cells: int) -> tuple[int, int]:
    """Steps, and paths of each, for a number of known cells."""
    rays = rays_per_cell * cells
    batch = LARGE_BATCH if cells >= LARGE_LAYER else BATCH
    batch = min(batch, max(int(np.ceil(rays / LEAST_STEPS)), SMALL_BATCH))
    return max(int(np.ceil(rays / batch)), LEAST_STEPS), batch


def layer_about(sources: Sources, gsd: float, ground: Area | None) -> tuple[Layer, Photographs]:
    """The layer about the trusted heights over an area (x0, y0, x1, y1) [m], in cells of one GSD, and its photographs.

    Of the photographs count the pixels whose own height lies in it.
    """
    from fields.volume.layer import Layer
    from fields.volume.photographs import Photographs

    found = [_trusted_points(*each, sources.water) for each in zip(sources.cameras, sources.maps, strict=True)]
    if ground is not None:
        found = [each[within(each.xyz, ground)] for each in found]
    points, spreads = (np.concatenate([getattr(each, name) for each in found]) for name in ("xyz", "spread"))
    if not len(points):
        raise SurveyError("no confirmed height lies inside the area: a field has nothing to train on")
    layer = Layer.of_points(points, gsd, max(HALF_CELLS * gsd, HALF_SPREADS * float(np.median(spreads))))
    pixels, starts = [], []
    for each in found:
        start, is_inside = _meetings(each, layer)
        pixels.append(each.flat[is_inside])
        starts.append(start[is_inside])
    return layer, Photographs(sources.cameras, sources.images, pixels, sources.water, starts=starts)


@dataclass(frozen=True)
class _OwnPoints:
    """Points (n) of pixels of a height map, and the paths on which they lie."""

    flat: np.ndarray  # (n,): index of the pixel in its image
    xyz: np.ndarray  # (n, 3) float32 [m], local
    direction: np.ndarray  # (n, 3) float32 unit: of travel, in the medium of the point
    length: np.ndarray  # (n,) float32 [m]: of the path from the camera
    spread: np.ndarray  # (n,) [m]: of the heights that agree

    def __getitem__(self, keep: np.ndarray) -> _OwnPoints:
        return _OwnPoints(*(getattr(self, each.name)[keep] for each in fields(self)))


def _trusted_points(camera: PinholeCamera, height_map: HeightMap, water: FlatWater | None) -> _OwnPoints:
    keep = trusted(height_map)[: camera.height, : camera.width]
    path = camera.paths(camera.pixel_centres()[keep], water)
    rows, columns = np.nonzero(keep)
    xyz = path.at_height(height_map.height[rows, columns].astype(np.float64), water)
    in_water = path.wet & (((xyz - path.crossing) * path.water_direction).sum(axis=1) > 0.0)
    from_crossing = np.linalg.norm(path.crossing - path.origin, axis=1) + np.linalg.norm(xyz - path.crossing, axis=1)
    length = np.where(in_water, from_crossing, np.linalg.norm(xyz - path.origin, axis=1))
    direction = np.where(in_water[:, None], path.water_direction, path.air_direction)
    xyz, direction, length = (each.astype(np.float32) for each in (xyz, direction, length))
    return _OwnPoints(np.flatnonzero(keep), xyz, direction, length, height_map.spread[rows, columns])


def _meetings(own: _OwnPoints, layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """Path lengths (n,) [m] at which paths meet the bed of a layer, and which of their points lie in it, (n,) bool."""
    import torch

    xyz, direction = torch.from_numpy(own.xyz), torch.from_numpy(own.direction)
    moved = layer.meeting_near(xyz, direction)
    is_inside = (moved * direction[:, 2]).abs() < INSIDE * layer.half
    is_inside &= layer.holds(xyz + moved[:, None] * direction)
    return own.length + moved.numpy(), is_inside.numpy()


def estimate_colour(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Estimate the absorption of the water from the photographs that have a height map."""
    # Imported where it is needed: it takes torch, whose import takes seconds.
    from fields.colour.true_colour import estimate_absorption

    with job.progress.stage("Water colour"):
        try:
            absorption = estimate_absorption(job.sources(Stored(needs["sweep"] / MAPS, HeightMap)))
        except ValueError as error:
            raise SurveyError(
                f"the absorption of the water cannot be estimated from the photographs: {error}; give [water] "
                "absorption_per_m and veiling_light in survey.toml, or leave --true-colour out"
            ) from error
        write_json(folder / COLOUR_FILE, {"absorption_per_m": absorption})


def use_colour(job: Job, folder: Path) -> None:
    """Give the job's survey the absorption that was found, and no veiling light."""
    red, green, blue = read_json_object(folder / COLOUR_FILE)["absorption_per_m"]
    _, given = job.survey.require_water()
    water = replace(given, absorption_per_m=(red, green, blue), veiling_light=(0.0, 0.0, 0.0))
    listed = ", ".join(f"{a:.3f}" for a in (red, green, blue))
    note = f"absorption_per_m = [{listed}], from the photographs, and no veiling_light"
    findings = job.survey.findings + Findings(assumptions=(note,))
    job.survey = replace(job.survey, config=replace(job.survey.config, water=water), findings=findings)
    job.progress.detail(f"water colour: {note}")
