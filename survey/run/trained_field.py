"""A trained radiance field: the recipe and the state on disk from which it is rebuilt and rendered, and that of a run.

That of a run (`process --field`) and those of `bathynerf field` are stored and read alike. A run's is trained in a
layer about the heights of the solver, which is in its state; the box of the others follows from the bed of their run.
"""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from fields.device import choose_device, tensor_place
from fields.image_based import NovelView, heights_over, normals_of
from fields.models import APPEARANCE
from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap, Sources, trusted
from fields.volume.fitted import appearance_vectors
from fields.volume.layer import Layer
from fields.volume.model import Setup, build_model
from fields.volume.nerfacto import Proposal
from fields.volume.paths import Box
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeImage, VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.shell import Shell
from fields.volume.surface import LEAST_OPACITY
from fields.volume.tensor import COLOUR_FIRST
from fields.volume.train import LAST_STEPS, Training, VolumeFigures, psnr_db, train_volume
from fields.water_column import WaterColumn
from geo.files import write_whole
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.plan.area import Area, within
from survey.plan.sweep_block import device_word
from survey.progress import Step
from survey.run.job import Job
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import MAPS
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE
from survey.run.stored_maps import Stored

_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile)
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


@dataclass(frozen=True)
class VolumeRecipe:
    """Settings that determine the parameters of a model and its paths."""

    model: str  # A model of `fields.models`
    # cells, steps, seed: As in `survey.volume.options.VolumeOptions`
    cells: int
    steps: int
    seed: int
    samples: int  # Of each path
    straight: bool = False  # Rays are not bent
    appearance: bool = False  # A vector for each photograph
    shell: bool = False  # A background beyond the box
    # absorption, veil: (3,) floats, optional: of the water, where they are known; see `fields.water_column.WaterColumn`
    absorption: tuple[float, ...] | None = None
    veil: tuple[float, ...] | None = None

    @staticmethod
    def of(settings: dict[str, Any]) -> VolumeRecipe:
        """The recipe among settings; those that are missing have their defaults."""
        names = {each.name for each in fields(VolumeRecipe)}
        return VolumeRecipe(**{name: value for name, value in settings.items() if name in names})

    def renderer(self, box: Box, water: FlatWater | None, photographs: int, device: str) -> VolumeRenderer:
        """The untrained model in a box, with a water column where its rays are bent, ready to be rendered."""
        place, length = choose_device(device), APPEARANCE if self.appearance else 0
        setup = Setup(box, self.cells, place, length, self.steps)
        try:
            model = build_model(self.model, setup, seed=self.seed)
        except (ValueError, TypeError) as error:
            raise SurveyError(f"the model {self.model} cannot be made: {error}") from error
        bent = self.bends(water) is not None
        return VolumeRenderer(
            model,
            column=WaterColumn(self.absorption, self.veil) if bent else None,
            appearance=appearance_vectors(photographs, length) if length else None,
            background=Shell(box, length) if self.shell else None,
            proposal=cast("Proposal | None", model.proposal(setup)),
        ).to(tensor_place(place))

    def bends(self, water: FlatWater | None) -> FlatWater | None:
        """The water at which rays are bent; None where they are straight."""
        return None if self.straight else water

    def restored(self, path: Path, box: Box | None, water: FlatWater | None, device: str) -> RestoredField:
        """The field of the state in a file, in a box or, where that is None, in the layer of the state."""
        state = read_state(path)
        try:
            parameters = state["renderer"]
            if box is None:
                parts: dict[str, Any] = {k: v.numpy() if torch.is_tensor(v) else v for k, v in state["layer"].items()}
                box = Layer(**parts)
            photographs = len(parameters["appearance.weight"]) if self.appearance else 0
            renderer = self.renderer(box, water, photographs, device)
            renderer.load_state_dict(parameters)
            cells = Cells(box, state["occupied"]).to(renderer.model.place)
            return RestoredField(renderer, cells, self, water, int(state["step"]))
        except SurveyError:  # There is no such model: another state would not help.
            raise
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SurveyError(
                f"{path} does not fit its {FIELD_SETTINGS} ({str(error)[:80]}); delete it, and training begins anew"
            ) from error


@dataclass(frozen=True)
class RestoredField:
    """A trained field with all that its rendering needs."""

    renderer: VolumeRenderer
    cells: Cells
    recipe: VolumeRecipe
    water: FlatWater | None  # Of the survey
    step: int  # Steps that its training has done

    def view(self, camera: PinholeCamera, dry: bool, look: int = 0) -> NovelView:
        """View of a camera, with the water or, ``dry``, without it, in the appearance of a photograph by its number."""
        bent, samples = None if dry else self.recipe.bends(self.water), self.recipe.samples
        image = render_volume(self.renderer, camera, bent, self.cells, samples=samples, view=look, dry=dry)
        return novel_view(image, self.water, has_background=self.renderer.background is not None)


