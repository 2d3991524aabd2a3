"""Groups of options: a command takes one record, and its help shows an option for each field of it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from survey.commands.options import (
    AIM,
    HOW,
    AskedDevice,
    AskedField,
    AskedPlan,
    AskedPoses,
    ImageScale,
    TargetStd,
    TimeBudget,
    words_of,
)
from survey.words import Quality

if TYPE_CHECKING:
    from survey.settings.tables import ProcessConfig

_WATER = "Water"
# Options whose name leaves out the unit that the settings have.
_SETTINGS = {"target_std": "target_std_m", "time_budget": "time_budget_s"}


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Decorator of a command: each parameter whose type is a dataclass becomes options, one for each field."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint) and isinstance(hint, type)}
    parameters = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in groups:
            parameters.append(parameter.replace(annotation=hints[name]))
            continue
        own = get_type_hints(groups[name], include_extras=True)
        parameters += [
            inspect.Parameter(field.name, parameter.kind, default=field.default, annotation=own[field.name])
            for field in fields(groups[name])
        ]

    @wraps(command)
    def run(**given: Any) -> None:
        records = {
            name: group(**{field.name: given.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**given, **records)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


@dataclass(frozen=True)
class PlanOptions:
    """Options of a run, of `check` and of `process`."""

    quality: Annotated[
        Quality | None,
        typer.Option(
            metavar=words_of(Quality),
            help="Trades run time for detail; default: standard.",
            show_default=False,
            rich_help_panel=AIM,
        ),
    ] = None
    target_std: TargetStd = None
    time_budget: TimeBudget = None
    device: AskedDevice = None
    field: AskedField = None
    poses: AskedPoses = None
    plan: AskedPlan = None
    image_scale: ImageScale = None

    def config(self) -> ProcessConfig:
        """The same as settings, over those of the environment."""
        from survey.commands.environment import asked_of_environment
        from survey.settings.tables import ProcessConfig

        asked = ProcessConfig(**{_SETTINGS.get(name, name): value for name, value in asdict(self).items()})
        return asked.over(asked_of_environment())


@dataclass(frozen=True)
class ProcessOptions(PlanOptions):
    """Further options of `process`."""

    calibrate_water: Annotated[
        bool | None,
        typer.Option(help="First estimate the water from the photographs.", show_default=False, rich_help_panel=_WATER),
    ] = None
    true_colour: Annotated[
        bool | None,
        typer.Option(
            help="Give points the colour of the bed without the water.", show_default=False, rich_help_panel=_WATER
        ),
    ] = None
    tiles: Annotated[
        int | None,
        typer.Option(metavar="NUMBER", help="Tiles of the ground; default: by the memory.", rich_help_panel=HOW),
    ] = None
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="What the run may take, as 8GB; default: most of what is free.", rich_help_panel=HOW
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER", help="Processes for tiles; default: by tiles, cores, memory.", rich_help_panel=HOW
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers compute tiles.", rich_help_panel=HOW),
    ] = None
