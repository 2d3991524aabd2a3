"""`bathynerf export`: one option for each product of `survey.export.registry`."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, RunFolder, Verbose, grouped
from survey.export.product import ExportOptions, Product
from survey.export.registry import FAMILIES, PRODUCTS

_made = partial(typer.Option, rich_help_panel="How they are made")
_mesh = partial(typer.Option, rich_help_panel="Meshes")
EXAMPLES = "".join(f"bathynerf export RUN --{product.option} {product.example}\n" for product in PRODUCTS)


@dataclass(frozen=True)
class ProductOptions:
    """Options of how products are made."""

    resolution: Annotated[
        float | None, _made(metavar="M", help="Side of a cell [m]; default: by the density of the points.")
    ] = None
    crs: Annotated[
        str | None,
        _made(metavar="CRS", help="CRS of products, e.g. EPSG:32632; heights are kept unless it has a vertical part."),
    ] = None
    fill: Annotated[
        float, _made(metavar="M", help="Fill gaps up to this width [m]; default: none.", show_default=False)
    ] = 0.0
    mesh_method: Annotated[
        str, _mesh(metavar="METHOD", help="delaunay: one height per place; poisson: with overhangs (extra mesh).")
    ] = "delaunay"
    watertight: Annotated[bool, _mesh("--watertight", help="Close the mesh with walls and a bottom.")] = False
    interval: Annotated[
        float | None,
        _made(metavar="M", help="Contour interval [m]; default: about ten contours."),
    ] = None
    no_bed: Annotated[
        bool, _made("--no-bed", help="Add water without a bed to LAS, LAZ, COPC: class 45, and 41 above it.")
    ] = False
    thin: Annotated[
        str, _made(metavar="none|shoal|mean", help="Thinning of soundings to one per cell; none: keep all.")
    ] = "none"
    survey: Annotated[str | None, _made(metavar="DIR", help="Survey folder, if it was moved since the run.")] = None


@grouped
def run(
    run: RunFolder,
    made: ProductOptions = ProductOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
    **files: Path | None,
) -> None:
    """Write products of a run for other programs.

    A product that exists and is up to date is not written again.
    """
    with command(verbose, quiet, run) as results:
        from survey.export.export import export

        options = ExportOptions(
            crs=made.crs,
            resolution_m=made.resolution,
            fill_m=made.fill,
            mesh_method=made.mesh_method,
            watertight=made.watertight,
            interval_m=made.interval,
            no_bed=made.no_bed,
            survey=made.survey,
            thin=made.thin,
        )
        for path in export(run, options=options, **files):
            results.line(path)


def _parameter(family: str, product: Product) -> inspect.Parameter:
    """The option of a product as Typer reads it, in the panel of its family."""
    place = "DIR" if product.is_folder else "FILE"
    option = typer.Option(f"--{product.option}", metavar=place, help=product.help, rich_help_panel=family)
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(product.option, kind, default=None, annotation=Annotated[Path | None, option])


def _signature() -> inspect.Signature:
    """Signature of `run`, with an option for each product in the place of ``files``."""
    own = inspect.signature(run, eval_str=True).parameters
    products = [_parameter(family, product) for family, members in FAMILIES.items() for product in members]
    first = [own["run"], *products]
    others = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for name, p in own.items() if name not in ("run", "files")]
    return inspect.Signature([*first, *others], return_annotation=None)


# Typer asks for the signature, so that the registry alone lists the products.
vars(run)["__signature__"] = _signature()
