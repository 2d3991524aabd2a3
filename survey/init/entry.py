"""Keys of survey.toml with their comments, and questions about what files cannot tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import tomli_w

from survey.errors import ConfigError

# Asks a person; returns the answer, which may be empty.
Ask = Callable[[str], str]


@dataclass(frozen=True)
class Answers:
    """Answers on the command line."""

    crs: str | None = None
    level_m: float | None = None
    is_dry: bool = False  # There is no water
    # (easting, northing, height) or None: of the local frame of poses, in crs
    origin: tuple[float, float, float] | None = None
    ask: Ask | None = None  # callable or None: None where nobody is there to be asked

    def number(self, question: str, *, otherwise: str | None) -> float | None:
        """The number that a person answers; None for an empty answer, or nobody to ask.

        Parameters
        ----------
        question : str
        otherwise : str or None
            What the error says where a number is required; None where it is not.

        Raises
        ------
        ConfigError
            If the answer is no number, or is required and missing.
        """
        text = "" if self.ask is None else self.ask(question).strip()
        if not text and otherwise is not None:
            raise ConfigError(otherwise)
        try:
            return float(text) if text else None
        except ValueError as error:
            raise ConfigError(f'the answer to "{question}" is "{text}", expected a number such as 12.34') from error


@dataclass
class Table:
    """A table of survey.toml."""

    name: str  # Empty for the keys before the first table
    lines: list[str] = field(default_factory=list)

    def set(self, key: str, value: Any, comment: str = "", more: tuple[str, ...] = ()) -> None:
        """Add a key with a comment behind it, and lines of comment below."""
        line = f"{key} = {_toml(value)}"
        self.lines.append(f"{line}    # {comment}" if comment else line)
        self.lines += [f"# {text}" for text in more]

    def say(self, *comments: str) -> None:
        """Add lines of comment."""
        self.lines += [f"# {text}" for text in comments]

    def text(self) -> str:
        """The table in TOML; empty where it has no line."""
        head = f"[{self.name}]\n" if self.name else ""
        return head + "\n".join(self.lines) + "\n" if self.lines else ""


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(each) for each in value)}]"
    return tomli_w.dumps({"key": value}).partition(" = ")[2].strip()
