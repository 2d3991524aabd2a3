"""A trained radiance field on disk: the recipe and the state from which it is rebuilt and rendered.

That of a run (`process --field`) and those of `bathynerf field` are stored and read alike. A run's has its layer in the
state; the box of the others follows from the bed of their run.
"""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from fields.device import choose_device, tensor_place
from fields.image_based import NovelView, heights_over, normals_of
from fields.models import APPEARANCE
from fields.volume.fitted import appearance_vectors
from fields.volume.layer import Layer
from fields.volume.model import Setup, build_model
from fields.volume.paths import Box
from fields.volume.renderer import VolumeImage, VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.shell import Shell
from fields.volume.surface import LEAST_OPACITY
from fields.water_column import WaterColumn
from geo.files import write_whole
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE

if TYPE_CHECKING:
    from fields.volume.nerfacto import Proposal

_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile)


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
            background=Shell(box) if self.shell else None,
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
    """Write a field in a layer into a folder."""
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
    """The saved state of a training."""
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not check the CRC
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        return torch.load(path, weights_only=True, map_location="cpu")
    except _DAMAGE as error:
        raise SurveyError(f"{path} cannot be read ({str(error)[:80]}); delete it, and training begins anew") from error
