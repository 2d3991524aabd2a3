"""The unknowns of an adjustment: water, lenses with their focal lengths, poses and points, and their update by a step.

The vector of parameters is [water (4) | relief (3) | shift | lenses (8 each) | readouts | rate | focals | poses (6
each)]; points have three each besides.

    water     height of the plane at its reference point [m], slopes along local x and y, index
    relief    by how much a rough bed seems to rise with the direction of view, see `apparent_rise_design` [m]
    shift     by how much an earlier survey is to be moved [m], local, where the block lies on one; else none
    lens      `LENS_NAMES`; the ratio of both focal lengths is held
    readouts  seconds from the first to the last row, of each lens, where they are to be found; else none
    rate      by how much faster the water rises than was given [m/h], where that is to be found; else none
    focals    focal length of each photograph over that of its lens, less one, where they differ; else none
    pose      centre [m] along the axes of local, turn [rad] about the axes of cam
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from refract import FlatWater, distortion
from refract.lens import MODELS, Lens, is_affine
from survey.folder.local_frame import water_plane
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.settings.config import WaterConfig

# Std of parameters that are held, as a share of what would be noticed.
HELD_SHARE = 1e-9
# Models whose distortion is Brown's; other lenses are held, and their tie points straightened.
BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FOCAL_NAMES = ("f", "fx", "fy")
# Fewer focal lengths that differ are those of several cameras, not the scatter of one.
LEAST_FOCALS = 5
# Of ratios of both focal lengths, of thousands of pixels written with three decimals.
_SAME_RATIO = 1e-6


def is_held(lens: Lens) -> bool:
    """Whether a lens is not adjusted: its distortion is not Brown's. Of an affine one Brown's part is adjusted."""
    return not is_affine(lens) and (lens.model not in BROWN or any(lens[name] != 0.0 for name in ("k4", "k5", "k6")))


def enlarged(lens: Lens, factor: float) -> Lens:
    """A lens with its focal lengths times a factor."""
    names = MODELS[lens.model][1]
    params = tuple(p * factor if name in _FOCAL_NAMES else p for name, p in zip(names, lens.params, strict=True))
    return replace(lens, params=params)


def lenses_of(views: Sequence[View]) -> tuple[tuple[Lens, ...], np.ndarray, np.ndarray]:
    """Lenses (L) of V photographs, their numbers (V,), and focal lengths (V,) over those of the lenses, less one.

    Lenses that differ in nothing but their focal length, of `LEAST_FOCALS` different focal lengths or more, as an
    adjustment with autofocus writes them, are one with the mean of the focal lengths. All others are kept as they are;
    where no focal lengths differ, there are none.
    """
    each = [view.lens for view in views]
    focal = np.array([lens.focal[0] for lens in each])
    common, focals = list(each), np.zeros(len(each))
    for alike in _groups_but_for_focal(each):
        first = each[alike[0]]
        if is_held(first) or len(np.unique(focal[alike])) < LEAST_FOCALS:
            continue
        mean = focal[alike].mean()
        lens = enlarged(first, float(mean) / first.focal[0])
        focals[alike] = focal[alike] / mean - 1.0
        for photograph in alike:
            common[photograph] = lens
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(common))}
    lens_of = np.array([numbers[lens] for lens in common], dtype=np.int64)
    return tuple(numbers), lens_of, focals if focals.any() else np.zeros(0)


def _groups_but_for_focal(lenses: Sequence[Lens]) -> list[list[int]]:
    """Groups of the numbers of lenses that differ in nothing but their focal length, of one ratio of both of them."""
    groups = defaultdict(list)
    for number, lens in enumerate(lenses):
        named = zip(MODELS[lens.model][1], lens.params, strict=True)
        other_params = tuple(p for name, p in named if name not in _FOCAL_NAMES)
        groups[lens.model, lens.width, lens.height, other_params].append(number)
    return [part for group in groups.values() for part in _of_one_ratio(lenses, group)]


def _of_one_ratio(lenses: Sequence[Lens], group: Sequence[int]) -> list[list[int]]:
    """Parts of a group whose ratios of both focal lengths are the same."""
    parts: list[list[int]] = []
    least = 0.0
    for ratio, number in sorted((lenses[number].focal[1] / lenses[number].focal[0], number) for number in group):
        # Against the least of a part, not its neighbour: ratios that spread continuously are no single one.
        if not parts or ratio > least * (1.0 + _SAME_RATIO):
            parts.append([])
            least = ratio
        parts[-1].append(number)
    return parts


COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2")
WATER_NAMES = ("height_m", "slope_x", "slope_y", "refractive_index")
LENS_NAMES = ("f", "cx", "cy", *COEFFICIENTS)
READOUT_NAME = "readout_s"
RATE_NAME = "level_rate_m_per_h"
FOCAL_NAME = "focal"
# Numbers of parameters: of the water, the relief, the shift of an earlier survey, a lens and a pose.
NUM_WATER, NUM_RELIEF, NUM_SHIFT, NUM_LENS, NUM_POSE = 4, 3, 3, 8, 6
# An index outside these is not water; a step never leaves them.
_INDEX_RANGE = (1.0, 2.0)
WATER_PARAMETERS = ("level_m", "slope_east", "slope_north", "refractive_index")
# Increments of these parameters for central differences of settings by them.
_STEPS = (1e-3, 1e-6, 1e-6, 1e-6)


def distorted(xy: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Coordinates (2, N) distorted by Brown's polynomial, of coefficients (5, N) in the order of `COEFFICIENTS`."""
    (x, y), (k1, k2, k3, p1, p2) = xy, coefficients
    row = k1, k2, p1, p2, k3, 0.0, 0.0, 0.0, np.inf, 0.0
    return np.stack(distortion.distort({distortion.BROWN}, x, y, row))


