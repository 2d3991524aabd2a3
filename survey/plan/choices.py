"""What can be chosen for a run; light to import, for the command line offers the same."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from survey.errors import SurveyError


class Quality(StrEnum):
    """How much time is spent; `survey.plan.recipe` says what each means."""

    draft = "draft"
    standard = "standard"
    fine = "fine"


class Device(StrEnum):
    """Where kernels run."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Field(StrEnum):
    """What refines the heights of the sweep: as the plan decides, least squares, the trained slab, or nothing."""

    auto = "auto"
    solver = "solver"
    slab = "slab"
    off = "off"


class Plan(StrEnum):
    """Whether what a scene does not need is left out, or nothing is."""

    auto = "auto"
    full = "full"


class Poses(StrEnum):
    """What happens to the poses: as the plan decides, taken as they are, or adjusted."""

    auto = "auto"
    fixed = "fixed"
    refine = "refine"


# Of photographs: each is half of the one before.
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


@dataclass(frozen=True)
class Choices:
    """What was chosen for a run; the words are those of the enumerations of this file.

    Attributes
    ----------
    quality, device, field, poses, plan : str
    image_scale : [-], optional
        At which photographs are worked on: one of `SCALES`; default by their size and the quality.
    calibrate_water : bool
        Whether the water is found as if nothing were known of it.
    true_colour : bool
        Whether points get the colour of the bed without its water.

    Raises
    ------
    SurveyError
        If a word or the scale is not known.
    """

    quality: str = Quality.standard.value
    device: str = Device.auto.value
    field: str = Field.auto.value
    poses: str = Poses.auto.value
    plan: str = Plan.auto.value
    image_scale: float | None = None
    calibrate_water: bool = False
    true_colour: bool = False

    def __post_init__(self) -> None:
        for name, words in (
            ("quality", Quality),
            ("device", Device),
            ("field", Field),
            ("poses", Poses),
            ("plan", Plan),
        ):
            if getattr(self, name) not in list(words):
                raise SurveyError(f"{name} is {getattr(self, name)}, expected one of {', '.join(words)}")
        if self.image_scale is not None and self.image_scale not in SCALES:
            known = ", ".join(f"{each:g}" for each in SCALES)
            raise SurveyError(f"image scale is {self.image_scale:g}, expected one of {known}")


# Where nothing was chosen.
USUAL = Choices()
