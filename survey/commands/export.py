"""`bathynerf export`: one option for each product of `survey.export.registry`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, RunFolder, Verbose, grouped
from survey.export.product import ExportOptions, Product
from survey.export.registry import FAMILIES, PRODUCTS

EXAMPLES = "".join(f"bathynerf export RUN --{product.option} {product.example}\n" for product in PRODUCTS)


@grouped
def run(
    run: RunFolder,
    made: ExportOptions = ExportOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
    **files: Path | None,
) -> None:
    """Write products of a run for other programs.

    A product that exists and is up to date is not written again.
    """
    with command(verbose, quiet, run) as results:
        from survey.export.export import export

        for path in export(run, options=made, **files):
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
