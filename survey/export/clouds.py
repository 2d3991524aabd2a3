"""The cloud as files of points: LAS, LAZ, COPC, PLY, E57."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation.standards import TO_95, TO_95_IN_PLAN
from geo.e57 import require_metres
from survey.errors import SurveyError
from survey.export.hydrography import plan_std
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.styles import of_clouds
from survey.run.products import write_bed_e57, write_bed_las, write_bed_ply
from survey.run.stored import StoredBed


def write_las(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """LAS, or LAZ or COPC by the suffix."""
    stored, classes = run.classified_in(options.crs)
    if options.no_bed:
        # It takes the libraries of rasters and shapes.
        from survey.export.unseen import with_unseen

        stored, classes = with_unseen(run, stored, classes, options.crs)
    write_bed_las(path, stored, classes, total_uncertainty(run, stored) if options.tpu else None)


def total_uncertainty(run: LoadedRun, stored: StoredBed) -> tuple[np.ndarray, np.ndarray]:
    """Vertical and horizontal uncertainty of the points at 95 %, two of (N,) float32 [m], all parts included."""
    if stored.std_common is None or stored.std_plan is None:
        raise SurveyError(
            f"the points of {run.folder.path} have no standard deviation in plan; process the survey again for --tpu"
        )
    bed, water = stored.bed, run.config.water
    sine = np.sin(bed.incidence)
    if water is not None and water.refractive_index is not None:
        sine = np.where(bed.wet, sine / water.refractive_index, sine)
    vertical = TO_95 * np.hypot(bed.std, stored.std_common)
    horizontal = TO_95_IN_PLAN * plan_std(bed.std, sine, stored.gsd_m, stored.std_plan)
    return vertical.astype(np.float32), horizontal.astype(np.float32)


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
