"""The verbs on the results of a run: view, export, render, compare, change and profile."""

from __future__ import annotations

import inspect
from functools import partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import DeviceOption, Quiet, RunFolder, Verbose, command, verb
from survey.compare.options import ChangeOptions, CompareOptions
from survey.errors import SurveyError
from survey.export.registry import FAMILIES, PRODUCTS, ExportOptions
from survey.words import FILES, Device

_served = partial(typer.Option, rich_help_panel="Where it is served")
_shown = partial(typer.Option, rich_help_panel="What is shown")
_file = partial(typer.Option, metavar="FILE", rich_help_panel=FILES)
MovedSurvey = Annotated[str | None, typer.Option(metavar="DIR", help="Survey folder, if it was moved since the run.")]


@verb("""
    bathynerf view my_survey
    bathynerf view RUN --reference lidar.ply --port 9000
    bathynerf view RUN --field mdw
    bathynerf view RUN --export view.html
""")
def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, survey folder, or that of a trained field.")],
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Reference surface to show: mesh, GeoTIFF or points.")
    ] = None,
    field: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Field trained by bathynerf field, to render from anywhere.")
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write one HTML file that opens without a server, and end.")
    ] = None,
    host: Annotated[
        str, _served(metavar="HOST", help="Address to listen on; 0.0.0.0: for other machines too.")
    ] = "localhost",
    port: Annotated[
        int, _served(metavar="PORT", help="Port; the next free one if it is taken.", min=1, max=65535)
    ] = 8080,
    survey: MovedSurvey = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """View and edit a run, or a trained field, in the browser: cloud, water and photographs (extra viewer).

    Ctrl-C ends it. From another machine: ssh -L 8080:localhost:8080 HOST.
    """
    with command(verbose, quiet, run, reads=run) as results:
        from survey.run.folder import run_in
        from survey.run.stored import is_field, run_of
        from survey.viewer.session import ViewOptions, export_page, serve

        if is_field(run):
            run, field = run_of(run), run
        run = run_in(run)
        if export is not None and field is not None:
            raise SurveyError("a field is rendered by the server; leave out --field or --export")
        options = ViewOptions(survey=survey, reference=reference, field=field, host=host, port=port)
        if export is not None:
            export_page(run, export, options)
            results.line(export)
            return
        serve(run, options, results.line)


def export(
    run: RunFolder,
    made: ExportOptions = ExportOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
    **files: Path | None,
) -> None:
    """Write products of a run for other programs.

    A product that exists and is up to date is not written again. RUN may also be a folder of `bathynerf field`.
    """
    with command(verbose, quiet, run) as results:
        from survey.export.export import export

        for path in export(run, options=made, **files):
            results.line(path)


def _option_per_product(function):
    """Give a verb an option for each product of the registry, in the place of ``files``."""
    kind, own = inspect.Parameter.KEYWORD_ONLY, inspect.signature(function, eval_str=True).parameters
    products = []
    for family, members in FAMILIES.items():
        for product in members:
            place = "DIR" if product.is_folder else "FILE"
            option = typer.Option(f"--{product.option}", metavar=place, help=product.help, rich_help_panel=family)
            annotation = Annotated[Path | None, option]
            products.append(inspect.Parameter(product.option, kind, default=None, annotation=annotation))
    others = [parameter.replace(kind=kind) for name, parameter in own.items() if name not in ("run", "files")]
    vars(function)["__signature__"] = inspect.Signature([own["run"], *products, *others], return_annotation=None)
    return function


export = _option_per_product(
    verb("".join(f"bathynerf export RUN --{product.option} {product.example}\n" for product in PRODUCTS))(export)
)


@verb("""
    bathynerf render my_survey/bathynerf -o pictures --dry \\
        --cameras my_survey/cameras.csv
    bathynerf render mdw -o pictures --cameras cameras.csv
""")
def render(
    run: RunFolder,
    cameras: Annotated[
        Path, typer.Option(metavar="FILE", help="Poses: cameras.csv, a COLMAP model, a camera path of nerfstudio.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the pictures.")],
    dry: Annotated[bool, _shown("--dry", help="Remove the effect of the water.")] = False,
    field: Annotated[
        bool, _shown("--field", help="Render the field of `process --field mdw` instead of the photographs.")
    ] = False,
    video: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="A video of a flight along the cameras in S seconds, flight.mp4.", min=0.1, max=3600
        ),
    ] = None,
    survey: MovedSurvey = None,
    device: DeviceOption = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Render the bed of a run, or a trained field, for other cameras: colours, heights, distances and normals.

    RUN may also be a folder of `bathynerf field`.
    """
    with command(verbose, quiet, output, reads=run) as results:
        from survey.export.render import render
        from survey.run.stored import is_field

        if is_field(run):
            from survey.volume.submodules import render_field

            pictures = render_field(run, cameras, output, dry=dry, device=device.value, video_s=video)
        else:
            pictures = render(
                run, cameras, output, dry=dry, trained=field, survey=survey, device=device.value, video_s=video
            )
        for path in pictures:
            results.line(path)


@verb("""
    bathynerf compare cloud.las reference.ply
    bathynerf compare cloud.las lidar.laz --json out.json
    bathynerf compare cloud.las lidar.laz --tolerance 0.1 \\
        --bounds 500000 5200000 500100 5200100
