"""`bathynerf field`: the options of `survey.volume.field`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import DeviceOption, Quiet, RunFolder, Verbose
from survey.plan.choices import Device
from survey.words import Drop

EXAMPLES = """
    bathynerf field my_survey/bathynerf --model mdw -o mdw
    bathynerf field my_survey/bathynerf --model tensorf \\
        -o t --held-every 8 --reference lidar.ply
    bathynerf field my_survey/bathynerf -o mdw \\
        --cameras cameras.csv
"""

_TRAINING, _SCENE, _SHOWN = "Training", "Training data", "Results"


class Model(StrEnum):
    """See `fields.volume.models`, which takes torch to import."""

    mdw = "mdw"
    mdw_printed = "mdw-printed"
    m = "m"
    dw = "dw"
    vm = "vm"
    tensorf = "tensorf"
    nerf = "nerf"
    tinynerf = "tinynerf"
    nerfacto = "nerfacto"
    neus = "neus"
    hash = "hash"
    octree = "octree"
    ground = "ground"


class Rule(StrEnum):
    """Twin of `fields.volume.surface.Rule`, which takes torch to import."""

    median = "median"
    mode = "mode"
    density = "density"


def run(
    run: RunFolder,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New folder, or that of this training to resume.")
    ],
    model: Annotated[
        Model | None, typer.Option(metavar="NAME", help=f"{', '.join(Model)}; default: mdw.", rich_help_panel=_TRAINING)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Training steps; default: 2000.", rich_help_panel=_TRAINING)
    ] = None,
    rays: Annotated[
        int | None, typer.Option(metavar="N", help="Rays per step; default: 4096.", rich_help_panel=_TRAINING)
    ] = None,
    samples: Annotated[
        int | None, typer.Option(metavar="N", help="Samples per ray; default: 48.", rich_help_panel=_TRAINING)
    ] = None,
    cells: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Cells along the longest edge, finest scale; default: 256.", rich_help_panel=_TRAINING
        ),
    ] = None,
    appearance: Annotated[
        bool | None,
        typer.Option("--appearance", help="Learn an appearance per photograph.", rich_help_panel=_TRAINING),
    ] = None,
    submodules: Annotated[
        str | None,
        typer.Option(metavar="NxM", help="Ground cells with a field each; or N.", rich_help_panel=_TRAINING),
    ] = None,
    shell: Annotated[
        bool | None,
        typer.Option("--shell", help="Learn what lies beyond the box.", rich_help_panel=_TRAINING),
    ] = None,
    from_scratch: Annotated[
        bool | None,
        typer.Option("--from-scratch", help="Begin without the bed of the run.", rich_help_panel=_TRAINING),
    ] = None,
    monocular: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Monocular depth and normals to learn from.", rich_help_panel=_TRAINING),
    ] = None,
    straight: Annotated[
        bool, typer.Option("--straight", help="Do not refract rays, like other programs.", rich_help_panel=_TRAINING)
    ] = False,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of random numbers.", rich_help_panel=_TRAINING)] = 0,
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="E0 N0 E1 N1", help="Part of the bed, in crs.", rich_help_panel=_SCENE),
    ] = None,
    image_scale: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="Scale of photographs, 0 to 1; default: 2 pixels a cell.", rich_help_panel=_SCENE
        ),
    ] = None,
    held_every: Annotated[
        int | None,
        typer.Option(metavar="N", help="Hold out every Nth photograph for testing.", rich_help_panel=_SCENE),
    ] = None,
    survey: Annotated[
        str | None,
        typer.Option(metavar="DIR", help="Survey folder, if it was moved since the run.", rich_help_panel=_SCENE),
    ] = None,
    extract: Annotated[
        Rule,
        typer.Option(metavar="RULE", help="Surface by median, mode or density.", rich_help_panel=_SHOWN),
    ] = Rule.median,
    density: Annotated[
        float | None,
        typer.Option(metavar="D", help="Least density of the surface [1/m].", rich_help_panel=_SHOWN),
    ] = None,
    drop: Annotated[
        Drop | None,
        typer.Option(metavar="HOW", help="How views drop submodules: geometry, network, none.", rich_help_panel=_SHOWN),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Mesh or cloud to compare with.", rich_help_panel=_SHOWN),
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Poses of views to render.", rich_help_panel=_SHOWN)
    ] = None,
    dry: Annotated[bool, typer.Option("--dry", help="Render without the water.", rich_help_panel=_SHOWN)] = False,
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
        from survey.volume.settings import field_config, volume_options

        asked = FieldConfig(
            model=None if model is None else model.value,
            steps=steps,
            rays=rays,
            samples=samples,
            cells=cells,
            image_scale=image_scale,
            held_every=held_every,
            appearance=appearance,
            shell=shell,
            submodules=submodules,
            drop=None if drop is None else drop.value,
            from_scratch=from_scratch,
            monocular=None if monocular is None else str(monocular.absolute()),
        )
        options = volume_options(
            asked.over(field_config(run, survey)),
            bounds=bounds,
            straight=straight,
            rule=SurfaceRule(extract.value),
            density=density,
            reference=reference,
            cameras=cameras,
            dry=dry,
            survey=survey,
            device=device.value,
            seed=seed,
        )
        results.columns(None, rows_of(train_field(run, output, options), output))
