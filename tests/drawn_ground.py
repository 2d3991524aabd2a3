"""Drawn blocks over a bed and a bank of one smooth relief, the bank surveyed before, and positions off by a shift."""

from dataclasses import replace

import numpy as np

from survey.control.points import StableGround
from survey.folder.survey import Survey
from survey.settings.tables import ControlConfig
from tests.block_survey import survey_of, with_shift
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, draw_block

# Of the earlier survey: noise of a point, and spacing [m].
NOISE_M, SPACING_M = 0.03, 0.25


def drawn_on_ground(
    seed: int,
    *,
    shift: tuple[float, float, float] = (0.4, -0.3, 0.5),
    std_m: tuple[float, float] = (0.03, 0.03),
    relief_m: float = 0.25,
    changed_share: float = 0.0,
    num_points: int = 900,
    num_control: int = 0,
) -> tuple[DrawnBlock, Survey]:
    """A block, and it as a survey whose GPS is off by a shift, with an earlier survey of its dry ground.

    ``std_m`` is that of the shift of the earlier survey, across and in height; on ``changed_share`` of the bank it is
    a metre higher than the ground is now.
    """
    rng = np.random.default_rng([seed, 36])
    toward, waves = rng.uniform(0.0, 2.0 * np.pi), rng.normal(0.0, 1.0, (6, 2)) * 0.9
    phases = rng.uniform(0.0, 2.0 * np.pi, 6)
    half_of = {}

    def height(places: np.ndarray) -> np.ndarray:
        """Over the water [m]."""
        along = places @ np.array([np.sin(toward), np.cos(toward)]) / half_of["half"]
        return 2.5 * (along - half_of["shore"]) + relief_m * np.sin(places @ waves.T + phases).mean(axis=1) * np.sqrt(6)

    def bed(rng, plane, half, _depth, num_points, dry_share):
        places = rng.uniform(-half, half, (num_points, 2))
        half_of["half"] = float(np.mean(half))
        along = places @ np.array([np.sin(toward), np.cos(toward)]) / half_of["half"]
        half_of["shore"] = float(np.quantile(along, 1.0 - dry_share))
        half_of["extent"] = half
        return np.column_stack([places, plane.height(*places.T) + height(places)])

    block = draw_block(
        seed, bed=bed, num_points=num_points, num_control=num_control, dry_share=0.35, num_views=18, nadir_only=False
    )
    survey = with_shift(survey_of(block), shift, 3.0)
    x, y = (np.arange(-1.1 * side, 1.1 * side, SPACING_M) for side in half_of["extent"])
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    places = places + rng.uniform(-0.3, 0.3, places.shape) * SPACING_M
    above = height(places)
    dry = above > 0.15
    ground = np.column_stack([places, block.plane.height(*places.T) + above])[dry]
    ground[:, 2] += NOISE_M * rng.standard_normal(len(ground))
    if changed_share > 0.0:
        across = ground[:, :2] @ np.array([np.cos(toward), -np.sin(toward)])
        ground[across > np.quantile(across, 1.0 - changed_share), 2] += 1.0
    horizontal, vertical = std_m
    ground += rng.standard_normal(3) * [horizontal, horizontal, vertical]
    control = ControlConfig(reference="earlier.las", reference_std_m=std_m)
    return block, changed(survey, ground=StableGround(ground, std_m), config=replace(survey.config, control=control))


def with_stated_positions(block: DrawnBlock, survey: Survey) -> Survey:
    """The survey with the accuracy that its positions have."""
    priors = survey.observations.priors
    return changed(
        survey, priors={name: replace(prior, position_std=block.position_std) for name, prior in priors.items()}
    )
