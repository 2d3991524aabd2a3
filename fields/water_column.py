"""The water between the bed and the camera: absorption, scattering, and reflection at its surface."""

import torch
from torch import Tensor, nn

COASTAL = (0.3, 0.07, 0.05)  # Clear coastal water, red first [1/m]: where the learning of an absorption begins
RAW_VEIL = -1.5  # Where the learning of a veil begins, before softplus: a fifth of white


class WaterColumn(nn.Module):
    """Effect of the water on the light of the bed: absorption per channel, backscatter, reflection at the surface.

        seen = (1 - R) (exp(-a w) bed + (1 - exp(-a w)) veil) + R sky

    ``w`` is the way in water [m], R the Fresnel reflectance of unpolarised light at the crossing. Linear radiance.
    The veil builds up with the same coefficient as the light is lost, so that endless water shows the veil alone.

    ``absorption`` (3,) floats [1/m], optional: per channel, of the light's whole way in water, down and up. It is
    learned where it is not given. ``veil`` (3,) floats, optional: linear radiance of endless water. It is learned where
    it is not given.
    """

    # Names of the buffers and parameters are those of stored fields. One of each pair is None.
    given_absorption: Tensor | None
    raw_absorption: nn.Parameter | None
    given_veil: Tensor | None
    raw_veil: nn.Parameter | None

    def __init__(self, absorption: tuple[float, ...] | None = None, veil: tuple[float, ...] | None = None):
        super().__init__()
        self.register_buffer("given_absorption", None if absorption is None else _numbers(absorption))
        self.register_buffer("given_veil", None if veil is None else _numbers(veil))
        # Softplus keeps learned values positive; this is its inverse.
        start = torch.log(torch.expm1(_numbers(COASTAL)))
        self.register_parameter("raw_absorption", nn.Parameter(start) if absorption is None else None)
        self.register_parameter("raw_veil", nn.Parameter(torch.full((3,), RAW_VEIL)) if veil is None else None)
        self.raw_sky = nn.Parameter(torch.zeros(3))

    @property
    def absorption(self) -> Tensor:
        """[1/m] per channel."""
        return _given_or_learned(self.given_absorption, self.raw_absorption)

    @property
    def veil(self) -> Tensor:
        """Linear radiance of endless water, per channel."""
        return _given_or_learned(self.given_veil, self.raw_veil)

    @property
    def sky(self) -> Tensor:
        """Linear radiance that the surface mirrors, per channel."""
        return nn.functional.softplus(self.raw_sky)

    def given(self) -> dict[str, tuple[float, ...]]:
        """The constructor's arguments that are not None."""
        values = {"absorption": self.given_absorption, "veil": self.given_veil}
        return {name: tuple(value.tolist()) for name, value in values.items() if value is not None}

    def path_length(self, depth: Tensor, length: Tensor) -> Tensor:
        """Length (rays,) [m] over which light is absorbed, from the bed's depth and the length of the path up from it.

        A given coefficient is that of the water itself and acts on the way down too, straight down to the bed; a
        learned one is fitted to the path up alone and accounts for both.
        """
        return length if self.given_absorption is None else length + depth

    def forward(self, bed: Tensor, path_length: Tensor, reflectance: Tensor) -> Tensor:
        """Radiance (rays, 3) above the water of the bed's (rays, 3) behind a ``path_length`` (rays,) [m] in water."""
        kept = torch.exp(-self.absorption * path_length[:, None])
        below = kept * bed + (1.0 - kept) * self.veil
        r = reflectance[:, None]
        return (1.0 - r) * below + r * self.sky

    def bed_of(self, seen: Tensor, path_length: Tensor, reflectance: Tensor) -> Tensor:
        """Radiance (rays, 3) of the bed from the radiance seen above the water (rays, 3); the inverse of `forward`.

        Below zero where the veil and the sky's reflection alone are brighter than what is seen.
        """
        kept = torch.exp(-self.absorption * path_length[:, None])
        r = reflectance[:, None]
        below = (seen - r * self.sky) / (1.0 - r)
        return (below - (1.0 - kept) * self.veil) / kept


def _given_or_learned(given: Tensor | None, raw: nn.Parameter | None) -> Tensor:
    """The given value, else the softplus of the learned one; exactly one of the two exists."""
    if given is not None:
        return given
    if raw is None:
        raise TypeError("a number of a WaterColumn is neither given nor learned")
    return nn.functional.softplus(raw)


def _numbers(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
