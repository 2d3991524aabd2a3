"""The photographs of a run with its cameras and its water, for products that are made of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from survey.adjust.adjustment import JSON, read_adjustment
from survey.adjust.refine import apply_adjustment
from survey.errors import FILE_NAME, SurveyError
from survey.export.loaded import LoadedRun
from survey.folder.survey import View, load_survey
from survey.photos.images import load_image, load_mask


@dataclass(frozen=True)
class Photograph:
    """One photograph as a product uses it.

    Attributes
    ----------
    view : View
    camera : PinholeCamera
        At the scale.
    scale : [-]
        At most 1.
    """

    view: View
    camera: PinholeCamera
    scale: float

    def pixels(self) -> Pixels:
        """The photograph, decoded."""
        return Pixels(load_image(self.view, scale=self.scale), load_mask(self.view, scale=self.scale))


@dataclass(frozen=True)
class Pixels:
    """A decoded photograph.

    Attributes
    ----------
    rgb : (height, width, 3) uint8
    mask : (height, width) bool or None
        Where it may be used; None for everywhere.
    """

    rgb: np.ndarray
    mask: np.ndarray | None

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


@dataclass(frozen=True)
class Photographs:
    """What a run was made from.

    Attributes
    ----------
    frame : LocalFrame
    views : tuple of View
        With the poses and lenses of the run's adjustment, where it had one.
    water : FlatWater or None
    """

    frame: LocalFrame
    views: tuple[View, ...]
    water: FlatWater | None

    def at_scale(self, scale: float) -> list[Photograph]:
        """The photographs at a scale of at most 1."""
        return [Photograph(v, v.camera if scale == 1.0 else v.camera.scaled(scale), scale) for v in self.views]


def photographs_of(run: LoadedRun, folder: str | None) -> Photographs:
    """The photographs of the survey in a folder, or of the one that the run lies in.

    Raises
    ------
    SurveyError
        If there is no survey, or it is not the one that the run was made from.
    """
    place = run.folder.path.absolute().parent if folder is None else Path(folder)
    if folder is None and not (place / FILE_NAME).is_file():
        raise SurveyError(f"{run.folder.path} does not lie in a survey; name the survey's folder with --survey DIR")
    survey = load_survey(place, workspace=run.folder.sfm_path)
    if (run.folder.path / JSON).is_file():
        found = read_adjustment(run.folder.path)
        if len(found.centres) != len(survey.views):
            raise _another(run, place, f"{len(survey.views)} photographs, not {len(found.centres)}")
        survey = apply_adjustment(survey, found)
    if not survey.frame.crs.equals(run.place.crs) or survey.name != run.place.name:
        raise _another(run, place, f'the name "{survey.name}" and the CRS {survey.frame.crs.name}')
    return Photographs(survey.frame, survey.views, survey.water)


def _another(run: LoadedRun, place: Path, said: str) -> SurveyError:
    return SurveyError(
        f"{place} has {said}: {run.folder.path} was not made from this survey; name its own with --survey DIR"
    )
