"""The methods that are compared: the whole chain, parts of it, and what there was before it.

Baselines get the same photographs, poses and sweep as the whole chain; only the refraction is taken away, by a survey
without water, and put back afterwards as the literature does.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """One way from photographs to a cloud.

    Attributes
    ----------
    name : str
    words : str
        For tables and pictures.
    field : str
        The option of `process`.
    is_refracted : bool
        False: the survey is processed as if it were dry.
    correction : "", "times_index" or "per_camera"
        What is done to the depths of the cloud afterwards, see `survey.benchmark.corrected`.
    """

    name: str
    words: str
    field: str = "auto"
    is_refracted: bool = True
    correction: str = ""


METHODS = {
    method.name: method
    for method in (
        Method("full", "whole chain"),
        Method("sweep", "sweep alone", field="off"),
        Method("slab", "trained field", field="slab"),
        Method("straight", "straight rays", is_refracted=False),
        Method("times_index", "straight rays, depth times n", is_refracted=False, correction="times_index"),
        Method("per_camera", "straight rays, corrected per camera", is_refracted=False, correction="per_camera"),
    )
}
