"""Bent light paths through a box, by path length from the camera, along which a volume is sampled."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from refract import PinholeCamera, WaterSurface, fresnel_coefficients, trace


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, local [m]."""

    # low, high: (3,) float64
    low: np.ndarray
    high: np.ndarray

    def __post_init__(self):
        low, high = (np.asarray(v, dtype=np.float64) for v in (self.low, self.high))
        if low.shape != (3,) or high.shape != (3,) or not (high > low).all():
            raise ValueError(f"expected corners (3,) of a box, low under high, got {low} and {high}")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @property
    def size(self) -> np.ndarray:
        """Edges (3,) [m]."""
        return self.high - self.low

    @property
    def edge(self) -> float:
        """The longest edge [m]."""
        return float(self.size.max())

    def counts(self, num: int) -> tuple[int, int, int]:
        """Cells along x, y and z that are about cubes, ``num`` of them along the longest edge."""
        nx, ny, nz = np.maximum(np.round(num * self.size / self.edge), 1).astype(int).tolist()
        return nx, ny, nz

    def unit(self, x: Tensor) -> Tensor:
        """Coordinates (..., 3) in [0, 1] along each edge, of positions (..., 3) [m]."""
        return (x - _like(self.low, x)) / _like(self.size, x)

    def centred(self, x: Tensor) -> Tensor:
        """Coordinates (..., 3) of positions (..., 3) [m]: -1 to 1 along the longest edge, to scale along the others."""
        return (x - _like(0.5 * (self.low + self.high), x)) * (2.0 / self.edge)

    def clipped(self, paths: Paths) -> Paths:
        """Paths between the faces of the box, as short as what a field in it needs: here as they are."""
        return paths

    def crossed(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), (N,) [m] at which rays enter and leave; entry beyond leaving where they miss."""
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (self.low - origin) / direction, (self.high - origin) / direction
        # A ray inside a face, parallel to it, gives 0 / 0: it is between the faces all along.
        level = ~(np.isfinite(a) & np.isfinite(b))
        enters = np.fmin(a, b).max(axis=-1, initial=-np.inf, where=~level)
        leaves = np.fmax(a, b).min(axis=-1, initial=np.inf, where=~level)
        outside = (level & ((origin < self.low) | (origin > self.high))).any(axis=-1)
        return np.where(outside, np.inf, enters), np.where(outside, -np.inf, leaves)


@dataclass(frozen=True)
class Rays:
    """Rays (N) of pixels in the air, local frame."""

    # origin, direction: (N, 3) [m], (N, 3) unit
    origin: np.ndarray
    direction: np.ndarray
    rgb: np.ndarray  # (N, 3) uint8
    view: np.ndarray  # (N,) int64: which photograph

    @staticmethod
    def of(camera: PinholeCamera, pixels: np.ndarray, rgb: np.ndarray, view: int) -> Rays:
        """Rays through pixel positions (N, 2) [px]."""
        direction = camera.directions(pixels)
        origin = np.broadcast_to(camera.centres(pixels), direction.shape)
        return Rays(origin, direction, rgb, np.full(len(pixels), view))

    @staticmethod
    def concatenate(parts: list[Rays]) -> Rays:
        """Rays of several views in one."""
        return Rays(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Rays)))

    def __getitem__(self, index) -> Rays:
        return Rays(*(getattr(self, f.name)[index] for f in fields(self)))

    def paths(self, water: WaterSurface | None, box: Box | None) -> Paths:
        """The paths on which they go on through the water, clipped to a box; without one they have no end."""
        colours = torch.as_tensor(self.rgb / 255.0, dtype=torch.float32)
        return paths_along(self.origin, self.direction, water, colours, box, torch.from_numpy(self.view))


@dataclass
class Paths:
    """Paths (N) of light from cameras through a box, torch float32, local frame."""

    origin: Tensor  # (N, 3) [m]: camera centres
    # air, wet (N, 3) unit: directions before and after the water surface
    air: Tensor
    wet: Tensor
    crossing: Tensor  # (N,) [m]: path length at which the water begins; infinite where it never does
    # near, far (N,) [m]: path lengths between which the path may be inside the box; equal where it misses it
    near: Tensor
    far: Tensor
    reflectance: Tensor  # (N,): fresnel reflectance at the water; 0 where there is none
    cos_wet: Tensor  # (N,): cosine of the angle of refraction, depth that a path gains per metre in water
    rgb: Tensor  # (N, 3): Photograph, 0 to 1, as stored (not linear)
    view: Tensor  # (N,) int64: which photograph
    # (N, 6) or (N, 0): priors of the pixels (`fields.volume.photographs`); no columns where there are none
    priors: Tensor

    def __len__(self) -> int:
        return len(self.near)

    def __getitem__(self, index) -> Paths:
        return Paths(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, place: torch.device) -> Paths:
        """The same paths in the memory of a device."""
        return Paths(*(getattr(self, f.name).to(place) for f in fields(self)))

    def at(self, s: Tensor) -> Tensor:
        """Positions (N, K, 3) [m] at path lengths s (N, K) [m]."""
        dry = torch.minimum(s, self.crossing[:, None])
        return self.origin[:, None] + dry[..., None] * self.air[:, None] + (s - dry)[..., None] * self.wet[:, None]

    def direction(self, s: Tensor) -> Tensor:
        """Unit directions of travel (N, K, 3) at path lengths s (N, K) [m], in the medium that is there."""
        return torch.where((s > self.crossing[:, None])[..., None], self.wet[:, None], self.air[:, None])

    def length_in_water(self, s: Tensor) -> Tensor:
        """Length (N,) [m] of the part in water of paths down to s (N,) [m]."""
        return (s - self.crossing).clamp(min=0.0)


def paths_of(
    camera: PinholeCamera, water: WaterSurface | None, pixels: np.ndarray, rgb: np.ndarray, box: Box, view: int = 0
) -> Paths:
    """Paths through pixel positions (N, 2) [px] with colours (N, 3) uint8, clipped to a box.

    Light that the surface reflects totally, or whose refraction is not known, misses the box.
    """
    return Rays.of(camera, pixels, rgb, view).paths(water, box)


def paths_along(
    origin: np.ndarray, direction: np.ndarray, water: WaterSurface | None, rgb: Tensor, box: Box | None, view: Tensor
) -> Paths:
    """Paths from camera centres (N, 3) [m] along unit directions (N, 3) in the air, clipped to a box if there is one.

    They carry colours (N, 3), 0 to 1, and the numbers of their photographs (N,).
    """
    bent = trace(origin, direction, water)
    crossing = np.where(bent.wet, bent.air_length, np.inf)
    wet = np.where(bent.wet[:, None], bent.water_direction, bent.air_direction)
    near, far = np.zeros(len(origin)), np.full(len(origin), np.inf)
    if box is not None:
        near, far = box.crossed(origin, bent.air_direction)
        near, far = np.maximum(near, 0.0), np.minimum(far, crossing)
        near, far = np.where(near < far, near, np.inf), np.where(near < far, far, -np.inf)
        if bent.wet.any():
            enters, leaves = box.crossed(np.where(bent.wet[:, None], bent.crossing, origin), wet)
            enters = np.maximum(enters, 0.0)
            under = bent.wet & (enters < leaves)
            near = np.where(under, np.minimum(near, crossing + enters), near)
            far = np.where(under, np.maximum(far, crossing + leaves), far)
    meets = (near < far) & np.isfinite(wet).all(axis=-1)
    near, far = np.where(meets, near, 0.0), np.where(meets, far, 0.0)
    reflectance, cos_wet = np.zeros(len(origin)), np.zeros(len(origin))
    if water is not None and bent.wet.any():
        at = bent.crossing[bent.wet]
        up = np.stack(np.broadcast_arrays(*water.normal(at[:, 0], at[:, 1])), axis=-1)
        before = -(bent.air_direction[bent.wet] * up).sum(axis=-1)
        reflectance[bent.wet] = fresnel_coefficients(before, n_from=1.0, n_to=water.n_water).reflectance
        cos_wet[bent.wet] = -(wet[bent.wet] * up).sum(axis=-1)
    paths = Paths(
        _single(origin), _single(bent.air_direction), _single(wet), _single(crossing), _single(near), _single(far),
        _single(reflectance), _single(cos_wet), rgb, view, torch.empty(len(origin), 0),
    )  # fmt: skip
    return paths if box is None else box.clipped(paths)


def _single(values: np.ndarray) -> Tensor:
    """Values in single precision, with zeros for NaN; infinite values are kept."""
    return torch.as_tensor(np.nan_to_num(values, posinf=np.inf, neginf=-np.inf), dtype=torch.float32)


def _like(values: np.ndarray, x: Tensor) -> Tensor:
    return torch.as_tensor(values, dtype=x.dtype, device=x.device)
