"""The photographs of a run with its cameras and its water, for products that are made of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from refract import PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.photos.cameras import View
from survey.photos.images import load_image, load_mask
from survey.run.flight import Flight


@dataclass(frozen=True)
class Photograph:
    """Photograph as a product uses it."""

    view: View
    camera: PinholeCamera  # At the scale
    scale: float  # [-]: at most 1

    def pixels(self) -> Pixels:
        """The photograph, decoded."""
        return Pixels(load_image(self.view, scale=self.scale), load_mask(self.view, scale=self.scale))


@dataclass(frozen=True)
class Pixels:
    """A decoded photograph."""

    rgb: np.ndarray  # (height, width, 3) uint8
    mask: np.ndarray | None  # (height, width) bool or None: where it may be used; None for everywhere

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Colours (rows, columns, 3) float64, 0 to 255, at places [px]; NaN where these are NaN or masked."""
        seen = np.isfinite(u)
        # OpenCV counts from the centre of the first pixel.
        x, y = (np.where(seen, place, 0.0).astype(np.float32) - np.float32(0.5) for place in (u, v))
        colour = cv2.remap(self.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        if self.mask is not None:
            height, width = self.mask.shape
            rows, columns = (np.clip(np.round(at), 0, n - 1).astype(np.int64) for at, n in ((y, height), (x, width)))
            seen = seen & self.mask[rows, columns]
        return np.where(seen[..., None], colour, np.nan)


def at_scale(flight: Flight, scale: float) -> list[Photograph]:
    """The photographs of a flight at a scale of at most 1."""
    return [Photograph(v, v.camera if scale == 1.0 else v.camera.scaled(scale), scale) for v in flight.views]


def colours_without_water(run: LoadedRun) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None:
    """Colours (N, 3), 0 to 255, without the water, by depth (N,) [m] and incidence (N,) [rad] in air.

    None where the run's own points have the colours that photographs show.
    """
    water = run.config.water
    if not run.is_true_colour or water is None or water.refractive_index is None:
        return None
    # Imported where they are needed: they take torch.
    from fields.colour.true_colour import stored_colours, without_water
    from fields.water_column import WaterColumn

    column, n_water = WaterColumn(water.colour.absorption_per_m, water.colour.veiling_light), water.refractive_index
    return lambda rgb, depth, incidence: stored_colours(without_water(rgb, depth, incidence, n_water, column))


def flight_of(run: LoadedRun, folder: str | None) -> Flight:
    """The flight as the run used it, its photographs where they are now if the folder of the survey is named.

    Raises
    ------
    SurveyError
        If the run was made before runs kept their cameras, a photograph is not there, or is another one.
    """
    flight = run.flight
    views = flight.views
    if folder is not None:
        views = tuple(_elsewhere(view, Path(folder), run.config.images.dir) for view in views)
    owner = run.folder.owner()
    for view in views:
        if not view.path.is_file():
            raise SurveyError(
                f"the photograph {view.path} is not there any more; name the folder of the survey with --survey DIR"
            )
        if owner is not None:
            owner.require_unchanged(view.name, view.path)
    return replace(flight, views=views)


def survey_folder(run: LoadedRun, folder: str | None) -> Path:
    """The folder of a run's survey: the one that is named, or where it lay when the run was made.

    Raises
    ------
    SurveyError
        If none is named, and the place of the photographs does not tell it.
    """
    if folder is not None:
        return Path(folder)
    images = run.config.images.dir
    if Path(images).is_absolute():
        raise SurveyError(f"the photographs lie in {images}, apart from the survey; name its folder with --survey DIR")
    return _folder_of(run.flight.views[0], images)


def _folder_of(view: View, images: str) -> Path:
    return view.path.parents[len(Path(images, view.name).parts) - 1]


def _elsewhere(view: View, folder: Path, images: str) -> View:
    """A view whose survey folder lies elsewhere now."""
    before = _folder_of(view, images)
    mask = view.mask_path
    if mask is not None and mask.is_relative_to(before):
        mask = folder / mask.relative_to(before)
    return replace(view, path=folder / images / view.name, mask_path=mask)
