"""Views of a plane bed with an analytic texture, drawn without noise in float64: what the sweep must find is known.

The texture is a sum of waves, long against a pixel, so that bilinear interpolation hardly changes it.
"""

from dataclasses import dataclass

import numpy as np

from fields.device import Device
from fields.sweep.block import Block
from fields.sweep.kernels.arrays import floats, host, run_job
from fields.sweep.kernels.stack import Hypotheses, ViewStack
from fields.sweep.matching import Reference, kernels, match_view
from refract import FlatWater, PinholeCamera

FOCAL, SIZE = 800.0, (96, 72)
TILTED = FlatWater((0.3, -0.2, 0.1), n_water=1.34, slope_x=0.03, slope_y=-0.05)
WAVES = 24
LENGTHS = (0.12, 0.5)  # m; a pixel is 1.5 cm


def look(centre, target, *, focal: float = FOCAL, size: tuple[int, int] = SIZE, heading: float = 0.0) -> PinholeCamera:
    """A camera at a place that looks at another; the top of its image points to `heading` [rad], north over east."""
    forward = np.asarray(target, dtype=float) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [np.sin(heading), np.cos(heading), 0.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    return PinholeCamera(np.asarray(centre, dtype=float), axes, focal, focal, size[0] / 2, size[1] / 2, *size)


def ring(num: int = 6, *, height: float = 10.0, radius: float = 3.0, target=(0.0, 0.0, -2.0), **kwargs):
    """A camera straight over the target and `num` around it, all looking there."""
    angles = 2.0 * np.pi * np.arange(num) / num
    places = [(0.05, 0.02, height), *((radius * np.cos(a), radius * np.sin(a), height) for a in angles)]
    return [look(place, target, heading=0.3 * i, **kwargs) for i, place in enumerate(places)]


def texture(x, y, seed: int = 3, lengths: tuple[float, float] = LENGTHS) -> np.ndarray:
    """Grey levels about zero at local x, y [m], about -128 to 127, of waves of two lengths [m] and between."""
    rng = np.random.default_rng(seed)
    angle, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES))
    number = 2.0 * np.pi / rng.uniform(*lengths, WAVES)
    way = np.multiply.outer(x, number * np.cos(angle)) + np.multiply.outer(y, number * np.sin(angle))
    return 12.0 * np.sin(way + phase).sum(axis=-1)


def waves(seed: int, at: np.ndarray, lengths: tuple[float, float], count: int = 30) -> np.ndarray:
    """Texture of variance 1 at places (..., 2), of waves whose lengths are alike in their logarithm."""
    rng = np.random.default_rng(seed)
    angle, phase = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    number = 2.0 * np.pi / np.exp(rng.uniform(*np.log(lengths), count))
    way = number * np.stack([np.cos(angle), np.sin(angle)])
    return sum(np.sin(at @ way[:, k] + phase[k]) for k in range(count)) / np.sqrt(0.5 * count)


@dataclass(frozen=True)
class PlaneBed:
    """The plane z = level + slope x, local, [m], and the water over it.

    `true_height` and `photograph` take a camera and give arrays (height, width).
    """

    water: FlatWater | None
    level: float
    slope: float = 0.0
    lengths: tuple[float, float] = LENGTHS  # of its texture [m]

    def true_height(self, camera: PinholeCamera) -> np.ndarray:
        """Height [m] over the water plane, along its normal, at which each pixel's path meets the bed."""
        path = camera.paths(camera.pixel_centres(), self.water)
        found = None
        for sign in (1.0, -1.0):  # on each leg height is linear along the path, and so is the height over the bed
            near, far = (self._over_bed(path.at_height(sign * h, self.water)) for h in (0.0, 1.0))
            height = sign * near / (near - far)
            found = height if found is None else np.where(found > 0.0, found, height)
        return found

    def _over_bed(self, points):
        return points[..., 2] - self.level - self.slope * points[..., 0]

    def photograph(self, camera: PinholeCamera) -> np.ndarray:
        """Image (height, width) float32: the texture at the bed point of each pixel centre."""
        path = camera.paths(camera.pixel_centres(), self.water)
        points = path.at_height(self.true_height(camera), self.water)
        return texture(points[..., 0], points[..., 1], lengths=self.lengths).astype(np.float32)

    def stack(self, device: Device, cameras: list[PinholeCamera]) -> ViewStack:
        """The photographs of all cameras."""
        return ViewStack.build(device, cameras, [self.photograph(c) for c in cameras], self.water)

    def block(self, device: Device, cameras: list[PinholeCamera], images: list[np.ndarray] | None = None) -> Block:
        """The photographs of all cameras, or other images; overlap is judged at the bed's level."""
        height = self.level - (0.0 if self.water is None else self.water.point[2])
        return Block(device, cameras, images or [self.photograph(c) for c in cameras], self.water, height)


def match(stack: ViewStack, neighbours, start, step, count, radius, columns=None) -> tuple[np.ndarray, ...]:
    """Height [m], score and curvature [1/m^2] of view 0 of `fields.sweep.matching.match_view`."""
    job = match_view(Reference(stack, 0, list(neighbours), radius), Hypotheses(start, step, count), columns)
    return run_job(stack.device, job)


def buffers_of(device: Device, arrays) -> list:
    """Buffers of `fields.sweep.kernels` that hold arrays of one size."""
    found = kernels(device).buffers(device, len(arrays), arrays[0].size)
    for buffer, each in zip(found, arrays, strict=True):
        if device.module is None:
            buffer.copy_(floats(device, each))
        else:
            import drjit

            drjit.scatter(buffer.array, floats(device, each), drjit.arange(device.module.UInt, each.size))
            drjit.eval(buffer.array)
    return found


def windows_of(device: Device, reference, arrays, width: int, radius: int):
    """Windows of a flat reference and of arrays of one size, for `ncc`."""
    greys = kernels(device).reference_buffer(device, arrays[0].size)
    values = buffers_of(device, arrays)
    return kernels(device).prepare_windows(device, floats(device, reference), greys, values, width, radius)


def held_in(device: Device, buffer, size: int) -> np.ndarray:
    """The numbers in a buffer, on the host."""
    return host(device, buffer if device.module is None else buffer.array)[:size]
