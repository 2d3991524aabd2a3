"""Inputs of a report: all that a run knows at its end, and the verdict on its requirements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fields.sweep.bed import BedPoints
from fields.sweep.maps import HeightMap
from geo.shapes import ComputedColumn
from survey.adjust.result.adjustment import Adjustment
from survey.compare.figures import Comparison
from survey.display.plan_grid import median
from survey.display.quantities import height
from survey.folder.survey import Survey
from survey.photos.exif import Exif
from survey.photos.texture import MatchedLight
from survey.plan.plan import Plan
from survey.report.checkpoints import CheckpointAccuracy, checkpoints_of
from survey.report.photographs import PhotographFigures
from survey.report.seen_cells import SeenCells
from survey.water.wave_surfaces import WaveSurfaces


@dataclass(frozen=True)
class Gate:
    """Quality gate: a condition with its value and limit."""

    name: str  # The requirement, in a few words
    # value, limit: In `unit`; None where there was nothing to measure
    value: float | None
    limit: float
    unit: str  # "%" or "mm"
    passed: bool
    sentence: str  # Finding and requirement, as text


@dataclass(frozen=True)
class RunVerdict:
    """All gates of a run."""

    gates: tuple[Gate, ...]

    @property
    def passed(self) -> bool:
        """Whether all are met."""
        return all(gate.passed for gate in self.gates)


@dataclass(frozen=True)
class WaveFigures:
    """What moved the photographs against each other, and the waves that were found and taken away."""

    moved_px: float  # Standard deviation of the shifts of photographs by waves
    # By the surfaces of all photographs, the fields of `fields.waves.surfaces.Sea`; None where water was taken as still
    sea: dict[str, float] | None
    common_std_m: float = 0.0  # Of the error of all heights alike, by what is wrong with surfaces
    # Of the error of a height by waves: were the water taken as still, and by what surfaces leave
    still_std_m: float = 0.0
    left_std_m: float = 0.0


def dry_warnings(survey: Survey, bed: BedPoints) -> list[str]:
    """Warning of how far the bed lies over the water; none where a point is wet, or there is no water."""
    if survey.water is None or not len(bed) or bed.wet.any():
        return []
    above = height(-float(bed.depth.max()))
    return [
        f"all of the bed lies above the water, whose level is {height(survey.require_water()[1].known_level_m)}: the "
        f"lowest point by {above}; if the ground was under water, level_m of survey.toml is wrong, or in another "
        "vertical datum than the poses"
    ]


@dataclass(frozen=True)
class ReportFacts:
    """Inputs of a report at the end of a run."""

    survey: Survey
    plan: Plan
    settings: dict  # The effective settings, as plain values
    timings: dict[str, float]  # dict: seconds by stage [s], in order
    bed: BedPoints  # Local frame, N points
    points_crs: np.ndarray  # (N, 3) float64: the same points, in crs
    height_maps: Sequence[HeightMap] | None = None  # One of them is shown beside its photograph
    # Of the cloud of these points with a reference, from `survey.compare.comparison.compare_surfaces`
    comparison: Comparison | None = None
    warnings: tuple[str, ...] = ()  # Of the plan
    versions: dict[str, str] = field(default_factory=dict)  # dict: of what computed, by name
    verdict: RunVerdict | None = None  # The quality gates
    adjustment: Adjustment | None = None  # None where poses and water were used as they came
    std_common: np.ndarray | None = None  # (N,) [m] or None: of the heights of the points, by water, lens and poses
    light: MatchedLight | None = None  # To which the index of the water belongs; None in a dry survey
    photographs: tuple[PhotographFigures, ...] = ()  # Shares of each that were left out; empty where not computed
    # dict of name to Exif: image headers of the photographs that are used; empty where they were not read
    headers: Mapping[str, Exif] = field(default_factory=dict)
    waves: WaveFigures | None = None  # None where no solver ran
    surfaces: WaveSurfaces | None = None  # Of the water in each photograph; None where it was still
    cells: SeenCells | None = None  # Of the ground, with points and without; None where nobody has looked

    @property
    def stated(self) -> ComputedColumn:
        """`stated_std` of the points."""
        return stated_std(self.bed.std, self.std_common)

    @cached_property
    def checkpoints(self) -> CheckpointAccuracy | None:
        """The cloud at the check points; None without any."""
        return checkpoints_of(self.survey, self.bed.xyz, self.plan.gsd_m, self.stated)


def stated_std(std: np.ndarray, std_common: np.ndarray | None) -> ComputedColumn:
    """Standard deviations (N,) [m] of the heights of points, random and shared, from both (N,); NaN counts for none."""
    if std_common is None:
        return ComputedColumn(np.abs, std)
    return ComputedColumn(lambda own, shared: np.hypot(own, np.nan_to_num(shared)), std, std_common)


@dataclass(frozen=True)
class HeightStd:
    """Standard deviation of the height of a point; medians over the points [m]."""

    whole: float  # Random and shared
    shared: float | None  # Common to large parts of the cloud, by water, lens and poses; None where unknown
    random: float  # Independent for each point


def height_std(std: np.ndarray, std_common: np.ndarray | None) -> HeightStd:
    """Std of the height of a point, all included, from its parts (N,) [m], N at least 1."""
    shared = math.nan if std_common is None else median(std_common)
    return HeightStd(median(stated_std(std, std_common)), None if math.isnan(shared) else shared, median(std))
