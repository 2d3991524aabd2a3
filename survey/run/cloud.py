"""The cloud of a run as LAS, LAZ, COPC, PLY or E57."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geo.e57 import write_e57
from geo.las import write_cloud
from geo.ply import write_ply
from geo.verified import write_verified
from survey.run.stored import StoredBed


def write_bed_las(path: Path, stored: StoredBed, classification: np.ndarray | None = None) -> None:
    """The cloud as LAS, or LAZ or COPC by the suffix, with classes (N,) other than its own; see `geo.write_cloud`."""
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
        classification=classification,
        origin=bed.origin,
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
    points, crs = stored.points_crs, stored.crs
    write_verified(path, lambda copy: write_ply(copy, points, rgb=bed.rgb, scalars=scalars, crs=crs), points, None, crs)


def write_bed_e57(path: Path, stored: StoredBed) -> None:
    """Places and colours as E57; see `geo.e57.write_e57`."""
    points, crs, rgb = stored.points_crs, stored.crs, stored.bed.rgb
    write_verified(path, lambda copy: write_e57(copy, points, crs, rgb=rgb), points, None, crs)
