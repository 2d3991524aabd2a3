"""`bathynerf field`: the options of `survey.volume.field`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fields.models import MODELS
from survey.commands.console import command
from survey.commands.options import DeviceOption, Quiet, RunFolder, Verbose, grouped
from survey.plan.choices import Device
from survey.words import Drop

EXAMPLES = """
    bathynerf field my_survey/bathynerf --model mdw -o mdw
    bathynerf field my_survey/bathynerf --model tensorf \\
        -o t --held-every 8 --reference lidar.ply
    bathynerf field my_survey/bathynerf -o mdw \\
        --cameras cameras.csv
"""

_training = partial(typer.Option, rich_help_panel="Training")
_scene = partial(typer.Option, rich_help_panel="Training data")
_shown = partial(typer.Option, rich_help_panel="Results")


class Rule(StrEnum):
    """The same as `fields.volume.surface.Rule`, which takes torch to import."""

    median = "median"
    mode = "mode"
    density = "density"


@dataclass(frozen=True)
class TrainingOptions:
    """Options of the model and its training."""

    model: Annotated[
        str | None,
        _training(metavar="NAME", help=f"{', '.join(MODELS)}, or package.module:Class; default: mdw."),
    ] = None
    steps: Annotated[int | None, _training(metavar="N", help="Training steps; default: 2000.")] = None
    rays: Annotated[int | None, _training(metavar="N", help="Rays per step; default: 4096.")] = None
    samples: Annotated[int | None, _training(metavar="N", help="Samples per ray; default: 48.")] = None
    cells: Annotated[
        int | None, _training(metavar="N", help="Cells along the longest edge, finest scale; default: 256.")
    ] = None
    appearance: Annotated[bool | None, _training("--appearance", help="Learn an appearance per photograph.")] = None
    submodules: Annotated[str | None, _training(metavar="NxM", help="Ground cells with a field each; or N.")] = None
    shell: Annotated[bool | None, _training("--shell", help="Learn what lies beyond the box.")] = None
    from_scratch: Annotated[bool | None, _training("--from-scratch", help="Begin without the bed of the run.")] = None
    monocular: Annotated[
        Path | None,
        _training(metavar="DIR", help="Monocular depth and normals to learn from."),
    ] = None
    straight: Annotated[bool, _training("--straight", help="Do not refract rays, like other programs.")] = False
    seed: Annotated[int, _training(metavar="N", help="Seed of random numbers.")] = 0


@dataclass(frozen=True)
class DataOptions:
    """Options of the photographs and the part of the bed."""

    bounds: Annotated[
        tuple[float, float, float, float] | None, _scene(metavar="E0 N0 E1 N1", help="Part of the bed, in crs.")
    ] = None
    image_scale: Annotated[
        float | None, _scene(metavar="S", help="Scale of photographs, 0 to 1; default: 2 pixels a cell.")
    ] = None
    held_every: Annotated[int | None, _scene(metavar="N", help="Hold out every Nth photograph for testing.")] = None
    survey: Annotated[str | None, _scene(metavar="DIR", help="Survey folder, if it was moved since the run.")] = None


@dataclass(frozen=True)
class ResultOptions:
    """Options of the results: surface, comparison and views."""

    extract: Annotated[Rule, _shown(metavar="RULE", help="Surface by median, mode or density.")] = Rule.median
    density: Annotated[float | None, _shown(metavar="D", help="Least density of the surface [1/m].")] = None
    drop: Annotated[
        Drop | None,
        _shown(metavar="HOW", help="How views drop submodules: geometry, network, none."),
    ] = None
    reference: Annotated[Path | None, _shown(metavar="FILE", help="Mesh or cloud to compare with.")] = None
    cameras: Annotated[Path | None, _shown(metavar="FILE", help="Poses of views to render.")] = None
    dry: Annotated[bool, _shown("--dry", help="Render without the water.")] = False


@grouped
def run(
    run: RunFolder,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New folder, or that of this training to resume.")
    ],
    training: TrainingOptions = TrainingOptions(),
    data: DataOptions = DataOptions(),
    shown: ResultOptions = ResultOptions(),
    device: DeviceOption = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Train a published radiance field on a run: surface, views and figures.

    Rays are bent at the water before the field is sampled. The same command resumes a stopped training. Options that
    are not given come from [field] in survey.toml, then the defaults.
    """
    with command(verbose, quiet, output, reads=run) as results:
        from fields.volume.surface import Rule as SurfaceRule
        from survey.settings.tables import FieldConfig
        from survey.volume.field import rows_of, train_field
        from survey.volume.options import field_config, volume_options

        given = {name: value for part in (training, data, shown) for name, value in vars(part).items()}
        given["rule"] = SurfaceRule(given.pop("extract"))
        if training.monocular is not None:
            given["monocular"] = str(training.monocular.absolute())
        asked = FieldConfig(**{each.name: given.pop(each.name) for each in fields(FieldConfig) if each.name in given})
        options = volume_options(asked.over(field_config(run, data.survey)), device=device.value, **given)
        results.columns(None, rows_of(train_field(run, output, options), output))
