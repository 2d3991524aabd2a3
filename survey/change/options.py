"""Options of `bathynerf change`."""

# ruff: noqa: RUF009 (calls that make fields)

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from survey.files.foreign import LARGEST
from survey.files.toml_table import option
from survey.words import FILES

_where, _uncertainty, _written = (partial(option, panel) for panel in ("Where", "Uncertainty", FILES))

_LENGTH: dict[str, Any] = {"expected": "metres above 0, e.g. 0.5", "above": 0.0, "most": LARGEST}


@dataclass(frozen=True)
class ChangeOptions:
    """Options of a comparison of two surveys."""

    area: Path | None = _where("FILE", "Polygons in a vector file; default: all in common.")
    stable: Path | None = _where(
        "FILE", "Polygons of unchanged ground, to which the later survey is aligned in height."
    )
    resolution_m: float | None = _where(
        "M", "Side of a cell [m]; default: by the spacing of the points.", name="--resolution", **_LENGTH
    )
    correlation_length_m: float | None = _uncertainty(
        "M", "Correlation length of errors [m]; default: measured.", name="--correlation-length", **_LENGTH
    )
    shared: float = _uncertainty(
        "R",
        "Correlation of the two std_common: 0 independent, 1 with shared level and control.",
        name="--common-correlation",
        default=0.0,
        expected="-1 to 1; 0 where nothing is shared",
        least=-1.0,
        most=1.0,
    )
    std_m: float | None = _uncertainty("M", "std of heights, for clouds without one [m].", name="--std", **_LENGTH)
    std_common_m: float | None = _uncertainty(
        "M",
        "std common to all heights, for clouds without std_common [m].",
        name="--std-common",
        expected="metres, at least 0, e.g. 0.02",
        least=0.0,
        most=LARGEST,
    )
    json_path: Path | None = _written("FILE", "JSON file for the numbers.", name="--json")
    tif_path: Path | None = _written("FILE", "GeoTIFF of differences and detection.", name="--tif")
    picture_path: Path | None = _written("FILE", "PNG of the differences.", name="--picture")
