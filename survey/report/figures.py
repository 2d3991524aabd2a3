"""The figures of a report, as frozen dataclasses for report.html and as plain values for report.json."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from survey.compare.figures import Figures, numbers_of
from survey.files.json_values import plain
from survey.plan.plan import Plan
from survey.report.adjustment_figures import AdjustmentFigures
from survey.report.checkpoints import CheckpointAccuracy, StatedFigures
from survey.report.facts import RunVerdict, WaveFigures
from survey.report.photographs import PhotographFigures, TakenFigures
from survey.report.seen_cells import CoverageFigures

# Fields that report.json has of the plan and of the cloud, in its order.
_OF_PLAN = ("quality", "device", "image_scale", "gsd_m", "height_m", "footprint_m", "decisions")
_OF_CLOUD = ("points", "points_wet", "points_dry", "extent", "covered_area_m2", "density_per_m2")


@dataclass(frozen=True)
class CrsFigures:
    """A coordinate reference system."""

    name: str
    code: str | None  # E.g. "EPSG:25832+5778".
    # unit, height_unit: "m", "°" or another name, of the horizontal axes and of the height
    unit: str
    height_unit: str


@dataclass(frozen=True)
class SurveyFigures:
    """Place, cameras and photographs of the survey."""

    name: str
    crs: CrsFigures
    bounds: tuple[float, float, float, float] | None  # (e0, n0, e1, n1) or None, in crs
    views_used: int
    views_left_out: int
    image_size_px: tuple[int, int]  # (width, height)
    focal_px: float  # Of the first view, as the size
    poses: str  # Name of the file, or "structure from motion"
    shutter: str | None  # How it rolls, as a sentence; None where nothing is said of it
    local_frame_origin: tuple[float, float, float]  # (easting, northing, height), in crs


@dataclass(frozen=True)
class LightFigures:
    """The light whose texture is matched, to which the index of the water belongs."""

    # red, green, blue [-]: shares of the channels; they add up to 1
    red: float
    green: float
    blue: float
    is_measured: bool  # In the photographs; else they are the weights of luma
    wavelength_nm: float  # [nm]: at which water has the index of this mixture
    over_sodium: float  # [-]: the index here less that of the sodium line, 589.3 nm, which handbooks state
    over_sodium_m: float | None  # [m] or None: what that moves at the median depth; None without wet points


@dataclass(frozen=True)
class WaterFigures:
    """The water plane, and where its values come from."""

    level_m: float  # in crs
    level_at: tuple[float, float]  # (easting, northing), in crs
    level_from: str
    # slope_east, slope_north [-]: rise per metre along the axes of the grid
    slope_east: float
    slope_north: float
    slope_from: str
    refractive_index: float  # [-]
    refractive_index_from: str
    light: LightFigures | None  # None where the photographs were not looked at


@dataclass(frozen=True)
class Spread:
    """Statistics of values over the points, in their unit."""

    min: float
    median: float
    mean: float
    p95: float
    max: float


@dataclass(frozen=True)
class Extent:
    """The lowest and the highest easting, northing and height of points, in crs."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class CloudFigures:
    """The points of the bed."""

    # points, points_wet: All, and those under water
    points: int
    points_wet: int
    extent: Extent | None  # None without points
    covered_area_m2: float  # [m^2]: of the cells, five ground sampling distances wide, that have points
    # True depth of the points under water [m]; None, as the next three, where no value is finite
    depth_m: Spread | None
    # std_m, std_common_m, views_per_point, incidence_deg: Of all points: standard deviation of the height [m] but for
    # what all points have in common, and by that (water, lens, poses), number of views that agree [-], incidence at the
    # water or, in a dry survey, angle off nadir [deg]
    std_m: Spread | None
    std_common_m: Spread | None
    views_per_point: Spread | None
    incidence_deg: Spread | None
    plan_std_common_m: float = 0.0  # [m]: of all places in plan, by a transformation of datums; 0 where there was none

    @property
    def points_dry(self) -> int:
        """Points that are not under water."""
        return self.points - self.points_wet

    @property
    def density_per_m2(self) -> float | None:
        """Points on a square metre of the covered area; None without points."""
        return self.points / self.covered_area_m2 if self.covered_area_m2 else None


@dataclass(frozen=True)
class BaselineRow:
    """Vertical errors of one method."""

    name: str
    kind: str  # "predicted" or "measured"
    # median_m, nmad_m, mean_m [m]: `nmad_m` is 1.4826 times the median absolute deviation
    median_m: float
    nmad_m: float
    mean_m: float


