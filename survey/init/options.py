"""What no file states of photographs: options of `init`, and of `process` where there is no survey.toml."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from survey.errors import ConfigError
from survey.files.toml_table import option

_told = partial(option, "Of photographs without survey.toml", alone=True)


@dataclass(frozen=True)
class InitOptions:
    """What no file states of photographs, as a person knows it, or somebody to be asked for it."""

    level_m: float | None = _told("M", "Height of the water in the heights of the CRS [m].", name="--level")
    sea: bool = _told(None, "The water is that of the sea, not fresh.", name="--sea", default=False)
    dry: bool = _told(None, "There is no water.", name="--dry", default=False)
    crs: str | None = _told("CRS", "Horizontal and vertical, e.g. EPSG:25832+7837; default: found.")
    origin: tuple[float, float, float] | None = _told("E N H", "Zero point of poses in a local frame, in the CRS.")
    # callable or None: asks a person, and returns the answer, which may be empty; None where nobody is there
    ask: Callable[[str], str] | None = None
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
        text = "" if self.ask is None else self.ask(question).strip()
        level, _, kind = text.partition(" ")
        if text == "dry":
            return replace(self, dry=True)
        if level and kind in ("", "sea"):
            with suppress(ValueError):
                return replace(self, level_m=float(level), sea=self.sea or bool(kind))
        if text:
            raise ConfigError(f'the answer is "{text}", expected a number such as 12.34, 12.34 sea, or dry')
        if can_do_without and (self.ask is not None or not self.needs_level):
            return self
        raise ConfigError(
            f"the height of the water {heights} is not known; init and process take it as --level 12.34, or --dry "
            "where there is no water; or put gauge.csv, shoreline.csv or gnss_points.csv (docs/waterline.md) into the "
            "folder"
        )
