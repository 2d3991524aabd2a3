"""Learned image similarity: LPIPS and DISTS, by weights that the user supplies.

No weights come with this package. They are the arrays of a state dict: the convolutions of VGG16 or AlexNet as
torchvision names them (``features.0.weight``, ...), and beside them the weights of each measure
(``lin0.model.1.weight``, ... of LPIPS; ``alpha`` and ``beta`` of DISTS), as their authors publish them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from evaluation.images.inputs import checked_pair

# Indices of the convolutions among torchvision's ``features``; after each group comes a pooling.
_VGG16 = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
_ALEXNET = ((0,), (3,), (6, 8, 10))
# Stride and padding of AlexNet's convolutions.
_ALEXNET_STEPS = {0: (4, 2), 3: (1, 2), 6: (1, 1), 8: (1, 1), 10: (1, 1)}
# What images are shifted and divided by: LPIPS for values from -1 to 1, DISTS (as ImageNet) for 0 to 1.
_LPIPS_SCALING = ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
_IMAGENET_SCALING = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_DISTS_C = 1e-6
_SMALLEST_PX = 32


def lpips(reference: np.ndarray, image: np.ndarray, weights: Mapping[str, Tensor]) -> float:
    """Learned perceptual image patch similarity of two colour images (H, W, 3), 0 to 1; 0 for equal images.

    Notes
    -----
    R. Zhang, P. Isola, A. Efros, E. Shechtman, O. Wang, The unreasonable effectiveness of deep features as a
    perceptual metric, CVPR (2018), equation 1: features of unit length over channels, squared differences weighted per
    channel, means over the image, summed over five layers of VGG16 or AlexNet.
    """
    x, y = (_scaled(2.0 * v - 1.0, _LPIPS_SCALING) for v in _colour_pair(reference, image))
    layers = _alexnet if _is_alexnet(weights) else _vgg16
    total = 0.0
    for number, (a, b) in enumerate(zip(layers(x, weights), layers(y, weights), strict=True)):
        head = _weight(weights, f"lin{number}.model.1.weight")
        squared_difference = (_unit(a) - _unit(b)) ** 2
        total += float((head.view(1, -1, 1, 1) * squared_difference).sum(dim=1).mean())
    return total


def dists(reference: np.ndarray, image: np.ndarray, weights: Mapping[str, Tensor]) -> float:
    """Deep image structure and texture similarity of two colour images (H, W, 3), 0 to 1; 0 for equal images.

    Notes
    -----
    K. Ding, K. Ma, S. Wang, E. Simoncelli, Image quality assessment: unifying structure and texture similarity, IEEE
    Transactions on Pattern Analysis and Machine Intelligence 44 (2022), equations 4 to 7: means (texture) and
    covariances (structure) of the image and of five layers of VGG16 with L2 pooling, weighted per channel. Images are
    taken in their own size; the authors shrink theirs to 256 pixels on the shorter side.
    """
    pair = _colour_pair(reference, image)
    x, y = ([v, *_vgg16(_scaled(v, _IMAGENET_SCALING), weights, pool=_l2_pooled)] for v in pair)
    alpha, beta = (_weight(weights, name).reshape(-1) for name in ("alpha", "beta"))
    first, total = 0, 0.0
    for a, b in zip(x, y, strict=True):
        part = slice(first, first + a.shape[1])
        first = part.stop
        mean_a, mean_b = a.mean(dim=(0, 2, 3)), b.mean(dim=(0, 2, 3))
        texture = (2.0 * mean_a * mean_b + _DISTS_C) / (mean_a**2 + mean_b**2 + _DISTS_C)
        apart_a, apart_b = (v - m.view(1, -1, 1, 1) for v, m in ((a, mean_a), (b, mean_b)))
        cov, var_a, var_b = (
            (p * q).mean(dim=(0, 2, 3)) for p, q in ((apart_a, apart_b), (apart_a, apart_a), (apart_b, apart_b))
        )
        structure = (2.0 * cov + _DISTS_C) / (var_a + var_b + _DISTS_C)
        total += float((alpha[part] * texture + beta[part] * structure).sum())
    return 1.0 - total / float((alpha + beta).sum())


def _colour_pair(reference: np.ndarray, image: np.ndarray) -> list[Tensor]:
    pair = checked_pair(reference, image, smallest=_SMALLEST_PX)
    if pair[0].ndim != 3:
        raise ValueError("LPIPS and DISTS need colour images, got grey ones; use ssim or gmsd")
    return [torch.from_numpy(v).float().permute(2, 0, 1)[None] for v in pair]


def _scaled(image: Tensor, scaling: tuple) -> Tensor:
    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in scaling)
    return (image - shift) / scale


def _is_alexnet(weights: Mapping[str, Tensor]) -> bool:
    return _weight(weights, "features.0.weight").shape[-1] == 11


def _weight(weights: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in weights:
        found = ", ".join(list(weights)[:4])
        raise ValueError(
            f"the weights lack {name} (they have {len(weights)} arrays: {found} ...); give one file with the features "
            "of torchvision's VGG16 or AlexNet and the weights of the measure, lin0.model.1.weight to lin4 for LPIPS, "
            "alpha and beta for DISTS"
        )
    return torch.as_tensor(weights[name]).float()


@torch.no_grad()
def _vgg16(x: Tensor, weights: Mapping[str, Tensor], pool=lambda x: functional.max_pool2d(x, 2)) -> list[Tensor]:
    """The last activations of each of the five groups."""
    layers = []
    for number, group in enumerate(_VGG16):
        x = pool(x) if number > 0 else x
        for index in group:
            x = functional.relu(_convolved(x, weights, index, 1, 1))
        layers.append(x)
    return layers


@torch.no_grad()
def _alexnet(x: Tensor, weights: Mapping[str, Tensor]) -> list[Tensor]:
    """The activations of each of the five convolutions."""
    layers = []
    for number, group in enumerate(_ALEXNET):
        x = functional.max_pool2d(x, 3, 2) if number > 0 else x
        for index in group:
            x = functional.relu(_convolved(x, weights, index, *_ALEXNET_STEPS[index]))
            layers.append(x)
    return layers


def _convolved(x: Tensor, weights: Mapping[str, Tensor], index: int, stride: int, padding: int) -> Tensor:
    kernel, bias = (_weight(weights, f"features.{index}.{part}") for part in ("weight", "bias"))
    return functional.conv2d(x, kernel, bias, stride=stride, padding=padding)


def _unit(features: Tensor) -> Tensor:
    return features / (features.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10)


def _l2_pooled(x: Tensor) -> Tensor:
    """Root of the mean square under a Hann window of three pixels, every second pixel."""
    taps = torch.tensor([0.25, 0.5, 0.25])
    kernel = torch.outer(taps, taps).expand(x.shape[1], 1, 3, 3)
    return (functional.conv2d(x**2, kernel, stride=2, padding=1, groups=x.shape[1]) + 1e-12).sqrt()
