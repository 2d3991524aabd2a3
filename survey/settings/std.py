"""Standard deviations in survey.toml: above zero and no larger than any measurement of their kind."""

from __future__ import annotations

from survey.errors import ConfigError

# Of three numbers each counts for one axis.
Std = float | tuple[float, float, float]


def require_std(name: str, value: Std | tuple[float, float] | None, most: float, unit: str, example: str) -> None:
    """Raise ConfigError unless all standard deviations that are given are above zero and at most `most`.

    Parameters
    ----------
    name : str
        Of the key, with its table, e.g. "[water] level_std_m".
    value : float, tuple of float or None
    most : float
        In `unit`.
    unit : str
        As in "metres"; empty for numbers without a unit.
    example : str
        What typical values are, as a part of a sentence.
    """
    for number in value if isinstance(value, tuple) else (value,):
        if number is not None and not 0.0 < number <= most:
            shown = list(value) if isinstance(value, tuple) else value
            of = f" {unit}" if unit else ""
            raise ConfigError(
                f"{name} is {shown}, expected a standard deviation above 0 and at most {most:g}{of}; {example}"
            )


def per_axis(value: Std) -> tuple[float, float, float]:
    """Standard deviations along three axes, equal where one value is given."""
    return value if isinstance(value, tuple) else (value, value, value)
