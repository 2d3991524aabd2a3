"""The photographs of a run with their adjusted cameras, water and local frame, stored for later products."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.frames import LocalFrame
from refract import FlatWater
from refract.lens import Lens
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.water.surface import Departure, StillWater

FLIGHT = "flight.json"
_WATER = ("point", "n_water", "slope_x", "slope_y")


@dataclass(frozen=True)
class Flight:
    """Cameras, water and local frame of a run."""

    frame: LocalFrame
    water: FlatWater | None  # Local; None for a dry survey
    views: tuple[View, ...]  # Adjusted, where the run adjusted them
    bounds: tuple[float, float, float, float] | None  # (e0, n0, e1, n1) in crs: the area of interest
    departure: Departure | None = None  # Height of the water over its plane

    def level(self, xy: np.ndarray) -> np.ndarray:
        """Heights (...) [m], local, of the water at places (..., 2); NaN in a dry survey."""
        if self.water is None:
            return np.full(xy.shape[:-1], np.nan)
        level = self.water.height(xy[..., 0], xy[..., 1])
        if self.departure is None:
            return level
        return level + self.departure.at(xy.reshape(-1, 2))[0].reshape(level.shape)


def save_flight(folder: Path, survey: Survey) -> None:
    """Write what `load_flight` reads into the folder of a result."""
    water, departure = survey.water, survey.observations.departure
    views = [
        {
            "name": view.name,
            "image": str(view.path.absolute()),
            "mask": None if view.mask_path is None else str(view.mask_path.absolute()),
            "model": view.lens.model,
            "params": view.lens.params,
            "size_px": [view.lens.width, view.lens.height],
            "centre": view.camera.centre,
            "cam_from_local": view.camera.cam_from_local,
            "motion_m_per_row": view.camera.motion,
            "tide_m": view.camera.tide,
        }
        for view in survey.views
    ]
    record = {
        "crs_wkt": survey.frame.crs.to_wkt(),
        "origin": list(survey.frame.origin),
        "water": None if water is None else {name: getattr(water, name) for name in _WATER},
        "bounds": survey.bounds,
        "departure": None
        if departure is None
        else {"is_still": isinstance(departure, StillWater), "points": departure.points, "stds": departure.stds},
        "views": views,
    }
    write_json(folder / FLIGHT, record)


def load_flight(run: Path) -> Flight:
    """The flight of the result that stands in a run folder."""
    record = read_json_object(run / FLIGHT)
    try:
        water, departure = record["water"], record["departure"]
        if departure is not None:
            kind = StillWater if departure["is_still"] else Departure
            departure = kind(np.array(departure["points"]), np.array(departure["stds"]))
        return Flight(
            LocalFrame(CRS.from_wkt(record["crs_wkt"]), tuple(record["origin"])),
            None if water is None else FlatWater(**{**water, "point": tuple(water["point"])}),
            tuple(_view(entry) for entry in record["views"]),
            None if record["bounds"] is None else tuple(record["bounds"]),
            departure,
        )
    except (KeyError, TypeError, ValueError) as error:
        why = "was made before runs kept their cameras" if not record else f"holds a {FLIGHT} that cannot be read"
        raise SurveyError(f"the run {run} {why}; run the same `bathynerf process` again") from error


def _view(record: dict) -> View:
    lens = Lens(record["model"], tuple(record["params"]), *record["size_px"])
    motion, mask = record["motion_m_per_row"], record["mask"]
    camera = lens.camera(np.array(record["centre"]), np.array(record["cam_from_local"]))
    camera = replace(camera, tide=record["tide_m"], motion=None if motion is None else np.array(motion))
    return View(record["name"], Path(record["image"]), camera, lens, None if mask is None else Path(mask))