def distort(xy: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`distorted` coordinates (2, N), and their derivatives by xy (2, 2, N) and by the coefficients (2, 5, N)."""
    found, by_xy, *by_coefficients = distortion.brown_with_derivatives(*xy, *coefficients)
    return np.stack(found), np.stack(by_xy).reshape(2, 2, -1), np.array(by_coefficients)


@dataclass(frozen=True)
class Layout:
    """Layout of the parameters of a block of photographs in the vector."""

    lens_of: np.ndarray  # (V,) int64: number of the lens of each photograph
    aspect: np.ndarray  # (L,): fy / fx of each lens
    # (V, 3) [m/(s px)], local, or None: velocity of each camera over the rows between the first and the last of its
    # photographs; None where no shutter rolls
    velocity_per_row: np.ndarray | None = None
    finds_readouts: bool = False  # Whether the readouts of rolling shutters are parameters
    # (V,) [m] or None: of the cameras (`PinholeCamera.tide`), as given; None where one level holds for all
    tides: np.ndarray | None = None
    # (V,) [h] or None: times of the photographs after that at which the level holds, where the rate of the level is a
    # parameter
    hours: np.ndarray | None = None
    # function of places (N, 2), or None: by how much (N,) [m] the water stands over its plane; None where it is a plane
    departure: Callable[[np.ndarray], np.ndarray] | None = None
    has_ground: bool = False  # Whether the shift of an earlier survey is a parameter
    finds_focals: bool = False  # Whether each photograph has a focal length of its own (autofocus)

    @property
    def shift(self) -> slice:
        """Parameters of the shift of an earlier survey."""
        return slice(NUM_WATER + NUM_RELIEF, self.first_lens)

    @property
    def first_lens(self) -> int:
        return NUM_WATER + NUM_RELIEF + (NUM_SHIFT if self.has_ground else 0)

    @property
    def first_readout(self) -> int:
        return self.first_lens + NUM_LENS * len(self.aspect)

    @property
    def first_rate(self) -> int:
        return self.first_readout + (len(self.aspect) if self.finds_readouts else 0)

    @property
    def first_focal(self) -> int:
        return self.first_rate + (self.hours is not None)

    @property
    def first_pose(self) -> int:
        return self.first_focal + (len(self.lens_of) if self.finds_focals else 0)

    def __len__(self) -> int:
        return self.first_pose + NUM_POSE * len(self.lens_of)

    @cached_property
    def columns(self) -> np.ndarray:
        """Numbers (V, K) of the parameters that observations in each photograph depend on: its pose is the last six."""
        number, views = self.lens_of[:, None], np.arange(len(self.lens_of))[:, None]
        shared = np.tile(np.r_[: NUM_WATER + NUM_RELIEF], (len(views), 1))
        rate = np.tile(np.arange(self.first_rate, self.first_focal), (len(views), 1))
        parts = [
            shared,
            self.first_lens + NUM_LENS * number + np.arange(NUM_LENS),
            self.first_readout + number[:, : int(self.finds_readouts)],
            rate,
            self.first_focal + views[:, : int(self.finds_focals)],
            self.first_pose + NUM_POSE * views + np.arange(NUM_POSE),
        ]
        return np.concatenate(parts, axis=1)

    def photograph_of_parameters(self) -> np.ndarray:
        """Number (P,) of the photograph whose focal length or pose each parameter is; -1 of those that all share."""
        found = np.full(len(self), -1)
        views = np.arange(len(self.lens_of))
        if self.finds_focals:
            found[self.first_focal : self.first_pose] = views
        found[self.first_pose :] = np.repeat(views, NUM_POSE)
        return found

    def lens(self, number: int) -> slice:
        return slice(self.first_lens + NUM_LENS * number, self.first_lens + NUM_LENS * (number + 1))


@dataclass(frozen=True)
class State:
    """Values of all unknowns."""

    water: FlatWater | None
    relief: np.ndarray  # (3,) [m]
    lenses: np.ndarray  # (L, 8)
    # centres, rotations: (V, 3) [m], local; (V, 3, 3) cam from local
    centres: np.ndarray
    rotations: np.ndarray
    points: np.ndarray  # (M, 3) [m], local
    # (L,) [s]: from the first to the last row; empty where no shutter rolls
    readouts: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rate: float = 0.0  # [m/h]: by how much faster the water rises than `Layout.tides` have it
    # (3,) [m], local: by how much an earlier survey as it is given is to be moved; empty where the block lies on none
    shift: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # (V,): focal length of each photograph over that of its lens, less one; empty where they do not differ
    focals: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def water_parameters(self) -> np.ndarray:
        """The water as parameters (4,); zeros for a dry survey."""
        if self.water is None:
            return np.zeros(NUM_WATER)
        return np.array([self.water.point[2], self.water.slope_x, self.water.slope_y, self.water.n_water])

    def require_water(self) -> FlatWater:
        """The water of a survey that is not dry."""
        assert self.water is not None
        return self.water

    def without_points(self) -> State:
        """The state of the parameters alone."""
        return replace(self, points=np.zeros((0, 3)))

    def with_level(self, height: float) -> State:
        """The state with the water at another height [m] of its reference point."""
        water = self.require_water()
        return replace(self, water=replace(water, point=(*water.point[:2], height)))

    def tides(self, layout: Layout) -> np.ndarray | None:
        """Tides at the cameras (V,) [m]; None where one level holds for all."""
        if layout.hours is None:
            return layout.tides
        return self.rate * layout.hours + (0.0 if layout.tides is None else layout.tides)

    def moved(self, layout: Layout, step: np.ndarray, points: np.ndarray) -> State:
        """The state after steps of the parameters (P,) and of the points (M, 3)."""
        poses = step[layout.first_pose :].reshape(-1, NUM_POSE)
        turns = Rotation.from_rotvec(poses[:, 3:]).as_matrix()
        return State(
            water=with_parameters(self.water, self.water_parameters() + step[:NUM_WATER]),
            relief=self.relief + step[NUM_WATER : NUM_WATER + NUM_RELIEF],
            lenses=self.lenses + step[layout.first_lens : layout.first_readout].reshape(-1, NUM_LENS),
            centres=self.centres + poses[:, :3],
            rotations=turns @ self.rotations,
            points=self.points + points,
            readouts=self.readouts + step[layout.first_readout : layout.first_rate]
            if layout.finds_readouts
            else self.readouts,
            rate=self.rate + float(step[layout.first_rate : layout.first_focal].sum()),
            shift=self.shift + step[layout.shift],
            focals=self.focals + step[layout.first_focal : layout.first_pose],
        )


def with_parameters(water: FlatWater | None, parameters: np.ndarray) -> FlatWater | None:
    """The water with other parameters (4,) about the same reference point."""
    if water is None:
        return None
    height, slope_x, slope_y, index = parameters.tolist()
    x, y, _ = water.point
    index = min(max(index, _INDEX_RANGE[0]), _INDEX_RANGE[1])
    return replace(water, point=(x, y, height), slope_x=slope_x, slope_y=slope_y, n_water=index)


def settings_by_local(survey: Survey, place: np.ndarray) -> np.ndarray:
    """Derivative (4, 4) of the settings by height at a place (x, y), slopes and index in local; it is constant."""
    _, given = survey.require_water()
    start, values = _plane_parameters(survey, given, place), settings_of(given)
    moved = [_plane_parameters(survey, with_settings(given, values + step), place) - start for step in np.diag(_STEPS)]
    return np.linalg.inv(np.stack(moved, axis=-1) / _STEPS)


def settings_of(water: WaterConfig) -> np.ndarray:
    """The four parameters as numbers."""
    return np.array([float(getattr(water, name)) for name in WATER_PARAMETERS])


def with_settings(water: WaterConfig, values: np.ndarray) -> WaterConfig:
    """The water with other numbers (4,)."""
    level, east, north, index = np.asarray(values).tolist()
    return replace(water, level_m=level, slope_east=east, slope_north=north, refractive_index=index)


def _plane_parameters(survey: Survey, water: WaterConfig, place: np.ndarray) -> np.ndarray:
    plane = water_plane(survey.frame, water)
    return np.array([float(plane.height(*place)), plane.slope_x, plane.slope_y, plane.n_water])
