"""Normals that a small perceptron says from a field's features (MonoPatchNeRF, Wu et al. 2024; Verbin et al. 2022).

    n_i = normalised MLP(features_i), one hidden layer;  n = normalised sum_i w_i n_i of a path

A normal so rendered is as smooth as the features, where the gradient of density is noise. It is held to monocular
normals, as those of density are (`fields.volume.prior_losses.normal_prior_loss`), and through the weights and features
it teaches the density.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

HIDDEN = 16


class NormalHead(nn.Module):
    """Unit normals (S, 3) from features (S, F)."""

    def __init__(self, features: int, hidden: int = HIDDEN):
        super().__init__()
        self.hidden, self.last = nn.Linear(features, hidden), nn.Linear(hidden, 3)

    def forward(self, features: Tensor) -> Tensor:
        return nn.functional.normalize(self.last(torch.relu(self.hidden(features))), dim=1)

    def along(self, weights: Tensor, features: Tensor) -> Tensor:
        """Normals (N, 3) of paths with weights (N, K) of samples with features (N K, F)."""
        each = self(features).view(*weights.shape, 3)
        return nn.functional.normalize((weights[..., None] * each).sum(dim=1), dim=1)
