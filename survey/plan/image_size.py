"""Working size of photographs: halved to the megapixels of the quality, or as requested."""

from __future__ import annotations

import math

from refract import PinholeCamera
from survey.plan.recipe import AIMED, Recipe
from survey.plan.skipped import Decision


def image_decision(camera: PinholeCamera, scale: float, quality: str, recipe: Recipe, *, asked: bool) -> Decision:
    """Line of the plan on the working size."""
    size = f"images of {camera.width} x {camera.height} px"
    if asked:
        return Decision("image scale", f"{scale:g}", f"set by --image-scale, for {size}")
    if quality == AIMED:
        reason = f"of {size}; each round has its own, and poses are looked at with that of standard"
        return Decision("image scale", f"{scale:g}", reason)
    if scale == 1.0:
        return Decision("image scale", "1", f"{size} are worked on whole")
    limit = f"at most {recipe.megapixels:g} Mpx for {quality} quality"
    return Decision("image scale", f"{scale:g}", f"{size} are halved until they have {limit}")


def image_scale(width: int, height: int, megapixels: float) -> float:
    """Scale [-], at most 1, that reduces an image of a size [px] to a limit [px]."""
    halvings = math.ceil(0.5 * math.log2(width * height / (1e6 * megapixels)) - 1e-9)
    return 0.5 ** max(halvings, 0)
