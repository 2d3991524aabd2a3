"""The result of an adjustment: parameters with verdicts, adjusted poses, and their joint covariance."""

import math
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geo.files import write_whole
from refract import FlatWater
from refract.lens import Lens
from survey.adjust.block.on_ground import GroundFit
from survey.adjust.block.priors import parameters_of
from survey.adjust.block.state import NUM_RELIEF, READOUT_NAME, Layout, State
from survey.display.quantities import decimals_of
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.files.toml_table import parse_values, table_of
from survey.settings.config import WaterConfig

JSON, ARRAYS = "adjustment.json", "adjustment.npz"
# Beyond this many standard deviations of their difference, two values contradict each other. Where four parameters are
# tested, one of them is beyond the latter by chance in one survey of a thousand (docs/adjustment.md).
MOST_SIGMAS, MOST_SIGMAS_OF_FOUR = 3.0, 3.66
# One sigma beyond which a parameter is of no use. 5 cm of level move the bed by 2 cm, and so does 0.01 of index in 3 m
# of water; 0.5 % of the focal length moves the ground by 0.5 % of the flying height.
MOST_STD_LEVEL_M, MOST_STD_INDEX, MOST_STD_FOCAL = 0.05, 0.01, 0.005
# Limit of use of a readout: std of the way that the camera flies from first row to last, in pixels on the ground.
MOST_STD_ROWS_PX = 0.5
# With a std above this share of that of the prior, the photographs add nearly nothing.
_LITTLE = 0.9
# A prior with a smaller std than this was held.
_EXACT = 1e-6


class Status(StrEnum):
    """What determines a parameter."""

    FREE = "free"  # The photographs
    HELD = "held"  # The given value, which is better known than the photographs determine it
    UNKNOWN = "not observable"  # Neither; the given value is kept


@dataclass(frozen=True)
class Parameter:
    """Parameter of the water or of a lens, with its verdict."""

    # "level_m", "slope_east", "slope_north", "refractive_index", or of the first lens "camera0.f" to "camera0.p2",
    # "camera0.readout_s" where the readout of its shutter was to be found, and "level_rate_m_per_h" where that was
    name: str
    # value, std: Level in m in crs at ``level_at``; slopes along the grid axes; the index relative to air; focal length
    # and principal point in px, the first pixel's centre at 0.5, 0.5
    value: float
    std: float
    # given, given_std: What was known before; the standard deviation is None where nothing was
    given: float
    given_std: float | None
    status: Status
    verdict: str  # A sentence

    @property
    def is_observable(self) -> bool:
        """Whether photographs or given values determine it."""
        return self.status != Status.UNKNOWN


@dataclass(frozen=True)
class ControlResidual:
    """Residual of an adjusted block at a control point."""

    name: str
    is_check: bool  # Whether its coordinates were left out of the adjustment
    is_wet: bool
    residual_m: tuple[float, float, float]  # (east, north, up) [m], local: adjusted less given
    num_marks: int
    rms_px: float  # Of its marks


@dataclass(frozen=True)
class AdjustedPoses:
    """Adjusted poses of V views."""

    names: tuple[str, ...]  # (V,) of the views
    lens_of: np.ndarray  # (V,): number of the lens of each view
    # centres, rotations: (V, 3) [m], local; (V, 3, 3) cam from local
    centres: np.ndarray
    rotations: np.ndarray
    # position_std, rotation_std_deg (V, 3): along the axes of local; about those of cam
    position_std: np.ndarray
    rotation_std_deg: np.ndarray
    # (V, 3) [m/(s px)], local, or None: velocity over the rows of a rolling shutter
    velocity_per_row: np.ndarray | None = None
    tides: np.ndarray | None = None  # (V,) [m], or None: tide at each camera, as it was found
    hours: np.ndarray | None = None  # (V,) [h], or None: see `survey.adjust.block.state.Layout`
    # (V,), or None: focal length of each photograph over that of its lens, less one; None where they do not differ
    focals: np.ndarray | None = None


