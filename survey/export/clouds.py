"""The cloud as files of points: LAS, LAZ, COPC, PLY, E57."""

from __future__ import annotations

from pathlib import Path

from geo.e57 import require_metres
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.styles import of_clouds
from survey.run.products import write_bed_e57, write_bed_las, write_bed_ply


def write_las(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """LAS, or LAZ or COPC by the suffix."""
    stored, classes = run.bed_in(options.crs), None
    if options.no_bed:
        # It takes the libraries of rasters and shapes.
        from survey.export.unseen import with_unseen

        stored, classes = with_unseen(run, stored, options.crs)
    write_bed_las(path, stored, classes)


write_laz = write_copc = write_las
style_copc = of_clouds


def write_ply(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """PLY."""
    write_bed_ply(path, run.bed_in(options.crs))


def write_e57(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """E57."""
    write_bed_e57(path, run.bed_in(options.crs, certain=True))


def check_e57(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise UnwritableFile where the CRS is not in metres."""
    require_metres(path, run.crs_for(options.crs))
