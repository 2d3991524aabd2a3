"""Training of a scene from photographs: paths drawn, sampled in the proxy, rendered, and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.ndimage import minimum_filter

from fields.threads import half_the_threads
from fields.training import adam, descend, psnr_db, set_rates
from fields.volume.density_loss import NodeScores
from fields.volume.losses import Losses
from fields.volume.paths import Box, Paths, paths_of
from fields.volume.priors import PriorImages
from fields.volume.sampling import Cells
from fields.volume.scene import Scene
from refract import PinholeCamera, WaterSurface

# Paths are drawn for this many steps at once.
POOL_STEPS = 32
# The figures tell the error over the last steps.
LAST_STEPS = 100
ADAM_EPS = 1e-15
CHUNK = 1 << 18
# What the samples of paths that are rendered together may take: more is no faster, since it leaves the cache.
WORKING_BYTES = 16 << 20
BYTES_PER_NUMBER = 4


@dataclass
class Photographs:
    """What a scene is trained from.

    Attributes
    ----------
    cameras : list of PinholeCamera
    images : list of (height, width, 3) uint8
    pixels : list of (n,) int
        Flat indices of the pixels of each photograph that show the scene.
    water : WaterSurface or None
    priors : list of PriorImages, or None
        What is known of the pixels of each photograph beforehand.
    """

    cameras: list[PinholeCamera]
    images: list[np.ndarray]
    pixels: list[np.ndarray]
    water: WaterSurface | None = None
    priors: list[PriorImages] | None = None

    @staticmethod
    def over(
        cameras: list[PinholeCamera], images: list[np.ndarray], box: Box, water: WaterSurface | None = None
    ) -> Photographs:
        """Photographs of a bed inside a box, of the pixels whose path would leave it through its floor.

        Whatever such a path shows, it met it inside. Others leave through a side, and may show what lies beyond.
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
        parts = []
        for view in np.flatnonzero(shares):
            camera, drawn = self.cameras[view], corners[view][rng.integers(0, sizes[view], shares[view])]
            rows, columns = np.divmod((drawn[:, None] + _square(patch, camera.width)).ravel(), camera.width)
            pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
            rgb = self.images[view][rows, columns]
            paths = paths_of(camera, self.water, pixels, rgb, box, int(view))
            if self.priors is not None:
                paths.priors = self.priors[view].at(camera, rows, columns)
            parts.append(paths)
        order = rng.permutation(count)[:, None] * patch**2 + np.arange(patch**2)
        return Paths.concatenate(parts)[torch.from_numpy(order.ravel())]

    def _corners(self, view: int, patch: int) -> np.ndarray:
        """Flat indices of the upper left pixels of all patches whose every pixel shows the scene."""
        if patch == 1:
            return self.pixels[view]
        shows = np.zeros((self.cameras[view].height, self.cameras[view].width), dtype=np.uint8)
        shows.flat[self.pixels[view]] = 1
        # With this origin the window of a pixel begins at it.
        return np.flatnonzero(minimum_filter(shows, patch, mode="constant", origin=-(patch // 2)))


@dataclass(frozen=True)
class Training:
    """How a scene is trained.

    Attributes
    ----------
    steps, rays : int
        Steps, and paths of each.
    samples : int
        Of each path.
    cells : int
        Of the proxy, along the longest edge of the box.
    refresh : tuple of float
        Shares of the steps after which the proxy is taken from the field itself.
    margin : float
        s of the paper, in cells of the proxy.
    final_rate : float
        Learning rates fall to this share of their start, exponentially.
    by_score : float
        Share of the samples drawn where density has detail (`fields.volume.density_loss.NodeScores`).
    losses : Losses
        What is added to the squared error of the colours.
    losses_from : float
        Share of the steps after which they count: a loss that draws weights together does harm while these are wrong.
    """

    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 96
    refresh: tuple[float, ...] = (0.1, 0.2, 0.35, 0.6)
    margin: float = 1.5
    final_rate: float = 0.1
    by_score: float = 0.0
    losses: Losses = field(default_factory=Losses)
    losses_from: float = 0.0


@dataclass(frozen=True)
class VolumeFigures:
    """What is told of the training of a volume.

    Attributes
    ----------
    steps : int
    changed_at : tuple of int
        Steps at which the model changed its parameters or their rates.
    psnr_db : float
        Of the photographs, over the last steps.
    parameters : int
    """

    steps: int
    changed_at: tuple[int, ...]
    psnr_db: float
    parameters: int


@half_the_threads()
def train_scene(
    scene: Scene,
    photographs: Photographs,
    training: Training,
    progress: Callable[[float], None],
    *,
    cells: Cells | None = None,
    seed: int = 0,
) -> tuple[Cells, VolumeFigures]:
    """Fit a scene to photographs.

    Parameters
    ----------
    cells : Cells or None
        Where surfaces may be at first (of the sweep, or of points of structure from motion); None: anywhere in the box.

    Returns
    -------
    cells : Cells
        The proxy, taken from the field itself.
    figures : VolumeFigures
    """
    if scene.proposal is not None and training.by_score:
        raise ValueError(f"by_score is {training.by_score}, but the scene's proposal draws samples: use one of both")
    torch.manual_seed(seed)
    box = scene.model.box
    cells = cells if cells is not None else Cells.everywhere(box, training.cells)
    scores = NodeScores(box, box.edge / training.cells) if training.by_score else None
    refresh = {round(share * training.steps) for share in training.refresh}
    optimiser, losses, changed = adam(scene.rates(), eps=ADAM_EPS), [], []
    for step, paths in enumerate(_batches(photographs, box, training, seed)):
        if step in refresh:
            cells = proxy_of(scene, cells, training.margin * box.edge / max(cells.occupied.shape))
        set_rates(optimiser, training.final_rate ** (step / training.steps))
        if scores is None:
            samples = scene.samples(paths, cells, training.samples, jitter=True)
        else:
            scores.update(scene.model)
            samples = scores.samples(cells, paths, training.samples, training.by_score)
        rendered = scene.render(paths, samples)
        error = ((rendered.rgb - paths.rgb) ** 2).mean()
        total = error + scene.penalty(paths, rendered)
        if step >= training.losses_from * training.steps:
            total = total + training.losses(scene, paths, rendered, cells, photographs.water)
        descend(optimiser, total)
        losses.append(float(error.detach()))
        if scene.model.observe(losses):
            changed.append(step)
            optimiser = adam(scene.rates(), eps=ADAM_EPS)
        progress((step + 1) / training.steps)
    parameters = sum(p.numel() for p in scene.parameters())
    return cells, VolumeFigures(training.steps, tuple(changed), psnr_db(losses[-LAST_STEPS:]), parameters)


@torch.no_grad()
def proxy_of(scene: Scene, cells: Cells, margin: float) -> Cells:
    """The cells of a proxy in which the scene's own field stops light, and those within ``margin`` [m] of them.

    A cell counts if it takes a tenth of the light that crosses it: ten times what fog would that fills the box.
    """
    thick = torch.cat([scene.model.evaluate(part)[0] for part in cells.centres().split(CHUNK)])
    cell = cells.box.edge / max(cells.occupied.shape)
    return cells.refined(1.0 - torch.exp(-thick * cell), 0.1, margin)


@dataclass(frozen=True)
class View:
    """What a camera sees of a scene; where a path misses the box, the background, and NaN for distance and point.

    Attributes
    ----------
    rgb : (height, width, 3) float32
        As a photograph stores it, 0 to 1.
    distance : (height, width) float32 [m]
        Along the path to the median of the weights.
    opacity : (height, width) float32
    points : (height, width, 3) float32 [m]
        Where the path stands at `distance`.
    """

    rgb: np.ndarray
    distance: np.ndarray
    opacity: np.ndarray
    points: np.ndarray


@half_the_threads()
@torch.no_grad()
def render_volume(
    scene: Scene,
    camera: PinholeCamera,
    water: WaterSurface | None,
    cells: Cells,
    *,
    samples: int = 48,
    view: int = 0,
    dry: bool = False,
    chunk: int | None = None,
) -> View:
    """A scene as a camera sees it, with the appearance of photograph ``view``.

    Paths are rendered ``chunk`` at a time; by default as many as keep their samples within `WORKING_BYTES`, so that a
    model with wider features takes more chunks, not more memory.
    """
    chunk = chunk or max(WORKING_BYTES // (BYTES_PER_NUMBER * samples * _numbers_per_sample(scene)), 64)
    pixels = camera.pixel_centres().reshape(-1, 2)
    none = np.zeros((len(pixels), 3))
    parts = []
    for first in range(0, len(pixels), chunk):
        rows = slice(first, first + chunk)
        paths = paths_of(camera, water, pixels[rows], none[rows], scene.model.box, view)
        seen = scene.render(paths, scene.samples(paths, cells, samples, jitter=False), dry=dry)
        depth = torch.where(paths.far > paths.near, seen.depth, torch.nan)
        parts.append((seen.rgb.clamp(max=1.0), depth, seen.opacity, paths.at(depth[:, None])[:, 0]))
    shape = (camera.height, camera.width)
    columns = [torch.cat(column).numpy() for column in zip(*parts, strict=True)]
    return View(*(c.reshape(*shape, *c.shape[1:]) for c in columns))


def _square(patch: int, width: int) -> np.ndarray:
    """Flat indices (patch^2) of a patch's pixels after its first one, in a picture of ``width`` px."""
    return (np.arange(patch)[:, None] * width + np.arange(patch)).ravel()


def _numbers_per_sample(scene: Scene) -> int:
    """Features, as they are, weighted, picked and joined to the direction; and some 60 others."""
    middle = torch.as_tensor(0.5 * (scene.model.box.low + scene.model.box.high), dtype=torch.float32)
    return 4 * scene.model.evaluate(middle[None])[1].shape[1] + 60


def _batches(photographs: Photographs, box: Box, training: Training, seed: int) -> Iterator[Paths]:
    """Paths of each step: as many whole patches as its rays hold, one at least."""
    rng, patch = np.random.default_rng(seed), training.losses.patch
    patches = max(training.rays // patch**2, 1)
    for first in range(0, training.steps, POOL_STEPS):
        count = min(POOL_STEPS, training.steps - first)
        pool = photographs.draw(count * patches, box, rng, patch)
        for part in torch.arange(len(pool)).split(patches * patch**2):
            yield pool[part]
