"""A photograph with its camera in the local frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract import FlatWater, PinholeCamera
from refract.lens import Lens


@dataclass(frozen=True)
class View:
    """Photograph with its camera."""

    name: str  # Path of the image below the image folder, with forward slashes
    path: Path
    camera: PinholeCamera  # Of the photograph as it was taken, lens distortion included; local frame, at full size
    lens: Lens  # Interior orientation, as the poses file or survey.toml gives it
    mask_path: Path | None = None  # Image of the stored size; black is left out


def metres_per_px(views: Sequence[View], water: FlatWater | None) -> float | None:
    """Ground sampling distance [m/px] on the water under the cameras, median; None for a dry survey."""
    if water is None:
        return None
    return float(np.median([-float(water.depth(view.camera.centre)) / view.lens.focal[1] for view in views]))
