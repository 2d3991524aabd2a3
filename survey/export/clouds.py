"""The cloud as files of points: LAS, LAZ, COPC, PLY, E57."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.product import ExportOptions, Product
from survey.export.styles import of_clouds

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun


def _write_las(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from survey.run.products import write_bed_las

    stored, classes = run.bed_in(options.crs), None
    if options.no_bed:
        from survey.export.outlines import with_unseen

        stored, classes = with_unseen(run, stored, options.crs)
    write_bed_las(path, stored, classes)


def _write_ply(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from survey.run.products import write_bed_ply

    write_bed_ply(path, run.bed_in(options.crs))


def _write_e57(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from survey.run.products import write_bed_e57

    write_bed_e57(path, run.bed_in(options.crs, certain=True))


def _check_e57(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from geo.e57 import require_metres

    require_metres(path, run.crs_for(options.crs))


CLOUDS = (
    Product(
        "las", (".las",), help="Points as LAS 1.4.", example="--las bed.las", takes=("crs", "no_bed"), write=_write_las
    ),
    Product(
        "laz",
        (".laz",),
        help="Points as LAZ, LAS compressed.",
        example="--laz bed.laz --crs EPSG:4326",
        takes=("crs", "no_bed"),
        write=_write_las,
    ),
    Product(
        "copc",
        (".copc.laz",),
        help="Points as cloud-optimised LAZ, from which readers fetch parts.",
        example="--copc bed.copc.laz",
        takes=("crs", "no_bed"),
        write=_write_las,
        style=of_clouds,
    ),
    Product(
        "ply",
        (".ply",),
        help="Points as binary PLY in double precision.",
        example="--ply bed.ply",
        takes=("crs",),
        write=_write_ply,
    ),
    Product(
        "e57",
        (".e57",),
        help="Places and colours of the points as E57 (needs the extra e57).",
        example="--e57 bed.e57",
        takes=("crs",),
        write=_write_e57,
        check=_check_e57,
    ),
)
