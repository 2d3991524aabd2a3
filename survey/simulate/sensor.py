"""Sensor of the camera: lens distortion, exposure time, and grey levels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from fields.image_store import GAMMA
from refract import PinholeCamera
from refract.lens import Lens, normalised
from survey.simulate.scene_file import SensorSettings

# Linear radiance (N, 3) along rays from origins (N, 3) in directions (N, 3), with a seed for random sampling.
RadianceFunction = Callable[[np.ndarray, np.ndarray, int], np.ndarray]

# Rays at a time.
_RAYS = 1 << 21
# Steps of a sequence that fills the cube evenly (Roberts 2018, the generalised golden ratio of three dimensions).
_STEPS = 1.0 / 1.2207440846057596 ** np.arange(1, 4)


@dataclass(frozen=True)
class Sensor(SensorSettings):
    """Sensor of a camera: from radiance to grey levels; its blur is toward the top of the image."""

    noise: float = 0.0
    samples: int = 4  # Rays per pixel
    is_jittered: bool = False  # Whether rays are jittered in the pixel; else on a regular square grid

    def photograph(
        self, radiance_of: RadianceFunction, camera: PinholeCamera, lens: Lens, seed: tuple[int, int]
    ) -> np.ndarray:
        """The image (height, width, 3) uint8 of a camera; `seed` is that of the scene and the number of the image."""
        scene, index = seed
        walk = np.random.default_rng([scene, 7]).standard_normal(index + 1).sum()
        exposure = self.exposure * float(np.exp(self.exposure_drift * walk))
        linear = exposure * self.light(radiance_of, camera, lens, seed)
        if self.photons_at_white > 0.0:
            rng = np.random.default_rng([scene, 8, index])
            linear = rng.poisson(linear * self.photons_at_white) / self.photons_at_white
        grey = 255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA)
        if self.noise > 0.0:
            grey += self.noise * np.random.default_rng([scene, 3, index]).standard_normal(grey.shape)
        return np.clip(np.round(grey), 0.0, 255.0).astype(np.uint8)

    def light(
        self, radiance_of: RadianceFunction, camera: PinholeCamera, lens: Lens, seed: tuple[int, int]
    ) -> np.ndarray:
        """Mean radiance (height, width, 3) of the pixels of a camera."""
        # Renderers that sample at random work in float32: 1e-4 px.
        dtype = np.float32 if self.is_jittered else np.float64
        middle, across, down = (part.astype(dtype) for part in _rays_of(lens, camera))
        total = np.zeros((camera.height * camera.width, 3))
        # Toward the top of the image, as far as that is level.
        forward = -camera.cam_from_local[1] * (1.0, 1.0, 0.0)
        forward *= self.blur_m / (np.linalg.norm(forward) or 1.0)
        rows = np.repeat(np.arange(camera.height) + 0.5, camera.width)[:, None]
        turn = np.random.default_rng([seed[0], 6, seed[1]]).random((len(total), 3), dtype=np.float32)
        for number, (part, offsets) in enumerate(self._samples(turn)):
            u, v, time = np.moveaxis(offsets.astype(dtype, copy=False), -1, 0)[..., None]
            # The lens is affine within a pixel, to 1e-6 of it.
            rays = middle[part, None] + u * across[part, None] + v * down[part, None]
            rays /= np.sqrt(np.einsum("pri,pri->pr", rays, rays))[..., None]
            origin = camera.centre if self.blur_m == 0.0 else (camera.centre + time * forward).reshape(-1, 3)
            if camera.motion is not None:
                late = rows[part, None] + v - camera.cy
                origin = origin + np.broadcast_to(late * camera.motion, rays.shape).reshape(-1, 3)
            own_seed = int(np.random.default_rng([*seed, number]).integers(1 << 31))
            radiance = radiance_of(np.broadcast_to(origin, (rays.size // 3, 3)), rays.reshape(-1, 3), own_seed)
            total[part] += radiance.reshape(rays.shape).sum(axis=1)
        return (total / self.samples).reshape(camera.height, camera.width, 3)

    def _samples(self, turn: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        """Parts of the flattened image, with offsets (pixels, rays, 3) from the pixel's middle [px] and in time.

        Time runs from -0.5 to 0.5 while the shutter is open. Random samples are one low-discrepancy sequence, shifted
        for each pixel by ``turn`` (pixels, 3).
        """
        if self.is_jittered:
            table = (np.arange(1, self.samples + 1)[:, None] * _STEPS % 1.0).astype(turn.dtype)
        else:
            side = round(self.samples**0.5)
            at = (np.arange(side) + 0.5) / side - 0.5
            time = (np.arange(self.samples) + 0.5) / self.samples - 0.5
            table = np.stack([*(c.ravel() for c in np.meshgrid(at, at)), time], axis=-1)
        at_once = min(self.samples, max(_RAYS // len(turn), 1))
        pixels = max(_RAYS // at_once, 1)
        for first in range(0, self.samples, at_once):
            rows = table[first : first + at_once]
            for start in range(0, len(turn), pixels):
                part = slice(start, min(start + pixels, len(turn)))
                if self.is_jittered:
                    sums = turn[part, None] + rows
                    yield part, np.where(sums >= 1.0, sums - 1.5, sums - 0.5)
                else:
                    yield part, np.broadcast_to(rows, (part.stop - part.start, *rows.shape))


def _rays_of(lens: Lens, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Viewing rays of pixel centres (pixels, 3), local, and their derivatives by column and row."""
    plane, change = normalised(lens)
    middle = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ camera.cam_from_local
    return middle, *(change[..., k] @ camera.cam_from_local[:2] for k in (0, 1))
