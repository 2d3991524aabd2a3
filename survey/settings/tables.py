"""[process], [control] and [field] of survey.toml, and what `init` is told for a new one.

[process] has the options of a run, [field] those of `bathynerf field`, which trains a radiance field on a run; options
of the command line take precedence over these tables. [control] names files of control
points, their marks, check points, and an earlier survey.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from fields.models import MODELS, Losses, Rule
from survey.errors import ConfigError
from survey.files.toml_table import key, option, require_with, std_key
from survey.words import FIELDS, LARGEST, SCALES, Device, Drop, Poses, Quality

# Of three numbers each counts for one axis.
Std = float | tuple[float, float, float]


def per_axis(value: Std) -> tuple[float, float, float]:
    """Standard deviations along three axes, equal where one value is given."""
    return value if isinstance(value, tuple) else (value, value, value)


# Panels of help that several verbs have.
AIM, HOW = "How well, or how fast", "How it is computed"
_aim, _how, _water = (partial(option, panel) for panel in (AIM, HOW, "Water"))
# An aim chooses quality, field and image scale itself, so that both kinds exclude each other.
_RECIPE, _AIM = ("quality", "field", "image_scale"), ("target_std_m", "time_budget_s")
# Ten thousand square kilometres in tiles of the largest size; workers of the largest clusters of Dask.
_MOST_TILES, _MOST_WORKERS = 10_000, 1_000


@dataclass(frozen=True)
class PlanOptions:
    """Options of `check` and of `process`; None leaves one open."""

    quality: str | None = _aim(None, "Trades run time for detail; default: standard.", one_of=Quality)
    target_std_m: float | None = _aim(
        "METRES",
        "Least work foreseen to reach this standard deviation on 95 % of the ground.",
        name="--target-std",
        expected="a standard deviation in metres above 0, in place of a quality",
        above=0.0,
        most=LARGEST,
    )
    time_budget_s: float | None = _aim(
        "SECONDS",
        "Best result foreseen to take no longer than this.",
        name="--time-budget",
        expected="the seconds that a run may take, above 0, in place of a quality",
        above=0.0,
        most=LARGEST,
    )
    device: str | None = _how(None, "Where to compute; default: auto.", one_of=Device)
    field: str | None = _how(None, "What follows the sweep; default: auto.", one_of=FIELDS)
    poses: str | None = _how(
        None, "Adjust poses, lens and water together, or take the poses as they are; default: auto.", one_of=Poses
    )
    image_scale: float | None = _how(
        "SCALE", "Work on images at 1, 0.5, 0.25, ...; default: by size and quality.", one_of=SCALES
    )


@dataclass(frozen=True)
class ProcessConfig(PlanOptions):
    """[process]: options of `process` and `check`, as they are called there; None leaves one open."""

    calibrate_water: bool | None = _water(None, "First estimate the water from the photographs.")
    true_colour: bool | None = _water(None, "Give points the colour of the bed without the water.")
    tiles: int | None = _how("NUMBER", "Tiles of the ground; default: by the memory.", least=1, most=_MOST_TILES)
    memory: str | None = _how(
        "SIZE", "Memory for the run, e.g. 8GB; default: most of the free one.", expected="a size such as 8GB"
    )
    workers: int | None = _how(
        "NUMBER", "Processes for tiles; default: by tiles, cores, memory.", least=1, most=_MOST_WORKERS
    )
    scheduler: str | None = _how(
        "ADDRESS",
        "Dask scheduler whose workers compute tiles, features and matches.",
        expected="the address of a Dask scheduler, such as tcp://host:8786",
    )

    def over(self, lower: ProcessConfig) -> ProcessConfig:
        """These options completed from `lower`; options of an aim and those of a recipe exclude each other."""
        displaced = (*(_RECIPE if self._says(_AIM) else ()), *(_AIM if self._says(_RECIPE) else ()))
        names = [field.name for field in dataclasses.fields(self)]
        inherited = {
            name: getattr(lower, name) for name in names if name not in displaced and getattr(self, name) is None
        }
        return dataclasses.replace(self, **inherited)

    @property
    def has_aim(self) -> bool:
        """Whether a standard deviation or a time is asked for."""
        return self._says(_AIM)

    def _says(self, names: tuple[str, ...]) -> bool:
        return any(getattr(self, name) not in (None, "auto") for name in names)

    def require_one_kind(self, named: Callable[[str], str] = "[process] {}".format) -> None:
        """Raise ConfigError where an aim and a recipe are asked for."""
        if self.has_aim and self._says(_RECIPE):
            parts = [named(name) for name in (*_AIM, *_RECIPE) if getattr(self, name) not in (None, "auto")]
            raise ConfigError(
                f"{' and '.join(parts)} are given, but {' and '.join(map(named, _AIM))} choose quality, field and "
                "image scale themselves; keep one kind"
            )


# Default std of points measured by GNSS with corrections or a total station, and of marks set by hand.
DEFAULT_STD_M, DEFAULT_MARKS_STD_PX = 0.01, 0.5
_PER_DIRECTION = "one number or [horizontal, vertical]"


@dataclass(frozen=True)
class ControlConfig:
    """[control]: files of control and check points, and how well they are known."""

    gcps: str | tuple[str, ...] | None = key(None, 'a file, e.g. "gcp_list.txt", or a list of files')
    checkpoints: str | None = None  # only reported: CSV of name, easting, northing, height, or ATL24 (.h5)
    std_m: float | tuple[float, float] | None = std_key(
        10.0, "metres", "GNSS with corrections has about 0.01 to 0.03", _PER_DIRECTION
    )
    marks: str | None = None  # where photographs show the points, unless gcps says it: a CSV, or Metashape's XML
    marks_std_px: float | None = std_key(50.0, "pixels", "marks set by hand have about 0.5")
    reference: str | None = None  # an earlier survey, on whose dry ground the block is placed: cloud, mesh or GeoTIFF
    reference_std_m: float | tuple[float, float] | None = std_key(
        10.0, "metres", "airborne lidar has about 0.1", _PER_DIRECTION
    )
    stable: str | None = None  # A vector file: polygons of its ground that did not change

    def __post_init__(self):
        if self.gcps == ():
            raise ConfigError("[control] gcps is an empty list, expected one file or more; name one or remove the key")
        require_with("control", self, "gcps", ("marks",), "gcps is the file of the coordinates")
        require_with("control", self, "reference", ("reference_std_m", "stable"))

    @property
    def gcp_files(self) -> tuple[str, ...]:
        """The names in ``gcps``, none where it is missing."""
        if self.gcps is None:
            return ()
        return self.gcps if isinstance(self.gcps, tuple) else (self.gcps,)

    @property
    def files(self) -> tuple[str, ...]:
        named = (self.marks, self.checkpoints, self.reference, self.stable)
        return (*self.gcp_files, *(name for name in named if name is not None))


def per_direction(std_m: float | tuple[float, float] | None) -> tuple[float, float, float]:
    """The standard deviations of control east, north and up [m]."""
    if std_m is None:
        raise ValueError("[control] std_m is not filled in; expected what `find_control` returns")
    return (std_m[0], std_m[0], std_m[1]) if isinstance(std_m, tuple) else (std_m, std_m, std_m)


_training, _data, _results = (partial(option, panel) for panel in ("Training", "Training data", "Results"))


@dataclass(frozen=True)
class FieldConfig:
    """[field]: options of `bathynerf field`, as they are called there; None leaves one open."""

    model: str | None = _training(
        "NAME", f"{', '.join(MODELS)}, or package.module:Class; default: mdw.", expected="a model of bathynerf field"
    )
    as_published: bool = _training(
        None, "Numbers of the model's paper where you give none.", name="--as-published", default=False, alone=True
    )
    steps: int | None = _training("N", "Training steps; default: 2000.", least=1)
    rays: int | None = _training("N", "Rays per step; default: 4096.", least=1)
    samples: int | None = _training("N", "Samples per ray; default: 48.", least=2)
    cells: int | None = _training("N", "Cells along the longest edge, finest scale; default: 256.", least=8)
    appearance: bool | None = _training(None, "Learn an appearance per photograph.", name="--appearance")
    submodules: str | None = _training(
        "NxM",
        "Ground cells with a field each; or N.",
        expected="3x2, or a number of cells on the ground with a field of their own each",
    )
    shell: bool | None = _training(None, "Learn what lies beyond the box.", name="--shell")
    from_scratch: bool | None = _training(None, "Begin without the bed of the run.", name="--from-scratch")
    monocular: str | None = _training(
        "DIR",
        "Monocular depth and normals to learn from.",
        expected="a folder of monocular depth and normals, relative to the survey folder",
    )
    straight: bool = _training(
        None, "Do not refract rays, like other programs.", name="--straight", default=False, alone=True
    )
    seed: int = _training("N", "Seed of random numbers.", default=0, alone=True)
    bounds: tuple[float, float, float, float] | None = _data("E0 N0 E1 N1", "Part of the bed, in crs.", alone=True)
    image_scale: float | None = _data(
        "S", "Scale of photographs, 0 to 1; default: 2 pixels a cell.", above=0.0, most=1.0
    )
    held_every: int | None = _data("N", "Hold out every Nth photograph for testing.", least=2)
    survey: str | None = _data("DIR", "Survey folder, if it was moved since the run.", alone=True)
    rule: Rule = _results(  # noqa: RUF009 (makes a field)
        "RULE", "Surface by median, mode or density.", name="--extract", default=Rule.median, alone=True
    )
    # Default: half of the light is stopped within a cell
    density: float | None = _results("D", "Least density of the surface [1/m].", alone=True, above=0.0, most=LARGEST)
    drop: str | None = _results(
        "HOW", "How views drop submodules: geometry, network, none.", expected="geometry, network or none", one_of=Drop
    )
    reference: Path | None = _results("FILE", "Mesh or cloud to compare with.", alone=True)  # noqa: RUF009
    cameras: Path | None = _results("FILE", "Poses of views to render.", alone=True)  # noqa: RUF009
    dry: bool = _results(None, "Render without the water.", name="--dry", default=False, alone=True)
    losses: Losses | None = None

    def over(self, lower: FieldConfig) -> FieldConfig:
        """These, and what `lower` says of those that are open."""
        names = [field.name for field in dataclasses.fields(self)]
        return dataclasses.replace(self, **{n: getattr(lower, n) for n in names if getattr(self, n) is None})


# Between those of the Dead Sea and of the highest lakes, with room for shifted heights.
_LEVELS_M = (-500.0, 9000.0)
_told = partial(option, "Of photographs without survey.toml", alone=True)


@dataclass(frozen=True)
class InitOptions:
    """What no file states of photographs, as a person knows it, or somebody to be asked for it."""

    level_m: float | None = _told("M", "Height of the water in the heights of the CRS [m].", name="--level")
    sea: bool = _told(None, "The water is that of the sea, not fresh.", name="--sea", default=False)
    dry: bool = _told(None, "There is no water.", name="--dry", default=False)
    crs: str | None = _told("CRS", "Horizontal and vertical, e.g. EPSG:25832+7837; default: found.")
    origin: tuple[float, float, float] | None = _told("E N H", "Zero point of poses in a local frame, in the CRS.")
    # callable or None: asks a person until the function beside the question reads the answer, which may be empty,
    # without a ValueError, and returns what it read; None where nobody is there
    ask: Callable[[str, Callable[[str], Any]], Any] | None = None
    needs_level: bool = False  # Even where photographs may tell it

    def __post_init__(self):
        if self.dry and (self.sea or self.level_m is not None):
            raise ConfigError(
                f"--dry says that there is no water, and {'--sea' if self.sea else '--level'} describes it; keep one"
            )

    def with_level(self, heights: str, *, can_do_without: bool) -> InitOptions:
        """These with the level that a person answers, in `heights` in words, or that there is no water.

        Raises ConfigError where nobody answers, unless the level can be found from the photographs.
        """
        or_empty = "; empty: found from the photographs" if can_do_without else ""
        question = f"Height of the water [m] {heights}: as 12.34, for the sea 12.34 sea, without water dry{or_empty}"

        def read(text: str) -> InitOptions:
            level, _, kind = text.partition(" ")
            if text == "dry":
                return replace(self, dry=True)
            if level and kind in ("", "sea"):
                with suppress(ValueError):
                    level_m = float(level.replace(",", "."))
                    if _LEVELS_M[0] <= level_m <= _LEVELS_M[1]:
                        return replace(self, level_m=level_m, sea=self.sea or bool(kind))
            if text:
                raise ConfigError(
                    f'the answer is "{text}", expected a number such as 12.34, 12.34 sea, or dry; levels are '
                    f"{_LEVELS_M[0]:g} to {_LEVELS_M[1]:g} m"
                )
            if can_do_without and (self.ask is not None or not self.needs_level):
                return self
            raise ConfigError(
                f"the height of the water {heights} is not known; init and process take it as --level 12.34, or --dry "
                "without water; or put gauge.csv, shoreline.csv or gnss_points.csv (docs/waterline.md) into the folder"
            )

        return read("") if self.ask is None else self.ask(question, read)
