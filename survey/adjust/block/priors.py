"""Initial values and priors of an adjustment."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from refract.lens import MODELS, Lens
from survey.adjust.block.problem import Priors
from survey.adjust.block.roll import Roll, roll_priors, rolled_by_attitudes, rolls_of
from survey.adjust.block.state import (
    BROWN,
    HELD_SHARE,
    LENS_NAMES,
    NUM_LENS,
    NUM_POSE,
    NUM_RELIEF,
    NUM_SHIFT,
    Layout,
    State,
    is_held,
    lenses_of,
)
from survey.folder.observations import rows_between
from survey.folder.pose_priors import BY_POSES, GPS_STD_M, common_up_std
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints

# What holds where survey.toml says nothing: a level read at a staff, an index by the temperature, level water.
LEVEL_STD_M, INDEX_STD, SLOPE_STD = 0.02, 0.001, 0.0
# The same for poses of a file that are to be refined without a word on how good they are.
_POSES_STD_M = 0.05
# Rotations of structure from motion, for photographs with too few matches to turn them: a block bends by far less.
# Those of a file without a word on how good they are start from it; the block then tells how good they are.
ROTATION_STD = math.radians(5.0)
# Poses of an adjusted block.
EXACT_STD_M, EXACT_STD_DEG = 0.01, 0.003
# Of water of which nothing is known, level [m], slopes and index: too wide to affect one that the block determines.
FREE_WATER = (5.0, 0.05, 0.05, 0.1)
# How far a rough bed seems to rise at 45 degrees, as a share of the ground sampling distance (docs/adjustment.md).
_RELIEF_GSD = 0.1
# A ray of 63 degrees off nadir crosses the water two flying heights away.
_SEEN_WATER = 2.0
# A lens by its data sheet: focal lengths are within 2 % of it, the principal point within 1 % of the longer side. At
# the corner of the image each term of distortion moves a pixel by some of these shares of its distance from the middle
# (docs/adjustment.md).
FOCAL_SHARE, _MIDDLE_SHARE, _RADIAL_SHARES, _DECENTRED_SHARE = 0.02, 0.01, (0.06, 0.04, 0.02), 0.004
# By how much smaller than a data sheet's the errors of the lens of an adjusted block are.
_CALIBRATED = 0.02
# The same of a lens whose distortion survey.toml has, of two photographs: they do not calibrate it.
_GIVEN_LENS = 0.05


@dataclass(frozen=True)
class SharedShift:
    """A shift that positions have in common."""

    views: np.ndarray  # (V,) bool: of the positions
    std: np.ndarray  # (3,) [m], local


@dataclass(frozen=True)
class PriorKnowledge:
    """Start values, prior means and standard deviations of the parameters of an adjustment."""

    layout: Layout
    lenses: tuple[Lens, ...]  # Of each number of `Layout.lens_of`, as the survey has it
    state: State  # Where the adjustment starts; without points
    mean: State  # Mean values of the priors; without points
    std: np.ndarray  # (P,): of the priors
    unknown_positions: np.ndarray  # (V,) bool: whose standard deviation is not known, and is `GPS_STD_M` to start with
    # (V, 3) [m]: of the positions before the adjustment, also of those that count for nothing (infinite ``std``)
    # because structure from motion contradicts them; infinite where there is none
    given_std: np.ndarray
    # (V,) bool: of poses of a file, whose standard deviation is not known, and is `ROTATION_STD` to start with
    unknown_rotations: np.ndarray
    # [m]: of an error that the heights of all positions have in common; 0 where something else holds the heights. The
    # block is adjusted with that error: the level of its water counts as that much less certain.
    common_up_std: float = 0.0
    rolls: tuple[Roll, ...] = ()  # That positions on a line leave open
    shifts: tuple[SharedShift, ...] = ()  # Without one of theirs, positions count as independent

    @property
    def pose_std(self) -> np.ndarray:
        """Standard deviations (V, 6) of the poses."""
        return self.std[self.layout.first_pose :].reshape(-1, NUM_POSE)

    @property
    def place_of_water(self) -> tuple[float, float]:
        """Reference point (x, y) [m], local, of the height of the water; the origin for a dry survey."""
        water = self.mean.water
        return (0.0, 0.0) if water is None else (float(water.point[0]), float(water.point[1]))


def prior_of(survey: Survey, gsd: float, *, free_water: bool = False) -> PriorKnowledge:
    """Start values and priors of the parameters, by a survey and its ground sampling distance [m].

    With ``free_water`` nothing is known of the water beforehand. Poses without a stated standard deviation, and their
    lens, then count as those of an adjusted block; so they do where photographs bear them out and contradict the water,
    or the lens, which then counts as that of a data sheet.
    """
    lenses, lens_of, focals = lenses_of(survey.views)
    velocity_per_row, tides = _velocity_per_row(survey), np.array([view.camera.tide for view in survey.views])
    readout_std = survey.config.cameras.rolling_shutter_std_s
    layout = Layout(
        lens_of,
        np.array([lens.focal[1] / lens.focal[0] for lens in lenses]),
        velocity_per_row,
        finds_readouts=velocity_per_row is not None and readout_std is not None,
        tides=tides if tides.any() else None,
        hours=_hours(survey),
        departure=_departure(survey),
        has_ground=survey.observations.ground is not None,
        finds_focals=len(focals) > 0,
    )
    state = _start(survey, layout, lenses, focals)
    contradiction = survey.provenance.contradiction
    exact = (free_water or contradiction is not None) and survey.observations.ties is None
    calibrated = exact and not (contradiction is not None and contradiction.is_of_lens)
    # What clicks in the photographs say of the level is as high as the block.
    is_level_known = survey.provenance.is_level_known and all(
        level.source != "clicks" for level in survey.observations.levels
    )
    shares_height = survey.water is not None and is_level_known and not free_water
    common_up = shared_height_std(survey) if shares_height else 0.0
    positions, given_std, unknown = _positions(survey, state.centres, exact=exact, shares_height=common_up > 0.0)
    # Those that structure from motion contradicts count for nothing.
    of_views = [survey.observations.priors.get(view.name) for view in survey.views]
    rejected = np.array([prior is not None and prior.rejected is not None for prior in of_views], dtype=bool)
    position_std = np.where(rejected[:, None], np.inf, given_std)
    rotation_std, unknown_rotations = _rotations(survey, exact=exact)
    rolls = rolls_of(survey)
    mean = replace(
        state,
        lenses=np.array([_data_sheet(survey, lens) for lens in lenses]),
        centres=positions,
        rotations=rolled_by_attitudes(state.rotations, rolls),
        focals=np.zeros(len(focals)),
    )
    # By a data sheet, a calibration or the settings.
    is_given = len(survey.views) == 2 and survey.config.cameras.distortion is not None
    share = _CALIBRATED if calibrated else _GIVEN_LENS if is_given else 1.0
    of_water = _water_std(survey, free=free_water)
    of_water[0] = math.hypot(of_water[0], common_up)
    std = np.concatenate(
        [
            of_water,
            np.full(NUM_RELIEF, _RELIEF_GSD * gsd),
            _shift_std(survey),
            *(share * _lens_std(lens) for lens in lenses),
            np.full(layout.first_rate - layout.first_readout, readout_std, dtype=np.float64),
            np.full(layout.first_focal - layout.first_rate, _rate_std(survey), dtype=np.float64),
            _focals_std(lens_of, focals, calibrated=calibrated),
            np.concatenate([position_std, rotation_std], axis=1).ravel(),
        ]
    )
    shifts = _shifts(survey, lens_of, unknown) if np.isfinite(given_std[~unknown]).any() else ()
    return PriorKnowledge(
        layout, lenses, state, mean, std, unknown, given_std, unknown_rotations, common_up, rolls, shifts
    )


def _start(survey: Survey, layout: Layout, lenses: tuple[Lens, ...], focals: np.ndarray) -> State:
    """The state that a survey comes with, without points; ``focals`` as of `lenses_of`."""
    centres = np.array([view.camera.centre for view in survey.views])
    num_readouts = 0 if layout.velocity_per_row is None else len(lenses)
    water = survey.water
    if water is not None:
        # With the reference point under the middle of the cameras level and slopes are separate.
        x, y = centres[:, :2].mean(axis=0).tolist()
        water = replace(water, point=(x, y, float(water.height(x, y))))
    return State(
        water,
        np.zeros(NUM_RELIEF),
        np.array([parameters_of(lens) for lens in lenses]),
        centres,
        np.array([view.camera.cam_from_local for view in survey.views]),
        np.zeros((0, 3)),
        np.full(num_readouts, survey.config.cameras.rolling_shutter_s, dtype=np.float64),
        shift=np.zeros(NUM_SHIFT if layout.has_ground else 0),
        focals=focals,
    )


def priors_for(prior: PriorKnowledge, ties: TiePoints, point_std: np.ndarray | None = None) -> Priors:
    """The priors of an adjustment with these points, known to (M, 3) [m] where any are."""
    free = np.full((len(ties), 3), np.inf) if point_std is None else point_std
    rows, signs = roll_priors(prior.rolls, prior.layout, prior.std)
    shared = without_shifts(prior, prior.std**-2.0)
    rows, signs = np.concatenate([rows, shared]), np.concatenate([signs, np.full(len(shared), -1.0)])
    return Priors(replace(prior.mean, points=ties.start), prior.std, free, rows, signs)


def without_shifts(prior: PriorKnowledge, precision: np.ndarray) -> np.ndarray:
    """Rows (3 S, P) of `Priors` that take out what S shifts explain of the deviations of their positions.

    ``precision`` (P,) are the inverse variances of the parameters. With deviations d and weights w, the least over a
    shift b of standard deviation s of ``sum w (d - b)^2 + b^2 / s^2`` is
    ``sum w d^2 - (sum w d)^2 / (sum w + 1 / s^2)``.
    """
    rows = np.zeros((len(prior.shifts), 3, len(prior.layout)))
    for of_shift, shift in zip(rows, prior.shifts, strict=True):
        for axis in range(3):
            at = prior.layout.first_pose + axis + NUM_POSE * np.flatnonzero(shift.views)
            weights = precision[at]
            of_shift[axis, at] = weights / math.sqrt(weights.sum() + shift.std[axis] ** -2.0)
    return rows.reshape(-1, len(prior.layout))


def _shifts(survey: Survey, lens_of: np.ndarray, unknown: np.ndarray) -> tuple[SharedShift, ...]:
    """Of positions of unknown accuracy beside stated ones: those of a flight, by its camera, are off together."""
    priors = [survey.observations.priors.get(view.name) for view in survey.views]
    up = np.array([0.0 if prior is None else (prior.rejected or prior).common_up_std for prior in priors])
    groups = [unknown & (lens_of == number) for number in np.unique(lens_of[unknown])]
    return tuple(SharedShift(own, np.maximum(GPS_STD_M, [0.0, 0.0, up[own].max()])) for own in groups)


def _shift_std(survey: Survey) -> np.ndarray:
    """Std of the shift of an earlier survey (3,) [m]; empty without one."""
    ground = survey.observations.ground
    if ground is None:
        return np.zeros(0)
    horizontal, vertical = ground.std_m
    return np.maximum([horizontal, horizontal, vertical], HELD_SHARE)


def _velocity_per_row(survey: Survey) -> np.ndarray | None:
    """See `Layout.velocity_per_row`; zero for views whose velocity is not known."""
    cameras = survey.config.cameras
    if not cameras.rolls:
        return None
    velocity_per_row = np.zeros((len(survey.views), 3))
    for number, view in enumerate(survey.views):
        velocity = survey.observations.velocities.get(view.name)
        if velocity is not None:
            velocity_per_row[number] = velocity.local / rows_between(view.lens.height)
    return velocity_per_row if velocity_per_row.any() else None


def _rate_std(survey: Survey) -> float | None:
    return None if survey.config.water is None else survey.config.water.level_rate_std_m_per_h


def _departure(survey: Survey) -> Callable[[np.ndarray], np.ndarray] | None:
    """Departure of the water from its plane where the photographs look; None where none is given."""
    departure = survey.observations.departure
    if survey.water is None or departure is None:
        return None
    centres = np.array([view.camera.centre for view in survey.views])
    # Oblique photographs look at water that far away, in flying heights.
    reach = _SEEN_WATER * float(np.max(-survey.water.depth(centres)))
    low, high = centres[:, :2].min(axis=0) - reach, centres[:, :2].max(axis=0) + reach
    return departure.interpolated((*low.tolist(), *high.tolist()))


def _hours(survey: Survey) -> np.ndarray | None:
    """See `Layout.hours`."""
    if survey.water is None or survey.observations.tide is None or _rate_std(survey) is None:
        return None
    return np.array([survey.observations.tide.hours[view.name] for view in survey.views])


def _water_std(survey: Survey, *, free: bool) -> np.ndarray:
    if survey.water is None:
        return np.full(4, HELD_SHARE)
    if free:
        return np.array(FREE_WATER)
    given = survey.require_water()[1]
    stated = (given.level_std_m, LEVEL_STD_M), (given.slope_std, SLOPE_STD), (given.index_std, INDEX_STD)
    level, slope, index = (default if std is None else std for std, default in stated)
    return np.maximum([level, slope, slope, index], HELD_SHARE)


def shared_height_std(survey: Survey) -> float:
    """Common standard deviation [m] of the heights of positions, where these alone determine that of the block."""
    given = survey.observations
    is_held = given.control is not None and any(not point.is_check for point in given.control.points)
    is_held = is_held or given.ground is not None
    return 0.0 if given.ties is None or is_held else common_up_std(given.priors)


def _positions(survey: Survey, centres: np.ndarray, *, exact: bool, shares_height: bool):
    """Mean positions (V, 3), their standard deviations (V, 3), and which of these are not known (V,)."""
    positions, std = centres.copy(), np.full(centres.shape, np.inf)
    unknown = np.zeros(len(centres), dtype=bool)
    for number, view in enumerate(survey.views):
        prior = survey.observations.priors.get(view.name)
        prior = prior if prior is None or prior.rejected is None else prior.rejected
        if prior is None or prior.position is None:
            continue
        positions[number] = prior.position
        # A common error says nothing of single positions, however large; with two positions nothing else determines it.
        if prior.position_std is not None and (not shares_height or len(survey.views) == 2):
            std[number] = prior.position_std
        elif exact:
            std[number] = EXACT_STD_M
        else:
            unknown[number] = True
            std[number] = GPS_STD_M if survey.observations.ties is not None else _POSES_STD_M
    return positions, std, unknown


def _rotations(survey: Survey, *, exact: bool):
    """Standard deviations (V, 3) [rad] of the rotations that the views come with, and which are not known (V,).

    Errors of rotations by structure from motion are correlated (bending, tilt of the block), so that their scatter in
    the block is not a measure of them.
    """
    std = np.full((len(survey.views), 3), math.radians(EXACT_STD_DEG) if exact else ROTATION_STD)
    unknown = np.zeros(len(survey.views), dtype=bool)
    for number, view in enumerate(survey.views):
        prior = survey.observations.priors.get(view.name)
        if prior is None:
            continue
        if prior.rotation_std_deg is not None:
            # About the axes of local; where they differ, those of cam get the largest.
            std[number] = math.radians(float(np.max(prior.rotation_std_deg)))
        else:
            unknown[number] = not exact and prior.source == BY_POSES and survey.provenance.tool is None
    return std, unknown


def parameters_of(lens: Lens) -> np.ndarray:
    """A lens as parameters (8,) of the adjustment."""
    if is_held(lens):
        # Its tie points are straightened: what is left is its pinhole.
        return np.array([lens.focal[0], lens["cx"], lens["cy"], *np.zeros(NUM_LENS - 3)])
    return np.array([lens.focal[0], *(lens[name] for name in LENS_NAMES[1:])])


def _data_sheet(survey: Survey, lens: Lens) -> np.ndarray:
    """The lens before any photograph was taken with it.

    Straight rays take some of the bend at the water into the focal length: of photographs without poses that in EXIF
    counts, not that of structure from motion.
    """
    given = parameters_of(lens)
    cameras = survey.config.cameras
    if survey.observations.ties is None or is_held(lens) or cameras.poses is not None:
        return given
    focal = cameras.focal_px[0] if isinstance(cameras.focal_px, tuple) else cameras.focal_px
    if focal is None:
        in_exif = survey.observations.exif_focals
        focal = next((in_exif[view.name] for view in survey.views if view.lens == lens and view.name in in_exif), None)
    middle = cameras.principal_point_px or (0.5 * lens.width, 0.5 * lens.height)
    names = MODELS[cameras.model][1] if cameras.model in BROWN else ()
    given_by_name = dict(zip([name for name in names if name[0] in "kp"], cameras.distortion or (), strict=False))
    coefficients = [given_by_name.get(name, 0.0) for name in LENS_NAMES[3:]]
    return np.array([given[0] if focal is None else focal, *middle, *coefficients])


def _lens_std(lens: Lens) -> np.ndarray:
    focal, side = lens.focal[0], max(lens.width, lens.height)
    corner = 0.5 * math.hypot(lens.width, lens.height) / focal
    radial = np.array(_RADIAL_SHARES) / corner ** np.array([2, 4, 6])
    decentred = _DECENTRED_SHARE / corner
    middle = _MIDDLE_SHARE * side
    std = np.array([FOCAL_SHARE * focal, middle, middle, *radial, decentred, decentred])
    return HELD_SHARE * std if is_held(lens) else std


def _focals_std(lens_of: np.ndarray, focals: np.ndarray, *, calibrated: bool) -> np.ndarray:
    """Std of the focal lengths of photographs (V,): their scatter about that of their lens; held where it has none."""
    if not len(focals):
        return focals
    scatter = np.sqrt(np.bincount(lens_of, focals**2) / np.bincount(lens_of))
    std = np.where(scatter > 0.0, _CALIBRATED * FOCAL_SHARE, 0.0) if calibrated else scatter
    return np.maximum(std, HELD_SHARE * FOCAL_SHARE)[lens_of]
