"""The colour of water: absorption, and scattering into the path."""

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
    asymmetry : [-]
        Mean cosine of scattering; natural water scatters forward (0.92: Mobley 1994, for Petzold's measurements).
    veil : (3,)
        Radiance of infinitely deep water, for the mode without light transport.
    veiling : [1/m]
        Rate at which the veil builds up, in the same mode.
    sky : [-]
        Radiance that the surface reflects, in the same mode.
    """

    absorption: tuple[float, float, float] = (0.17, 0.042, 0.055)
    scattering: float = 0.2
    asymmetry: float = 0.92
    veil: tuple[float, float, float] = (0.03, 0.17, 0.21)
    veiling: float = 0.06
    sky: float = 0.55

    @property
    def similar(self) -> tuple[float, float]:
        """Scattering [1/m] and asymmetry of water whose light is nearly the same, without the forward peak.

        The delta-Eddington scaling (Joseph, Wiscombe and Weinman 1976): the share ``g**2`` that is scattered least
        counts as not scattered, the rest has the asymmetry ``g / (1 + g)``. What is lost is the soft halo of a few
        degrees around bright things.
        """
        g = self.asymmetry
        return self.scattering * (1.0 - g * g), g / (1.0 + g)

    def through(self, dry: np.ndarray, depth: np.ndarray, in_water: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) of ground of radiance ``dry`` (N, 3) seen through water.

        Parameters
        ----------
        depth : (N,) [m]
            Of the ground: the path of the light down.
        in_water : (N,) [m]
            Way of the ray up to the surface.
        """
        bed = dry * np.exp(-np.array(self.absorption) * (depth + in_water)[:, None])
        return bed + np.array(self.veil) * (1.0 - np.exp(-self.veiling * in_water))[:, None]
