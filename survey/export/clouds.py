"""The cloud as files of points: LAS, LAZ, COPC, PLY, E57."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.product import ExportOptions, Product, begins_with
from survey.export.styles import of_clouds

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun

_KIND = "a cloud that bathynerf wrote"
# Where the header of LAS says which system made it.
_LAS_SYSTEM = slice(26, 58)


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


def _is_our_e57(path: Path) -> bool:
    from geo.e57 import is_our_e57

    return is_our_e57(path)


def is_our_las(path: Path) -> bool:
    """Whether a file is LAS or LAZ whose header names bathynerf as the system that made it."""
    with path.open("rb") as stream:
        head = stream.read(_LAS_SYSTEM.stop)
    return head.startswith(b"LASF") and head[_LAS_SYSTEM].startswith(b"bathynerf")


CLOUDS = (
    Product(
        option="las",
        suffixes=(".las",),
        kind=_KIND,
        help="Points as LAS 1.4.",
        example="--las bed.las",
        takes=("crs", "no_bed"),
        is_ours=is_our_las,
        write=_write_las,
    ),
    Product(
        option="laz",
        suffixes=(".laz",),
        kind=_KIND,
        help="Points as LAZ, LAS compressed.",
        example="--laz bed.laz --crs EPSG:4326",
        takes=("crs", "no_bed"),
        is_ours=is_our_las,
        write=_write_las,
    ),
    Product(
        option="copc",
        suffixes=(".copc.laz",),
        kind=_KIND,
        help="Points as cloud-optimised LAZ, from which readers fetch parts.",
        example="--copc bed.copc.laz",
        takes=("crs", "no_bed"),
        is_ours=is_our_las,
        write=_write_las,
        style=of_clouds,
    ),
    Product(
        option="ply",
        suffixes=(".ply",),
        kind=_KIND,
        help="Points as binary PLY in double precision.",
        example="--ply bed.ply",
        takes=("crs",),
        is_ours=begins_with(b"ply\n", b"\ncomment bathynerf\n"),
        write=_write_ply,
    ),
    Product(
        option="e57",
        suffixes=(".e57",),
        kind=_KIND,
        help="Places and colours of the points as E57 (needs the extra e57).",
        example="--e57 bed.e57",
        takes=("crs",),
        is_ours=_is_our_e57,
        write=_write_e57,
        libraries={".e57": ("pye57", "e57")},
        check=_check_e57,
    ),
)