def novel_view(seen: VolumeImage, water: FlatWater | None, *, has_background: bool) -> NovelView:
    """A rendered volume as a `NovelView`: heights over the water and normals; without a background black beside it."""
    points = seen.points.astype(np.float64)
    known = np.isfinite(seen.distance) & (seen.opacity > LEAST_OPACITY)
    points[~known] = np.nan
    height = heights_over(points.reshape(-1, 3), water).reshape(known.shape).astype(np.float32)
    is_coloured = (known | has_background)[..., None]
    rgb = np.where(is_coloured, np.round(255.0 * seen.rgb.clip(0.0, 1.0)), 0.0).astype(np.uint8)
    distance = np.where(known, seen.distance, np.nan).astype(np.float32)
    return NovelView(rgb, height, distance, normals_of(points), has_background)


def save_layer_field(folder: Path, field: RestoredField) -> None:
    layer = {each.name: getattr(field.renderer.model.box, each.name) for each in fields(Layer)}
    state = {
        "step": field.step,
        "renderer": field.renderer.state_dict(),
        "occupied": field.cells.occupied,
        "layer": {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in layer.items()},
    }
    with write_whole(folder / FIELD_STATE) as stream:
        torch.save(state, stream)
    write_json(folder / FIELD_SETTINGS, field.recipe)


def load_layer_field(folder: Path, water: FlatWater | None, device: str) -> RestoredField:
    """The field that `save_layer_field` wrote, in the water of its survey."""
    path = folder / FIELD_SETTINGS
    try:
        recipe = VolumeRecipe.of(read_json_object(path))
    except TypeError as error:
        raise SurveyError(
            f"{path} cannot be read ({error}); delete {folder}, and run `bathynerf process` again"
        ) from error
    return recipe.restored(folder / FIELD_STATE, None, water, device)


def read_state(path: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not check the CRC
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        return torch.load(path, weights_only=True, map_location="cpu")
    except _DAMAGE as error:
        raise SurveyError(f"{path} cannot be read ({str(error)[:80]}); delete it, and training begins anew") from error


def train_field(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Train the field on the photographs that have a height map."""
    swept, solved = Stored(needs["sweep"] / MAPS, HeightMap), Stored(needs["solver"] / SOLVED, SolvedMap)
    maps = [of_map.over(height_map)[0] for of_map, height_map in zip(solved, swept, strict=True)]
    plan, sources = job.plan, job.sources(maps)
    with job.progress.stage("Field", 1.0) as stage:
        layer, photographs = layer_about(sources, plan.gsd_m, job.ground)
        steps, rays = steps_for(plan.recipe.rays_per_cell, int(layer.known.sum()))
        known = sources.absorption, sources.veil
        recipe = VolumeRecipe(plan.field, 1, steps, 0, SAMPLES, absorption=known[0], veil=known[1])
        field, figures = fit(layer, photographs, recipe, rays, device_word(plan), reporting(stage, rays))
    job.progress.note(f"field: {figures.psnr_db:.1f} dB after {figures.steps:,} steps")
    save_layer_field(folder, field)


def fit(
    layer: Layer,
    photographs: Photographs,
    recipe: VolumeRecipe,
    rays: int,
    device: str,
    progress: Callable[[float, list[float]], None] = lambda share, errors: None,
) -> tuple[RestoredField, VolumeFigures]:
    """A field by a recipe in a layer, fitted to photographs with so many paths in each step, and its figures."""
    water = cast("FlatWater | None", photographs.water)
    renderer = recipe.renderer(layer, water, len(photographs.cameras), device)
    training = Training(
        steps=recipe.steps,
        rays=rays,
        samples=recipe.samples,
        refresh=(),
        final_rate=FINAL_RATE,
        falls_from=COLOUR_FIRST,
    )
    cells, figures = train_volume(renderer, photographs, training, progress, cells=Cells.everywhere(layer, 1))
    return RestoredField(renderer, cells, recipe, water, recipe.steps), figures


def reporting(stage: Step, rays: int, steps: Iterator[int] | None = None) -> Callable[[float, list[float]], None]:
    """Progress of a training of so many rays a step in a stage whose total is 1, with its error and pace in words.

    ``steps``: numbers from 1 on, of which each step takes one.
    """
    steps = steps or count(1)

    def report(share: float, errors: list[float]) -> None:
        pace = next(steps) * rays / max(stage.seconds, 1e-9)
        last = errors[-LAST_STEPS:]
        detail = f"squared error {sum(last) / len(last):.2g}, {psnr_db(last):.1f} dB, {pace:,.0f} rays/s"
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
    xyz, direction = torch.from_numpy(own.xyz), torch.from_numpy(own.direction)
    moved = layer.meeting_near(xyz, direction)
    is_inside = (moved * direction[:, 2]).abs() < INSIDE * layer.half
    is_inside &= layer.holds(xyz + moved[:, None] * direction)
    return own.length + moved.numpy(), is_inside.numpy()
