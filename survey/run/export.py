"""`bathynerf export`: the cloud of a finished run in the requested formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from geo.las import write_cloud
from geo.ply import write_ply
from survey.errors import SurveyError
from survey.files.outputs import require_file
from survey.progress import current
from survey.run.folder import RunDir
from survey.run.stored import StoredBed, load_bed

# The stage whose folder holds the cloud.
BED_STAGE = "bed"
# Where the header of LAS says which system made it.
_LAS_SYSTEM = slice(26, 58)


def export(
    run: str | Path, *, las: str | Path | None = None, laz: str | Path | None = None, ply: str | Path | None = None
) -> list[Path]:
    """Write the point cloud of a run, each file whole or not at all.

    Parameters
    ----------
    run : Path
        Folder that `bathynerf process` made.
    las, laz : Path, optional
        LAS 1.4, as cloud.las of the run is, or the same compressed.
    ply : Path, optional
        Binary PLY in crs with double coordinates, and depth_m, std_m, std_common_m, num_views and incidence_deg.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    SurveyError
        If nothing is asked for, a name does not end as its format does, the folder is no run, or the run has
        not come as far as the cloud.
    OutputError
        If a file must not be written, see `survey.files.outputs`: a file that is there is replaced only where bathynerf
        wrote it.
    GeoError
        If a file cannot be written.
    """
    formats = {".las": las, ".laz": laz, ".ply": ply}
    wanted = {suffix: Path(path) for suffix, path in formats.items() if path is not None}
    if not wanted:
        raise SurveyError("nothing to export was named; give at least one of --las F, --laz F, --ply F")
    for suffix, path in wanted.items():
        _require_suffix(path, suffix)
    folder = RunDir(run)
    folder.require_run()
    for suffix, path in wanted.items():
        option = suffix.replace(".", "--")
        require_file(option, path, folder.inputs(), kind="a cloud that bathynerf wrote", is_of_kind=is_our_cloud)
    stored = load_bed(folder.load_stage(BED_STAGE))
    folder.warn_if_unfinished()
    writers: dict[str, Callable[[Path, StoredBed], None]] = {".ply": write_bed_ply}
    with current().stage("Export", len(wanted)) as stage:
        for suffix, path in wanted.items():
            writers.get(suffix, write_bed_las)(path, stored)
            stage.advance()
    return list(wanted.values())


def write_bed_las(path: Path, stored: StoredBed) -> None:
    """The cloud as LAS, or LAZ by the suffix; see `geo.write_cloud`."""
    bed = stored.bed
    write_cloud(
        path,
        stored.points_crs,
        stored.crs,
        rgb=bed.rgb,
        depth_m=bed.depth,
        std_m=bed.std,
        num_views=bed.num_views,
        incidence_deg=np.degrees(bed.incidence),
        is_wet=bed.wet,
        std_common_m=stored.std_common,
    )


def write_bed_ply(path: Path, stored: StoredBed) -> None:
    """The cloud as PLY; see `geo.write_ply`."""
    bed = stored.bed
    scalars = {
        "depth_m": bed.depth,
        "std_m": bed.std,
        "std_common_m": np.full(len(bed), np.nan) if stored.std_common is None else stored.std_common,
        "num_views": bed.num_views,
        "incidence_deg": np.degrees(bed.incidence),
    }
    write_ply(path, stored.points_crs, rgb=bed.rgb, scalars=scalars)


def is_our_cloud(head: bytes) -> bool:
    """Whether a file that begins so is a cloud that bathynerf wrote."""
    if head.startswith(b"LASF"):
        return head[_LAS_SYSTEM].startswith(b"bathynerf")
    return head.startswith(b"ply\n") and b"\ncomment bathynerf\n" in head


def _require_suffix(path: Path, suffix: str) -> None:
    if path.suffix.lower() != suffix:
        option = suffix.replace(".", "--")
        raise SurveyError(f"{option} names {path}; expected a name that ends in {suffix}")
