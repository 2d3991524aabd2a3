"""A trained field on disk: written whole, read back bit for bit."""

from __future__ import annotations

import dataclasses
import json
import pickle
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from pyproj import CRS

from fields.device import Device
from fields.slab.rays import Slab
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.water_column import WaterColumn
from geo.files import write_whole
from geo.frames import LocalFrame
from refract import FlatWater
from survey.errors import SurveyError
from survey.run.stored import FIELD_FILE, FIGURES_FILE, PLACE_FILE

if TYPE_CHECKING:
    from fields.slab.tensor_field import FieldFigures

_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile)


def save_field(folder: Path, field: TensorField, figures: FieldFigures) -> None:
    """Write a field and the figures of its training into the folder of its stage."""
    slab = {f.name: getattr(field.slab, f.name) for f in dataclasses.fields(Slab)}
    stored = {
        "state": field.state_dict(),
        "slab": {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in slab.items()},
        "settings": dataclasses.asdict(field.settings),
        "is_fine": field.density.is_fine,
        "water": field.column is not None,
        "given": {} if field.column is None else field.column.given(),
    }
    with write_whole(folder / FIELD_FILE) as stream:
        torch.save(stored, stream)
    with write_whole(folder / FIGURES_FILE) as stream:
        stream.write(json.dumps(dataclasses.asdict(figures), indent=2).encode())


def load_field(folder: Path, device: Device) -> TensorField:
    """The field that `save_field` wrote.

    Raises
    ------
    SurveyError
        If the file is missing or damaged.
    """
    path = folder / FIELD_FILE
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not check the CRC
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} is damaged")
        stored = torch.load(path, weights_only=True)
        parts: dict[str, Any] = {k: v.numpy() if torch.is_tensor(v) else v for k, v in stored["slab"].items()}
        slab = Slab(**parts)
        # A field of version 0.1 has nothing given.
        column = WaterColumn(**stored.get("given", {})) if stored["water"] else None
        field = TensorField(slab, FieldSettings(**stored["settings"]), device, column)
        field.load_state_dict(stored["state"])
    except _DAMAGE as error:
        raise SurveyError(
            f"{path} cannot be read ({error}); delete its folder and run `bathynerf process` again"
        ) from error
    field.density.is_fine = stored["is_fine"]
    return field


def save_place(folder: Path, frame: LocalFrame, water: FlatWater | None) -> None:
    """Write where the local frame of a field lies and what water it saw through."""
    optics = None
    if water is not None:
        names = ("point", "n_water", "slope_x", "slope_y")
        optics = {name: getattr(water, name) for name in names}
    place = {"crs": frame.crs.to_wkt(), "origin": frame.origin, "water": optics}
    with write_whole(folder / PLACE_FILE) as stream:
        stream.write(json.dumps(place, indent=2).encode())


def load_place(folder: Path) -> tuple[LocalFrame, FlatWater | None]:
    """The frame and the water that `save_place` wrote.

    Raises
    ------
    SurveyError
        If the file is missing or damaged.
    """
    path = folder / PLACE_FILE
    try:
        place = json.loads(path.read_text(encoding="utf-8"))
        water = None if place["water"] is None else FlatWater(**place["water"])
        return LocalFrame(CRS.from_wkt(place["crs"]), tuple(place["origin"])), water
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SurveyError(
            f"{path} cannot be read ({error}); delete its folder and run `bathynerf process` again"
        ) from error
