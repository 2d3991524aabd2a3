"""Words offered for a run, and names of folders and files, that several parts of survey agree on."""

from __future__ import annotations

from enum import StrEnum

# The run folder in a survey folder, where no other is named.
RUN_FOLDER = "bathynerf"
# In a run folder: what structure from motion keeps.
SFM_FOLDER = "sfm"
# Positions of photographs, as OpenDroneMap has them.
GEO_TXT = "geo.txt"
# Where OpenDroneMap looks for control points.
GCP_LIST = "gcp_list.txt"


class Quality(StrEnum):
    """Qualities, by the time that is spent; `survey.plan.recipe` says what each means."""

    draft = "draft"
    standard = "standard"
    fine = "fine"


class Device(StrEnum):
    """Devices of the kernels."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Field(StrEnum):
    """Refinement of the heights of the sweep: as the plan decides, least squares, with boxes, the slab, or nothing."""

    auto = "auto"
    solver = "solver"
    boxes = "boxes"
    slab = "slab"
    off = "off"


class Plan(StrEnum):
    """Whether what a scene does not need is left out, or nothing is."""

    auto = "auto"
    full = "full"


class Poses(StrEnum):
    """Treatment of the poses: as the plan decides, taken as they are, or adjusted."""

    auto = "auto"
    fixed = "fixed"
    refine = "refine"


# Of photographs: each is half of the one before.
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)
