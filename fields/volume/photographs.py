"""The photographs that a volume is trained from, and the paths drawn through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import minimum_filter

from fields.volume.paths import Box, Paths, Rays, paths_of
from fields.volume.priors import PriorImages
from refract import PinholeCamera, WaterSurface


@dataclass
class Photographs:
    """Photographs with cameras and water: the training data of a volume."""

    cameras: list[PinholeCamera]
    images: list[np.ndarray]  # list of (height, width, 3) uint8
    pixels: list[np.ndarray]  # list of (n,) int: flat indices of the pixels of each photograph that show the scene
    water: WaterSurface | None = None
    priors: list[PriorImages] | None = None  # or None: priors of the pixels of each photograph

    @staticmethod
    def over(
        cameras: list[PinholeCamera], images: list[np.ndarray], box: Box, water: WaterSurface | None = None
    ) -> Photographs:
        """Photographs of a bed inside a box, of the pixels whose path would leave it through its floor.

        Such a path meets everything it shows inside. Others leave through a side, and may show objects beyond.
        """
        pixels = []
        for camera in cameras:
            grid = camera.pixel_centres().reshape(-1, 2)
            paths = paths_of(camera, water, grid, np.zeros((len(grid), 3)), box)
            end = paths.at(paths.far[:, None])[:, 0, 2].numpy()
            # A thousandth of the box is more than float32 rounds off.
            on_floor = np.abs(end - box.low[2]) < 1e-3 * box.size[2]
            pixels.append(np.flatnonzero(on_floor & (paths.far > paths.near).numpy()))
        return Photographs(cameras, images, pixels, water)

    def draw(self, count: int, box: Box, rng: np.random.Generator, patch: int = 1) -> Paths:
        """Paths (count patch^2) through patches of pixels drawn evenly from all photographs, in random order.

        The pixels of a patch, ``patch`` wide and high, follow each other row by row; all of them show the scene.

        Raises
        ------
        ValueError
            If no photograph has room for a patch.
        """
        corners = [self._corners(view, patch) for view in range(len(self.cameras))]
        sizes = np.array([len(c) for c in corners])
        if not sizes.sum():
            raise ValueError(f"no photograph shows the scene in {patch} x {patch} px; draw smaller patches")
        shares = rng.multinomial(count, sizes / sizes.sum())
        parts, priors = [], []
        for view in np.flatnonzero(shares):
            camera, drawn = self.cameras[view], corners[view][rng.integers(0, sizes[view], shares[view])]
            rows, columns = np.divmod((drawn[:, None] + _square(patch, camera.width)).ravel(), camera.width)
            pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
            parts.append(Rays.of(camera, pixels, self.images[view][rows, columns], int(view)))
            if self.priors is not None:
                priors.append(self.priors[view].at(camera, rows, columns))
        order = (rng.permutation(count)[:, None] * patch**2 + np.arange(patch**2)).ravel()
        paths = Rays.concatenate(parts)[order].paths(self.water, box)
        if self.priors is not None:
            paths.priors = torch.cat(priors)[torch.from_numpy(order)]
        return paths

    def _corners(self, view: int, patch: int) -> np.ndarray:
        """Flat indices of the upper left pixels of all patches whose every pixel shows the scene."""
        if patch == 1:
            return self.pixels[view]
        shows = np.zeros((self.cameras[view].height, self.cameras[view].width), dtype=np.uint8)
        shows.flat[self.pixels[view]] = 1
        # With this origin the window of a pixel begins at it.
        return np.flatnonzero(minimum_filter(shows, patch, mode="constant", origin=-(patch // 2)))


def _square(patch: int, width: int) -> np.ndarray:
    """Flat indices (patch^2) of a patch's pixels after its first one, in a picture of ``width`` px."""
    return (np.arange(patch)[:, None] * width + np.arange(patch)).ravel()
