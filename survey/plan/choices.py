"""Options of a run, in a module that is quick to import, since the command line needs it."""

from __future__ import annotations

from dataclasses import dataclass

from survey.display.quantities import bytes_of
from survey.errors import SurveyError
from survey.words import SCALES, Device, Field, Plan, Poses, Quality


@dataclass(frozen=True)
class Choices:
    """Options of a run; the words are those of `survey.words`.

    Attributes
    ----------
    quality, device, field, poses, plan : str
    image_scale : [-], optional
        Scale of the photographs in the run, one of `SCALES`; default by their size and the quality.
    calibrate_water : bool
        Whether the water is found as if nothing were known of it.
    true_colour : bool
        Whether points get the colour of the bed without its water.
    tiles : int, optional
        Number of tiles of the ground, worked on one after the other; default by the memory.
    memory : str, optional
        Memory that the run may take, as "8GB"; default: most of what is free.
    workers : int, optional
        Number of processes that compute tiles; by default one, and on the command line by tiles, cores and memory.
        With a scheduler the number of its workers that the run waits for.
    scheduler : str, optional
        Address of a Dask scheduler whose workers compute tiles, features and matches, as "tcp://host:8786".

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
    tiles: int | None = None
    memory: str | None = None
    workers: int | None = None
    scheduler: str | None = None

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
        if self.tiles is not None and self.tiles < 1:
            raise SurveyError(f"--tiles is {self.tiles}, expected a number from 1 on")
        if self.memory is not None:
            bytes_of(self.memory)
        if self.workers is not None and self.workers < 1:
            raise SurveyError(f"--workers is {self.workers}, expected a number from 1 on")


# The defaults.
USUAL = Choices()
