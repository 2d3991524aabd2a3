"""Dependencies of a stage, part by part, and the reason why a stage is computed again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from survey.stage_key import stage_key

# Parts in words; a part without words is the result of another stage.
_WORDS = {
    "photographs": "the photographs or masks",
    "cameras": "poses or lenses",
    "water": "the water",
    "water_settings": "level, slopes or index in survey.toml",
    "ties": "the matches of structure from motion",
    "priors": "positions, or the standard deviations of poses",
    "control": "the control points",
    "freed": "--calibrate-water",
    "heights": "the range of heights",
    "area": "the area",
    "tiles": "the tiles (--tiles, --memory)",
    "frame": "the local frame",
    "name": "the name of the survey",
    "size": "the size that images are worked on",
    "gsd": "the ground sampling distance",
    "refined": "which pixels the sweep refines (--field, or --quality)",
    "coverage": "the number of views per place (--quality, or the program)",
    "rays": "the rays that the field learns from (--quality, or the program)",
    "boxes": "whether the bed is looked for in boxes beside edges (--field)",
    "device": "the device",
    "water_colour": "the colour of the water",
    "true_colour": "--true-colour",
    "code": "the program",
}


@dataclass(frozen=True)
class Key:
    """Key of a stage: the hashes of its inputs."""

    parts: Mapping[str, str]  # dict of str to str: a hash for each part, by its name

    @cached_property
    def digest(self) -> str:
        """Hash over all parts."""
        return stage_key(dict(self.parts))

    def changes_from(self, earlier: Mapping[str, str]) -> list[str]:
        """Names of the parts that differ from those of an earlier key."""
        names = [*self.parts, *(name for name in earlier if name not in self.parts)]
        return [name for name in names if self.parts.get(name) != earlier.get(name)]

    @staticmethod
    def sentence_of(names: list[str]) -> str:
        """Reason in words why a stage is computed again; without names, that its earlier result cannot be read."""
        if not names:
            return "its earlier result is not whole"
        words = [_WORDS.get(name, f"the result of the stage {name}") for name in names]
        listed = " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
        return f"{listed} changed"
