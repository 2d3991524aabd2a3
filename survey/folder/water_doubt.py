"""What photographs say of a parameter of the water, where it contradicts what is given."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class WaterDoubt:
    """A parameter of the water that photographs contradict under poses and lens that they bear out.

    Attributes
    ----------
    name : "level_m" or "refractive_index"
    given, given_std : float
        As survey.toml says, or the defaults.
    found, std : float
        By a sample of photographs.
    """

    name: str
    given: float
    given_std: float
    found: float
    std: float

    def __str__(self) -> str:
        """Both numbers in words."""
        unit, digits = (" m", 3) if self.name == "level_m" else ("", 4)
        return (
            f"{self.name} is given as {self.given:.{digits}f} +- {self.given_std:.2g}{unit}, and a sample of "
            f"photographs says {self.found:.{digits}f} +- {self.std:.2g}{unit}"
        )
