"""Initial heights of a block whose positions lie below its water, as by a barometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.findings import Findings
from survey.folder.block import Block
from survey.folder.place import over_points
from survey.folder.plausible import most_over_water
from survey.folder.pose_priors import common_up_std
from survey.photos.cameras import View


def block_over_water(block: Block, views: list[View], water: FlatWater | None) -> tuple[Block, list[View], Findings]:
    """The block, and its views; where all cameras lie under the water or far above it, at a height where they do not.

    Only of positions whose heights have an error in common that the adjustment finds from the water; a warning says by
    how much.

    Parameters
    ----------
    block : Block
    views : list of View
        Those of the block, with all else that is known of them.
    water : FlatWater or None
        Whose level is known.
    """
    if water is None or block.ties is None or block.control is not None or common_up_std(block.priors) == 0.0:
        return block, views, Findings()
    centres = np.array([view.camera.centre for view in views])
    over = -water.depth(centres)
    most_m = most_over_water([view.camera for view in views])
    if over.min() > 0.0 and over.max() < most_m:
        return block, views, Findings()
    x, y, _ = np.median(centres, axis=0).tolist()
    up = float(water.height(x, y)) - over_points(block.ties.start, centres)
    said = "under the water" if over.min() <= 0.0 else f"more than {most_m:.0f} m over the water"
    warning = (
        f"by the heights of their positions, cameras lie {said} ({over.min():.1f} to {over.max():.1f} m over it): the "
        "level of the water decides how high the block lies; check that level_m is right, and in the datum of crs"
    )
    shift = np.array([0.0, 0.0, up])
    ties = replace(block.ties, start=block.ties.start + shift)
    views = [replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in views]
    return replace(block, ties=ties, points=ties.start), views, Findings(warnings=(warning,))
