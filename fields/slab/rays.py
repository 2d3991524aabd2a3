"""Training rays of the survey grid: bent paths where they pass the slab, with their colours."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from fields.slab.slab import Slab
from refract import FlatWater, PinholeCamera, fresnel_coefficients

# A ray meets the proxy where these many steps along it settle, from the height that the sweep or the bound gives.
MEETING_STEPS = 4


@dataclass
class Rays:
    """Rays (N) through the slab, torch float32, local frame.

    A path is at ``foot + (z - tide) * slope`` at height z over the water plane, with one slope above and one below the
    water of its photograph.

    Attributes
    ----------
    foot, air, wet : (N, 3) [m], [m per m], [m per m]
    height : (N,) [m]
        Where the ray meets the proxy.
    rgb : (N, 3)
        Photograph, 0 to 1, as stored (not linear).
    reflectance : (N,)
        Fresnel reflectance at the water; 0 for a dry survey.
    tide : (N,) [m]
        How high the water of the photograph is over the plane, along its normal.
    """

    foot: Tensor
    air: Tensor
    wet: Tensor
    height: Tensor
    rgb: Tensor
    reflectance: Tensor
    tide: Tensor

    def __len__(self) -> int:
        return len(self.height)

    def __getitem__(self, index) -> Rays:
        return Rays(*(getattr(self, field.name)[index] for field in fields(Rays)))

    @staticmethod
    def concatenate(parts: list[Rays]) -> Rays:
        """Rays of several views in one."""
        return Rays(*(torch.cat([getattr(p, field.name) for p in parts]) for field in fields(Rays)))

    def slope(self, z: Tensor) -> Tensor:
        """Change of position per metre of height (..., 3), for heights z (N, ...) [m]."""
        shape = (len(self),) + (1,) * (z.dim() - 1) + (3,)
        return torch.where((self._own(z) < 0.0)[..., None], self.wet.view(shape), self.air.view(shape))

    def at(self, z: Tensor) -> Tensor:
        """Positions (N, ..., 3) [m] at heights z (N, ...) [m] over the water plane."""
        shape = (len(self),) + (1,) * (z.dim() - 1) + (3,)
        return self.foot.view(shape) + self._own(z)[..., None] * self.slope(z)

    def _own(self, z: Tensor) -> Tensor:
        """Heights z (N, ...) [m] over the water of the photographs."""
        return z - self.tide.view((len(self),) + (1,) * (z.dim() - 1))

    def meet(self, slab: Slab) -> Tensor:
        """Heights (N,) [m] at which the rays meet the proxy, by fixed-point steps from `height`.

        The steps contract where the proxy is less steep than the ray.
        """
        z = slab.height_at(self.at(self.height)[:, :2])
        for _ in range(MEETING_STEPS - 1):
            z = 0.5 * (z + slab.height_at(self.at(z)[:, :2]))
        return z


def rays_of(
    camera: PinholeCamera, water: FlatWater | None, pixels: np.ndarray, height: np.ndarray, rgb: np.ndarray
) -> Rays:
    """Rays through pixel positions (N, 2) [px], starting at heights (N,) [m], with colours (N, 3) uint8."""
    path = camera.paths(pixels, water)
    normal = np.array(water.up if water else (0.0, 0.0, 1.0))
    plane = np.array(water.point if water else (0.0, 0.0, 0.0))
    plane[2] += camera.tide
    fall = path.air_direction @ normal
    centre = camera.centres(pixels)
    foot = centre - path.air_direction * (((centre - plane) @ normal) / fall)[:, None]
    air = path.air_direction / fall[:, None]
    fall_wet = path.water_direction @ normal
    wet = path.water_direction / fall_wet[:, None]
    reflectance = np.zeros(len(pixels))
    if water is not None:
        reflectance = fresnel_coefficients(-fall, n_from=1.0, n_to=water.n_water).reflectance
    tide = np.full(len(pixels), camera.tide * normal[2])
    columns = (foot, air, wet, height, rgb / 255.0, reflectance, tide)
    return Rays(*(torch.as_tensor(np.ascontiguousarray(c), dtype=torch.float32) for c in columns))