@dataclass(frozen=True)
class Baselines:
    """Other methods beside this run."""

    places: int  # Of the bed, at which the others are predicted
    views_per_place: float  # Median
    rows: tuple[BaselineRow, ...]
    note: str  # How the rows of both kinds were computed


@dataclass(frozen=True)
class HeightStd:
    """Standard deviation of the height of a point; medians over the points [m]."""

    whole: float  # Random and shared
    shared: float | None  # Common to large parts of the cloud, by water, lens and poses; None where unknown
    random: float  # Independent for each point


@dataclass(frozen=True)
class ReportFigures:
    """All figures of a report."""

    verdict: RunVerdict | None  # None where the run was not judged
    survey: SurveyFigures
    water: WaterFigures | None  # None for a dry survey
    plan: Plan
    cloud: CloudFigures
    comparison: Figures | None  # survey.compare.figures.Figures or None: None without a reference
    baselines: Baselines | None  # None without water or reference
    timings_s: dict[str, float]  # dict: seconds by stage [s], in order
    versions: dict[str, str]  # dict: of what computed, by name
    settings: dict  # The effective settings, by section and key, as JSON holds them
    # assumptions, warnings: Sentences for the reader
    assumptions: tuple[str, ...]
    warnings: tuple[str, ...]
    checkpoints: CheckpointAccuracy | None = None  # None without check points
    adjustment: AdjustmentFigures | None = None  # None where poses and water were used as they came
    photographs: tuple[PhotographFigures, ...] = ()  # What of each was left out of matching
    height_std: HeightStd | None = None
    taken: TakenFigures | None = None  # None where the headers of the photographs were not read
    left_out: tuple[str, ...] = ()  # Names of the photographs in the folder that have no pose
    stated: StatedFigures | None = None  # What the cloud states of its heights; None without points
    coverage: CoverageFigures | None = None  # What of the water was seen; None for a dry survey
    waves: WaveFigures | None = None  # None where no solver ran

    @property
    def total_s(self) -> float:
        """Seconds of all stages together [s]."""
        return sum(self.timings_s.values())


def json_of(figures: ReportFigures) -> dict:
    """The figures as dicts, lists, numbers and texts, the units in their names; None where there is none."""
    comparison = None if figures.comparison is None else numbers_of(figures.comparison)
    return plain({
        "verdict": _some(figures.verdict, "passed", "gates"),
        "survey": figures.survey,
        "taken": figures.taken,
        "water": figures.water,
        "plan": _some(figures.plan, *_OF_PLAN),
        "cloud": _cloud(figures.cloud),
        "comparison": comparison,
        "iho_s44": None if comparison is None else comparison.get("iho_s44"),
        "checkpoints": figures.checkpoints,
        "height_std_m": figures.height_std,
        "stated": figures.stated,
        "coverage": figures.coverage,
        "waves": figures.waves,
        "adjustment": None if figures.adjustment is None else _adjustment(figures.adjustment),
        "baselines": figures.baselines,
        "photographs": figures.photographs,
        "photographs_left_out": figures.left_out,
        "timings_s": {**figures.timings_s, "total": figures.total_s},
        "versions": figures.versions,
        "settings": figures.settings,
        "assumptions": figures.assumptions,
        "warnings": figures.warnings,
    })  # fmt: skip


def _adjustment(found: AdjustmentFigures) -> dict:
    values = asdict(found)
    del values["common"]
    return values | {"height_std_common_m": _some(found.common, "mean", "typical")}


def _cloud(cloud: CloudFigures) -> dict:
    return {
        **{name: getattr(cloud, name) for name in _OF_CLOUD},
        "depth_m": _some(cloud.depth_m, "min", "median", "p95", "max"),
        "std_m": _some(cloud.std_m, "median", "p95"),
        "std_common_m": _some(cloud.std_common_m, "median", "p95"),
        **({"plan_std_common_m": cloud.plan_std_common_m} if cloud.plan_std_common_m else {}),
        "views_per_point": _some(cloud.views_per_point, "min", "median", "mean", "max"),
        "incidence_deg": _some(cloud.incidence_deg, "median", "p95", "max"),
    }


def _some(record: object | None, *names: str) -> dict | None:
    """Some fields of a record; None without one."""
    return None if record is None else {name: getattr(record, name) for name in names}
