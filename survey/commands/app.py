"""The command line: bathynerf check, process, waterline, export, render, compare, simulate.

Exit codes: 0 done, 1 our bug, 2 the input, 3 ran but a quality gate failed; 130 stopped by the user.

Whatever is slow to import is imported inside the command that needs it.
"""

from __future__ import annotations

import errno
import importlib.metadata
import shutil
import sys
import textwrap
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geo.errors import GeoError
from survey.errors import SurveyError
from survey.progress import Progress

if TYPE_CHECKING:
    from survey.plan.check import Section

OUR_BUG, BAD_INPUT, STOPPED = 1, 2, 130
_TOLERANCES_M = [0.2]

app = typer.Typer(
    help="Drone photographs of shallow water become a georeferenced point cloud of the bed.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Quality(StrEnum):
    """How much time is spent."""

    draft = "draft"
    standard = "standard"
    fine = "fine"


class Device(StrEnum):
    """Where kernels run."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Switch(StrEnum):
    """A part of the work: as the plan decides, on, or off."""

    auto = "auto"
    on = "on"
    off = "off"


class Mode(StrEnum):
    """How light is followed."""

    direct = "direct"
    physical = "physical"


class Sign(StrEnum):
    """Which side of a triangle is above it."""

    up = "up"
    winding = "winding"


Verbose = Annotated[
    int, typer.Option("-v", "--verbose", count=True, show_default=False, help="Say more; tracebacks too.")
]
Quiet = Annotated[int, typer.Option("-q", "--quiet", count=True, show_default=False, help="Say less.")]
SurveyFolder = Annotated[Path, typer.Argument(metavar="SURVEY", help="Folder with images and survey.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder that process made.")]


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(f"bathynerf {importlib.metadata.version('bathynerf')}")
        raise typer.Exit(0)


@app.command()
def check(
    survey: SurveyFolder,
    quality: Annotated[Quality, typer.Option(help="Plan for this quality.")] = Quality.standard,
    device: Annotated[Device, typer.Option(help="Plan for this device.")] = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Say what was found in a survey, what is missing and what the plan would be; nothing is computed."""
    with _errors_as_exit_codes(verbose - quiet, survey):
        from survey.plan.check import check_survey

        for section in check_survey(survey, quality=quality.value, device=device.value):
            if verbose >= quiet or section.title == "Warnings":
                _print_section(section)


@app.command()
def process(
    survey: SurveyFolder,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder. [SURVEY/bathynerf]")
    ] = None,
    quality: Annotated[Quality, typer.Option(help="How much time is spent.")] = Quality.standard,
    device: Annotated[Device, typer.Option(help="Where it runs.")] = Device.auto,
    field: Annotated[Switch, typer.Option(help="Refine the sweep by the tensor field.")] = Switch.auto,
    resume: Annotated[bool, typer.Option(help="Go on with what an earlier run finished.")] = True,
    calibrate_water: Annotated[
        bool, typer.Option("--calibrate-water", help="First estimate the water from the photographs.")
    ] = False,
    true_colour: Annotated[
        bool, typer.Option("--true-colour", help="Give points the colour of the bed without the water.")
    ] = False,
    reference: Annotated[Path | None, typer.Option(help="True surface, for the report only.")] = None,
    visible: Annotated[Path | None, typer.Option(help="Points of it that cameras see, for the report only.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Make the point cloud of the bed, with a report, in a run folder."""
    with _errors_as_exit_codes(verbose - quiet, output or survey / "bathynerf"):
        from survey.run.process import process as run

        code = run(
            survey,
            output,
            quality=quality.value,
            device=device.value,
            field=field.value,
            resume=resume,
            calibrate_water=calibrate_water,
            true_colour=true_colour,
            reference=reference,
            visible=visible,
        )
        raise typer.Exit(code)


@app.command()
def waterline(
    survey: SurveyFolder,
    device: Annotated[Device, typer.Option(help="Where it runs.")] = Device.auto,
    nadir_only: Annotated[bool, typer.Option("--nadir-only", help="Use views that look straight down alone.")] = False,
    start_level: Annotated[float | None, typer.Option(help="Start from this level [m] instead of level_m.")] = None,
    start_index: Annotated[float | None, typer.Option(help="Start from this refractive index.")] = None,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Take the poses that this run found. [SURVEY/bathynerf]")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write everything that was found to this file.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Say what the photographs tell about level, slopes and index of the water; nothing is changed."""
    with _errors_as_exit_codes(verbose - quiet, json or survey):
        from survey.adjust.calibration import estimate_water

        found = estimate_water(
            survey,
            device=device.value,
            nadir_only=nadir_only,
            start_level=start_level,
            start_index=start_index,
            run_folder=run,
            json_path=json,
        )
        if verbose >= quiet:
            rows = [(estimate.name, estimate.verdict) for estimate in found.estimates]
            points = f"{found.num_points} in {found.num_views} views, {found.num_measurements} measurements"
            residuals = "none, nothing was adjusted" if found.rms_px is None else f"{found.rms_px:.3f} px rms"
            _print_columns(None, [*rows, ("tie points", points), ("residuals", residuals)])


@app.command()
def export(
    run: RunFolder,
    las: Annotated[Path | None, typer.Option(help="LAS 1.4 file to write.")] = None,
    laz: Annotated[Path | None, typer.Option(help="LAZ file to write.")] = None,
    ply: Annotated[Path | None, typer.Option(help="PLY file to write.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Write the point cloud of a run in other formats."""
    with _errors_as_exit_codes(verbose - quiet, run):
        if las is laz is ply is None:
            raise SurveyError("nothing to export was named; give at least one of --las F, --laz F, --ply F")
        from survey.run.export import export as write

        for path in write(run, las=las, laz=laz, ply=ply):
            if verbose >= quiet:
                typer.echo(path)


@app.command()
def render(
    run: RunFolder,
    cameras: Annotated[Path, typer.Option(help="Poses: a table as cameras.csv, or a COLMAP model.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the pictures.")],
    dry: Annotated[bool, typer.Option("--dry", help="Take the water away.")] = False,
    device: Annotated[Device, typer.Option(help="Where it runs.")] = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Render the field of a run as other cameras would see it: colours, heights, distances and normals."""
    with _errors_as_exit_codes(verbose - quiet, output):
        from survey.run.render import render as write

        for path in write(run, cameras, output, dry=dry, device=device.value):
            if verbose >= quiet:
                typer.echo(path)


@app.command()
def compare(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="LAS, LAZ, COPC, PLY or E57.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="PLY, OBJ, GLB, GeoTIFF, or points as CLOUD.")],
    tolerance: Annotated[
        list[float], typer.Option(help="For completeness and F-score [m]; may be given several times.")
    ] = _TOLERANCES_M,
    visible: Annotated[Path | None, typer.Option(help="Points of the reference that cameras see.")] = None,
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="E0 N0 E1 N1", help="Crop the cloud to this."),
    ] = None,
    sign: Annotated[Sign, typer.Option(help="Positive above, or on the side of the winding.")] = Sign.up,
    water_level: Annotated[
        float | None, typer.Option(help="Height of the water in the CRS, for bands of depth; else as the cloud says.")
    ] = None,
    checkpoints: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Check points: easting,northing,height[,sigma].")
    ] = None,
    outliers: Annotated[
        str | None, typer.Option(metavar="sor:K,S", help="Leave statistical outliers out; without it nothing is.")
    ] = None,
    c2c: Annotated[bool, typer.Option("--c2c", help="Distances from cloud to cloud too, both ways.")] = False,
    m3c2: Annotated[
        float | None, typer.Option(metavar="RADIUS", help="M3C2 distances too, cylinders of this radius [m].")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the numbers to this file.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="DIR", help="Write pictures there.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Say how far a cloud is from a reference: signed distances, completeness, F-score."""
    with _errors_as_exit_codes(verbose - quiet, report or json or cloud):
        from survey.compare.comparison import CompareOptions, compare_files
        from survey.compare.text import sections_of

        options = CompareOptions(
            tolerances_m=tuple(tolerance),
            visible=visible,
            bounds=bounds,
            sign=sign.value,
            water_level=water_level,
            checkpoints=checkpoints,
            outliers=outliers,
            c2c=c2c,
            m3c2_radius_m=m3c2,
            json_path=json,
            report_dir=report,
        )
        numbers = compare_files(cloud, reference, options=options)
        if verbose >= quiet:
            for title, rows in sections_of(numbers):
                if title is not None:
                    typer.echo()
                _print_columns(title, rows)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file in TOML (docs/simulation.md).")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="SURVEY", help="Becomes a survey folder.")],
    mode: Annotated[Mode | None, typer.Option(help="Instead of that of the scene file.")] = None,
    flight_only: Annotated[bool, typer.Option("--flight-only", help="Write cameras.csv and flight.png only.")] = False,
    preview: Annotated[bool, typer.Option("--preview", help="One ray per pixel.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Begin anew even if it lies there already.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Make a survey of a scene that is known exactly: photographs, poses, and the truth beside them."""
    with _errors_as_exit_codes(verbose - quiet, output):
        from survey.simulate.simulate import simulate as run
        from survey.simulate.simulate import simulate_flight

        if flight_only:
            simulate_flight(scene, output)
        else:
            run(scene, output, mode=mode.value if mode else None, preview=preview, again=again)


def main() -> None:
    """Entry point of the console command."""
    app()


@contextmanager
def _errors_as_exit_codes(verbosity: int, place: Path) -> Iterator[None]:
    """One sentence on standard error instead of a traceback, and the exit code that says whose fault.

    ``place`` is named where the disk is full or refuses something and does not say what.
    """
    with Progress(verbosity=verbosity) as progress:
        try:
            yield
            return
        except (GeoError, SurveyError) as error:
            code, message = BAD_INPUT, str(error)
        except OSError as error:
            code, message = _of_disk(error, place)
        except KeyboardInterrupt:
            code, message = (
                STOPPED,
                "stopped; what was finished is kept, and the same command goes on from there",
            )
        except typer.Exit:
            raise
        except Exception as error:
            code, message = OUR_BUG, f"{type(error).__name__}: {error}; a fault of bathynerf, -v shows where"
        trace = traceback.format_exc() if code == OUR_BUG else ""
        # A disk that is full takes no log either; the sentence still has to reach the user.
        with suppress(OSError):
            progress.log_only(f"error: {message}\n{trace}".rstrip())
    if trace and verbosity > 0:
        typer.echo(trace, err=True)
    typer.echo(f"error: {message}", err=True)
    raise typer.Exit(code)


def _of_disk(error: OSError, place: Path) -> tuple[int, str]:
    """Exit code and sentence for what the disk refuses."""
    path = error.filename or place
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        mend = "free some and give the same command again; what was finished is kept"
        return BAD_INPUT, f"no room left on the disk to write {path}; {mend}"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return BAD_INPUT, f"no permission to use {path}; change its permissions or name another place"
    if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG):
        return BAD_INPUT, f"{path} cannot be used ({error.strerror}); correct the path"
    return OUR_BUG, f"{type(error).__name__}: {error}; a fault of bathynerf or of the disk, -v shows where"


def _print_section(section: Section) -> None:
    rows = [(f"  {label}" if label else "  -", text) for label, text in section.rows]
    _print_columns(section.title, rows)


def _print_columns(title: str | None, rows: list[tuple[str, str]]) -> None:
    """Labels and texts in two columns, wrapped to the terminal; whole lines in a pipe or file."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 1000
    left = max((len(label) for label, _ in rows), default=0) + 2
    if title is not None:
        typer.secho(title, bold=True)
    for label, text in rows:
        typer.echo(
            textwrap.fill(
                text,
                max(width, left + 20),
                initial_indent=label.ljust(left),
                subsequent_indent=" " * left,
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