""")
def compare(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="Run folder, LAS, LAZ, COPC, PLY or E57.")],
    reference: Annotated[
        Path,
        typer.Argument(
            metavar="REFERENCE", help="PLY, OBJ, GLB, GeoTIFF, ATL24, or points like CLOUD, also CSV and XYZ."
        ),
    ],
    asked: CompareOptions = CompareOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compare a cloud with a reference: signed distances, completeness, F-score.

    The cloud is not aligned to the reference first.
    """
    with command(verbose, quiet, asked.report_dir or asked.json_path or cloud, reads=cloud) as results:
        from survey.compare.comparison import compare_files
        from survey.compare.tables import sections_of

        if cloud.is_dir():
            from survey.export.export import cloud_of

            cloud = cloud_of(cloud)
        for section in sections_of(compare_files(cloud, reference, options=asked)):
            results.section(section)


@verb("""
    bathynerf change spring/bathynerf autumn/bathynerf
    bathynerf change a.las b.laz --area dredged.geojson
    bathynerf change a.las b.laz --stable banks.geojson
    bathynerf change a.las b.las --tif d.tif --picture d.png
    bathynerf change a.las b.las --json d.json
    bathynerf change a.las b.laz --std 0.05 --std-common 0
    bathynerf change 2024.las 2025.las 2026.las -o series
""")
def change(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="Run folder, LAS, LAZ or COPC: the earliest survey.")],
    later: Annotated[list[Path], typer.Argument(metavar="RUN_B", help="Later surveys: one, or a series in time.")],
    asked: ChangeOptions = ChangeOptions(),
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder for table and plot of a series."),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute what changed between surveys: cut and fill, with their uncertainty.

    Volumes are of a later survey over the first, as they are, or after the
    later one is aligned in height on stable ground.
    """
    first_file = asked.json_path or asked.tif_path or asked.picture_path or output
    with command(verbose, quiet, first_file or run_a, reads=run_a) as results:
        from survey.change.change import change_between, rows_of
        from survey.change.series import change_series, rows_of_series

        if len(later) == 1 and output is None:
            results.columns(None, rows_of(change_between(run_a, later[0], asked)))
            return
        for area, epochs in groupby(change_series([run_a, *later], output, asked), attrgetter("area")):
            results.columns(area, rows_of_series(list(epochs)))


@verb("""
    bathynerf profile RUN --lines sections.geojson
    bathynerf profile RUN --lines axis.dxf --dxf cut.dxf
    bathynerf profile bed.laz --lines sections.gpkg \\
        --reference lidar.laz --picture sections.png
""")
def profile(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, LAS, LAZ or COPC.")],
    lines: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Lines as GeoJSON or (extra vector) GeoPackage, shapefile or DXF."),
    ],
    step: Annotated[
        float | None, typer.Option(metavar="M", help="Step along lines [m]; default: by the spacing of the points.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Reference surface to plot: mesh, GeoTIFF or points.")
    ] = None,
    csv: Annotated[Path | None, _file(help="Table of all places.")] = None,
    picture: Annotated[Path | None, _file(help="PNG of the profiles.")] = None,
    dxf: Annotated[Path | None, _file(help="Bed, water and reference as lines in space.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Draw profiles of the bed along lines: bed, water, standard deviation, reference."""
    with command(verbose, quiet, csv or picture or dxf or run, reads=run) as results:
        from survey.export.profiles import profiles_along, subtitle_of

        found = profiles_along(
            run, lines, step_m=step, reference=reference, csv_path=csv, picture_path=picture, dxf_path=dxf
        )
        results.columns(None, [(profile.name, subtitle_of(profile)) for profile in found])
