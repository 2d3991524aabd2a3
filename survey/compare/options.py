"""Options of `bathynerf compare` and `change`, and their checks."""

# ruff: noqa: RUF009 (calls that make fields)

import importlib.util
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from survey.errors import SurveyError
from survey.files.toml_table import option, require_options
from survey.words import COMPARED, FILES, LARGEST

Bounds = tuple[float, float, float, float]
_measured, _compared, _written = (partial(option, panel) for panel in ("What is measured", COMPARED, FILES))
_where, _uncertainty = partial(option, "Where"), partial(option, "Uncertainty")

_LENGTH: dict[str, Any] = {"expected": "metres above zero, e.g. 0.2", "above": 0.0, "most": LARGEST}


class CompareError(SurveyError):
    """Two data sets that cannot be compared, or an option whose value makes no sense."""


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison."""

    # [m]; the first is that of the keys at the top
    tolerances_m: tuple[float, ...] = _measured(
        "M", "For completeness and F-score [m]; repeatable.", name="--tolerance", default=(0.2,), **_LENGTH
    )
    # See `evaluation.distance_to_mesh`
    sign: str = _measured(
        None, "Positive above, or on the front of a face by its winding.", default="up", one_of=("up", "winding")
    )
    # See `survey.compare.measure`
    checkpoints: Path | None = _measured(
        "FILE", "Check points: CSV (easting, northing, height, sigma if known) or ICESat-2 ATL24."
    )
    c2c: bool = _measured(None, "Also cloud-to-cloud distances, both ways.", name="--c2c", default=False)
    # See `evaluation.m3c2_distances`
    m3c2_radius_m: float | None = _measured(
        "RADIUS", "Also M3C2 distances, with this cylinder radius [m].", name="--m3c2", **_LENGTH
    )
    visible: Path | None = _compared("FILE", "Points of the reference that cameras see.")
    bounds: Bounds | None = _compared("E0 N0 E1 N1", "Crop the cloud to these bounds.")
    # Depths are then taken from the reference alone
    water_level: float | None = _compared(
        "HEIGHT",
        "Water level in the CRS; default: that of the cloud.",
        expected="a height in the CRS of the cloud",
        least=-LARGEST,
        most=LARGEST,
    )
    # See `evaluation.is_outlier`
    outliers: str | None = _compared("sor:K,S", "Remove statistical outliers; default: keep all.")
    json_path: Path | None = _written("FILE", "JSON file for the numbers.", name="--json")
    report_dir: Path | None = _written("DIR", "Folder for pictures.", name="--report")


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


def check_options(options: CompareOptions) -> None:
    """Raise SurveyError if the value of an option is invalid, or needs a package that is not installed."""
    if not options.tolerances_m:
        raise CompareError("--tolerance has no value, expected at least one in metres, e.g. 0.2")
    require_options(options)
    check_bounds(options.bounds)
    if options.outliers is not None:
        outlier_filter(options.outliers)
    if options.m3c2_radius_m is not None and importlib.util.find_spec("py4dgeo") is None:
        raise CompareError("--m3c2 needs py4dgeo, which is not installed: pip install 'bathynerf[m3c2]'")


def check_bounds(bounds: Bounds | None) -> None:
    """Raise CompareError unless bounds are four finite numbers, the low ones first."""
    if bounds is None:
        return
    if len(bounds) != 4 or not all(math.isfinite(v) for v in bounds):
        raise CompareError(f"--bounds is {tuple(bounds)}, expected four finite numbers E0 N0 E1 N1")
    e0, n0, e1, n1 = bounds
    if e0 >= e1 or n0 >= n1:
        raise CompareError(
            f"--bounds is {as_text(bounds)}, expected E0 N0 E1 N1 with E0 below E1 and N0 below N1; put the "
            "south-west corner first (not E0 E1 N0 N1)"
        )


def as_text(values) -> str:
    """Numbers for a message, to ten digits."""
    return " ".join(f"{value:.10g}" for value in values)


def outlier_filter(text: str) -> tuple[int, float]:
    """Neighbours and number of standard deviations of ``"sor:K,S"``."""
    name, _, numbers = text.partition(":")
    neighbours, _, num_std = numbers.partition(",")
    try:
        found = int(neighbours), float(num_std)
    except ValueError:
        found = (0, 0.0)
    if name != "sor" or found[0] < 1 or not 0.0 < found[1] < math.inf:
        raise CompareError(
            f'--outliers is "{text}", expected sor:K,S with K neighbours and S standard deviations, e.g. sor:6,2.0'
        )
    return found
