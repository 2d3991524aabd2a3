"""The colour of water: what it absorbs, what it scatters into the path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WaterColour:
    """Water as light sees it.

    Attributes
    ----------
    absorption : (3,) [1/m]
        Of red, green and blue; the default is a lake with a little yellow substance.
    scattering : [1/m]
        Of all colours alike.
    veil : (3,)
        Radiance of water without end, for the mode without light transport.
    sky : [-]
        Radiance that the surface mirrors, in the same mode.
    """

    absorption: tuple[float, float, float] = (0.17, 0.042, 0.055)
    scattering: float = 0.06
    veil: tuple[float, float, float] = (0.03, 0.17, 0.21)
    sky: float = 0.55

    def through(self, dry: np.ndarray, depth: np.ndarray, in_water: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) of ground of radiance ``dry`` (N, 3) seen through water.

        Parameters
        ----------
        depth : (N,) [m]
            Of the ground: light goes down this way.
        in_water : (N,) [m]
            Way of the ray up to the surface.
        """
        bed = dry * np.exp(-np.array(self.absorption) * (depth + in_water)[:, None])
        return bed + np.array(self.veil) * (1.0 - np.exp(-self.scattering * in_water))[:, None]
