"""Run folders with a cloud in them and nothing else, for tests of what is exported."""

from pathlib import Path

import numpy as np
from small_bed import plane_bed
from small_survey import small_survey

from fields.sweep.bed import BedPoints
from survey.folder.survey import load_survey
from survey.run.folder import RunDir
from survey.run.stored import StoredBed, save_bed

GSD_M = 0.02


def plane_stored(folder: Path) -> StoredBed:
    """The plane of `small_bed` over the small survey, which is made in a folder."""
    survey = load_survey(small_survey(folder))
    bed = plane_bed(survey)
    return StoredBed(bed, survey.frame.crs_from_local(bed.xyz), survey.frame.crs, "Flußbett & Ufer", GSD_M)


def run_of(stored: StoredBed, path: Path, **parts: str) -> Path:
    """A run whose result is a cloud; ``parts`` are those of the key of its stage."""
    with RunDir(path) as run:
        folder = run.open_stage("bed")
        save_bed(folder, stored)
        folder = run.finish_stage("bed", parts, folder)
        run.publish(run.open_result("standard"), quality="standard", stages={"bed": folder})
    return run.path


def stored_points(
    points_crs: np.ndarray, crs, *, std_m=0.01, level_m: float | None = None, gsd_m: float = GSD_M, name: str = "drawn"
) -> StoredBed:
    """Points (N, 3) in crs as a run would store them, under level water or dry."""
    n = len(points_crs)
    depth = np.full(n, np.nan) if level_m is None else level_m - points_crs[:, 2]
    bed = BedPoints(
        xyz=points_crs - points_crs.mean(axis=0),
        rgb=np.full((n, 3), 100, dtype=np.uint8),
        std=np.broadcast_to(np.float32(std_m), n).copy(),
        num_views=np.full(n, 5, dtype=np.uint8),
        depth=depth.astype(np.float32),
        incidence=np.full(n, 0.2, dtype=np.float32),
        wet=depth > 0.0,
    )
    return StoredBed(bed, points_crs, crs, name, gsd_m)
