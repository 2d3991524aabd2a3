"""Sines of coordinates, so that a perceptron resolves fine detail (Mildenhall et al. 2020, section 5.1).

    gamma_L(p) = (p, sin(2^0 pi p), cos(2^0 pi p), ..., sin(2^(L-1) pi p), cos(2^(L-1) pi p)), p in [-1, 1]      (1)

p itself goes along, as in the authors' code: sines alone read the same at both ends of the box.
"""

from __future__ import annotations

import torch
from torch import Tensor


def encoded_length(frequencies: int) -> int:
    """Length of gamma_L of three coordinates."""
    return 3 + 6 * frequencies


def frequency_encoding(p: Tensor, frequencies: int) -> Tensor:
    """Equation (1) of coordinates (S, 3): (S, 3 + 6 L), the coordinates, all their sines, all their cosines."""
    waves = torch.pi * 2.0 ** torch.arange(frequencies, dtype=p.dtype, device=p.device)
    angle = (p[:, None, :] * waves[:, None]).flatten(1)
    return torch.cat([p, torch.sin(angle), torch.cos(angle)], dim=1)