@dataclass(frozen=True)
class Covariance:
    """Joint covariance of the P parameters."""

    matrix: np.ndarray  # (P, P): in the order of `names`
    names: tuple[str, ...]  # (P,)
    water_point: tuple[float, float]  # (x, y) [m], local: where the height of the water counts


@dataclass(frozen=True)
class Residuals:
    """Residuals of N observations."""

    view: np.ndarray  # (N,): number of the photograph
    px: np.ndarray  # (N, 2): reprojection residual
    at_px: np.ndarray  # (N, 2): place in the photograph
    point: np.ndarray  # (N,): number of the point


@dataclass(frozen=True)
class FitStatistics:
    # std_px, variance_factor, num_observations by kind of observation: standard deviation of a pixel coordinate;
    # factor on its variance, for errors that neighbours and ground share; how many were used
    std_px: dict[str, float]
    variance_factor: dict[str, float]
    num_observations: dict[str, int]
    # num_points, num_left_out: Points used; observations left out as outliers
    num_points: int
    num_left_out: int
    # (east, north, up) or None: median standard deviation of the positions as they were used
    gps_std_m: tuple[float, ...] | None


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment in the terms of the survey."""

    parameters: tuple[Parameter, ...]  # Of the water, where there is any, and of each lens
    water: WaterConfig | None
    lenses: tuple[Lens, ...]
    poses: AdjustedPoses
    covariance: Covariance
    residuals: Residuals
    statistics: FitStatistics
    control: tuple[ControlResidual, ...]
    points: np.ndarray  # (M, 3) [m], local
    # notes, warnings: sentences
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    # or None: of the shutter behind each lens, from the first to the last row [s]; None where no shutter rolls
    readouts_s: tuple[float, ...] | None = None
    # (error, standard deviation) [m], or None: common error of the heights of all positions, where the level of the
    # water placed the block
    common_up_m: tuple[float, float] | None = None
    ground: GroundFit | None = None  # How it was placed on the dry ground of an earlier survey

    def parameter(self, name: str) -> Parameter:
        return next(found for found in self.parameters if found.name == name)

    @property
    def layout(self) -> Layout:
        """Layout of the parameters of `covariance`, which leaves out the rises of a rough bed."""
        aspect = np.array([lens.focal[1] / lens.focal[0] for lens in self.lenses])
        poses = self.poses
        return Layout(
            poses.lens_of,
            aspect,
            poses.velocity_per_row,
            finds_readouts=f"camera0.{READOUT_NAME}" in self.covariance.names,
            tides=poses.tides,
            hours=poses.hours,
            finds_focals=poses.focals is not None,
        )

    def state(self, water: FlatWater | None) -> State:
        """The adjusted state under local water, without the rises of a rough bed, for `layout`."""
        if water is not None:
            x, y = self.covariance.water_point
            water = replace(water, point=(x, y, float(water.height(x, y))))
        lenses, poses = np.array([parameters_of(lens) for lens in self.lenses]), self.poses
        focals, readouts = np.zeros(0) if poses.focals is None else poses.focals, np.array(self.readouts_s or ())
        pose = poses.centres, poses.rotations
        return State(water, np.zeros(NUM_RELIEF), lenses, *pose, self.points, readouts, focals=focals)


# Records whose attributes stand in the files under these prefixes: `residual_px` is `residuals.px`.
_RECORDS: dict[str, tuple[type, str]] = {
    "poses": (AdjustedPoses, ""),
    "covariance": (Covariance, "covariance_"),
    "residuals": (Residuals, "residual_"),
    "statistics": (FitStatistics, ""),
}
# Exceptions to that.
_FILE_NAMES = {
    "covariance_matrix": "covariance",
    "covariance_water_point": "water_point",
    "velocity_per_row": "flow",
    "variance_factor": "factor",
}


def _file_name(prefix: str, attribute: str) -> str:
    """The name of an attribute of a record in the files."""
    return _FILE_NAMES.get(prefix + attribute, prefix + attribute)


def write_adjustment(folder: Path, found: Adjustment) -> None:
    """Write adjustment.json and adjustment.npz into an existing folder."""
    values: dict[str, Any] = {}
    for name, value in asdict(found).items():
        if name in _RECORDS:
            prefix = _RECORDS[name][1]
            values |= {_file_name(prefix, attribute): each for attribute, each in value.items()}
        else:
            values[name] = value
    values["water"] = None if found.water is None else table_of(found.water)
    arrays: dict[str, Any] = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    with write_whole(folder / ARRAYS) as stream:
        np.savez_compressed(stream, names=np.array(found.covariance.names), **arrays)
    write_json(folder / JSON, {name: value for name, value in values.items() if name not in arrays})


def read_adjustment(folder: Path) -> Adjustment:
    record = read_json_object(folder / JSON)
    if not record:
        raise SurveyError(f"{folder} has no adjustment; run process again with --no-resume")
    with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
        values = {name: _tuples(value) for name, value in record.items()}
        values |= {name: arrays[name] for name in arrays if name != "names"}
    records: dict[str, Any] = {}
    for name, (kind, prefix) in _RECORDS.items():
        attributes = {field.name: _file_name(prefix, field.name) for field in fields(kind)}
        records[name] = kind(**{key: values[stored] for key, stored in attributes.items() if stored in values})
    records |= {name: values.get(name) for name in ("points", "notes", "warnings", "readouts_s", "common_up_m")}
    water, ground = record["water"], values.get("ground")
    return Adjustment(
        parameters=tuple(Parameter(**{**row, "status": Status(row["status"])}) for row in values["parameters"]),
        water=None if water is None else parse_values({k: v for k, v in water.items() if v is not None}, WaterConfig),
        lenses=tuple(Lens(**row) for row in values["lenses"]),
        ground=None if ground is None else GroundFit(**ground),
        control=tuple(ControlResidual(**row) for row in values["control"]),
        **records,
    )


def _tuples(value):
    """Lists of JSON as the tuples they were."""
    if isinstance(value, dict):
        return {key: _tuples(each) for key, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class Estimate(NamedTuple):
    """A value and its standard deviation, infinite where nothing is known."""

    value: float
    std: float


def with_verdict(name: str, found: Estimate, before: Estimate, limit: float, unit: str) -> Parameter:
    """A parameter with its verdict, found and as given before; of no use beyond a standard deviation of ``limit``."""
    (value, std), (given, given_std) = found, before
    prior = given_std if math.isfinite(given_std) else None
    against = "" if prior is None else f" (given {given:.{decimals_of(std)}f} +- {prior:.2g}{unit})"
    shown = f"{value:.{decimals_of(std)}f} +- {std:.2g}{unit}{against}"
    if given_std < _EXACT:
        value, status, verdict = given, Status.HELD, f"held: {given:.6g}{unit}, exactly as given"
    elif std > limit and not given_std <= limit:
        value, status = given, Status.UNKNOWN
        verdict = (
            f"not observable: 1 sigma is {std:.2g}{unit}, at most {limit:.2g}{unit} would be of use; "
            f"{given:.{decimals_of(given_std)}f}{unit} is kept"
        )
    elif std > _LITTLE * given_std:
        status, verdict = Status.HELD, f"held: {shown}; the photographs add nothing"
    else:
        status, verdict = Status.FREE, f"found: {shown}"
    return Parameter(name, value, std, given, prior, status, verdict)


def unobservable_verdict(name: str, std: float, given: float, reason: str) -> Parameter:
    """A parameter of the water that keeps its given value for a reason."""
    kept = f"{given:.3f} m" if name == "level_m" else f"{given:.5f}"
    return Parameter(name, given, std, given, None, Status.UNKNOWN, f"not observable: {reason}; {kept} is kept")


def water_limits(points: np.ndarray) -> np.ndarray:
    """Limits (4,) of use of level, slopes and index; slopes count by their effect at the edge of the points."""
    middle = np.median(points[:, :2], axis=0)
    reach = float(np.quantile(np.linalg.norm(points[:, :2] - middle, axis=1), 0.95))
    slope = MOST_STD_LEVEL_M / max(reach, 1e-6)
    return np.array([MOST_STD_LEVEL_M, slope, slope, MOST_STD_INDEX])
