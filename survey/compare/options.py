"""Options of `bathynerf compare`, their meaning and checks, and the frame and bounds of a comparison."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation.c2m import Sign
from geo import LocalFrame
from survey.errors import SurveyError
from survey.files.outputs import ReadFiles, is_json, require_file, require_folder

Bounds = tuple[float, float, float, float]


class CompareError(SurveyError):
    """Two data sets that cannot be compared, or an option whose value makes no sense."""


@dataclass(frozen=True)
class ShiftedFrame:
    """Substitute for a `LocalFrame` if no file has a CRS: coordinates in metres, shifted near zero."""

    origin: tuple[float, float, float]

    def local_from_crs(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) as given, minus the origin [m]."""
        return np.asarray(points, dtype=np.float64) - self.origin

    def crs_from_local(self, points: np.ndarray) -> np.ndarray:
        """The inverse."""
        return np.asarray(points, dtype=np.float64) + self.origin


def within(points: np.ndarray, bounds: Bounds | None, margins: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Whether points (N, 3) lie in bounds (edges included) that grow by margins in easting and northing."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    e0, n0, e1, n1 = bounds
    east, north = points[:, 0], points[:, 1]
    return (
        (east >= e0 - margins[0]) & (east <= e1 + margins[0]) & (north >= n0 - margins[1]) & (north <= n1 + margins[1])
    )


def to_local(frame: LocalFrame | ShiftedFrame, points: np.ndarray, name: Path) -> np.ndarray:
    """Points (N, 3) in the local frame [m]."""
    local = frame.local_from_crs(points)
    if isinstance(frame, ShiftedFrame):
        return local
    bad = int((~np.isfinite(local).all(axis=1)).sum())
    if bad:
        raise CompareError(
            f"{bad} of {len(points)} points of {name} lie where {frame.crs.name} is not defined; remove them or "
            "correct the CRS of the file"
        )
    return local


def metres_in_crs(frame: LocalFrame | ShiftedFrame, length_m: float) -> tuple[float, float]:
    """A length [m] near the origin in units of easting and of northing (degrees in a geographic CRS)."""
    e, n, h = frame.origin
    step = 1e-6 * max(abs(e), abs(n), 1.0)
    ends = np.array([[e + step, n, h], [e - step, n, h], [e, n + step, h], [e, n - step, h]])
    local = frame.local_from_crs(ends)
    east = float(np.linalg.norm(local[0] - local[1])) / (2.0 * step)
    north = float(np.linalg.norm(local[2] - local[3])) / (2.0 * step)
    return length_m / east, length_m / north


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


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison."""

    # [m]: For completeness, accuracy share and F-score; the first is that of the keys at the top
    tolerances_m: tuple[float, ...] = (0.2,)
    visible: Path | None = None  # Points of the reference that cameras see
    bounds: Bounds | None = None  # (E0, N0, E1, N1), in crs: Crop the cloud to this first
    sign: Sign = "up"  # {"up", "winding"}: See `evaluation.distance_to_mesh`
    # In crs: Height of the water; depths are then taken from the reference alone
    water_level: float | None = None
    checkpoints: Path | None = None  # Table of check points, see `survey.compare.measure`
    # ``"sor:K,S"``: leave statistical outliers out, see `evaluation.is_outlier`. Nothing is left out without it
    outliers: str | None = None
    c2c: bool = False  # Also cloud-to-cloud distances, in both directions
    m3c2_radius_m: float | None = None  # [m]: M3C2 distances too, see `evaluation.m3c2_distances`
    json_path: Path | None = None  # json_path, report_dir: Where the numbers and the pictures go
    report_dir: Path | None = None


def check_options(options: CompareOptions) -> None:
    """Raise CompareError if the value of an option is invalid, or needs a package that is not installed."""
    if not options.tolerances_m:
        raise CompareError("--tolerance has no value, expected at least one in metres, e.g. 0.2")
    for tolerance in options.tolerances_m:
        _require_length("--tolerance", tolerance, "0.2")
    if options.sign not in ("up", "winding"):
        raise CompareError(f'--sign is "{options.sign}", expected up or winding')
    check_bounds(options.bounds)
    if options.water_level is not None and not math.isfinite(options.water_level):
        raise CompareError(f"--water-level is {options.water_level:g}, expected a height in the CRS of the cloud")
    if options.outliers is not None:
        outlier_filter(options.outliers)
    if options.m3c2_radius_m is not None:
        _require_length("--m3c2", options.m3c2_radius_m, "0.5")
        if importlib.util.find_spec("py4dgeo") is None:
            raise CompareError("--m3c2 needs py4dgeo, which is not installed: pip install 'bathynerf[m3c2]'")


def check_outputs(options: CompareOptions, cloud: Path, reference: Path) -> None:
    """Raise OutputError where numbers or pictures must not, or cannot, be written; see `survey.files.outputs`."""
    given = (cloud, reference, options.visible, options.checkpoints)
    inputs = ReadFiles.of(*(Path(path) for path in given if path is not None))
    json_path, report_dir = (path and Path(path) for path in (options.json_path, options.report_dir))
    require_file("--json", json_path, inputs, kind="a JSON file", is_of_kind=is_json)
    require_folder("--report", report_dir, inputs, may_hold_inputs=True)


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


def _require_length(option: str, value: float, example: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise CompareError(f"{option} is {value:g}, expected metres above zero, e.g. {example}")
