"""Volume rendering of paths: a model with the water, appearance vectors and a background, as a camera sees it."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import half_the_threads
from fields.image_store import as_stored
from fields.volume.model import Rates, VolumeModel
from fields.volume.nerfacto import Proposal, Proposed
from fields.volume.paths import Paths, paths_of
from fields.volume.sampling import Cells, Samples, composite, quantile_height, render_weights, with_opaque_end
from fields.water_column import WaterColumn
from refract import PinholeCamera, WaterSurface

# Memory for the samples of paths rendered together: more is no faster, since it exceeds the cache; on a GPU less is
# slower, since it is not filled.
WORKING_BYTES = {"cpu": 16 << 20, "cuda": 1 << 30}
BYTES_PER_NUMBER = 4
_UNSEEN = (0.0, np.nan, 0.0, np.nan)  # What a pixel has of which nothing is known: colour, distance, opacity, point


@dataclass
class Rendered:
    """Rendering of a volume along paths (N)."""

    rgb: Tensor  # (N, 3): as a photograph stores it, 0 to 1 (glints above)
    weights: Tensor  # (N, K): share of each sample in the light; the sum is the opacity
    samples: Samples

    @property
    def opacity(self) -> Tensor:
        """(N,), 0 to 1."""
        return self.weights.sum(dim=1)

    @property
    def depth(self) -> Tensor:
        """Path length (N,) [m] to the median of the weights; no gradient beyond it."""
        return quantile_height(self.weights, self.samples.edges)


class VolumeRenderer(nn.Module):
    """A volume with all that its rendering needs: optionally a water column, appearance vectors and a background.

    ``column``: what the water does to light; None for a dry one. ``appearance``: a vector for each photograph.
    ``background``: linear radiance (N, 3) of what lies behind the box, from `Paths` and their vectors; None where every
    path ends in the box: light that passed all samples but the last came from there. (Over black, density would grow
    everywhere at first, because that is the quickest way to a bright picture, and stay as a wall before the cameras.)
    ``proposal``: what draws the samples, in place of the occupied cells.
    """

    RATE = 0.001

    def __init__(
        self,
        model: VolumeModel,
        *,
        column: WaterColumn | None = None,
        appearance: nn.Embedding | None = None,
        background: nn.Module | None = None,
        proposal: Proposal | None = None,
    ):
        super().__init__()
        self.model, self.column, self.appearance, self.background = model, column, appearance, background
        self.proposal = proposal

    def samples(self, paths: Paths, cells: Cells, num: int, *, jitter: bool) -> Samples:
        """``num`` samples a path: where the proposal expects weight, or else in the occupied cells."""
        if self.proposal is None:
            return cells.samples(paths, num, jitter=jitter)
        return self.proposal.samples(paths, num, jitter=jitter)

    def weigh(self, paths: Paths, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (N, K), features (N K, F) and directions of travel (N K, 3) of the samples of paths."""
        x, direction = paths.at(samples.s).view(-1, 3), paths.direction(samples.s).view(-1, 3)
        thickness, features = self.model.thickness(x, direction, samples.length.reshape(-1))
        weights = render_weights(thickness.view_as(samples.s))
        if self.background is None:
            weights = with_opaque_end(weights, (paths.far > paths.near)[:, None])
        return weights, features, direction

    def render(self, paths: Paths, samples: Samples, *, dry: bool = False) -> Rendered:
        """Colours and weights of paths; ``dry`` leaves out the effect of the water on the light."""
        weights, features, direction = self.weigh(paths, samples)
        opacity, num = weights.sum(dim=1, keepdim=True), weights.shape[1]
        vectors = None if self.appearance is None else self.appearance(paths.view)

        def radiance_of(where: Tensor) -> Tensor:
            own = None if vectors is None else vectors[where // num]
            return self.model.radiance(features[where], direction[where], own)

        colour = composite(weights, radiance_of, opacity)
        if self.background is not None:
            colour = colour + (1.0 - opacity) * self.background(paths, vectors)
        if self.column is not None and not dry:
            mean = (weights.detach() * samples.s).sum(dim=1) + (1.0 - opacity.detach()[:, 0]) * paths.far
            length = paths.length_in_water(mean)
            # Light of dry ground crosses no surface.
            path_length = self.column.path_length(paths.cos_wet * length, length)
            colour = self.column(colour, path_length, torch.where(length > 0.0, paths.reflectance, 0.0))
        return Rendered(as_stored(colour), weights, samples)

    def penalty(self, paths: Paths, rendered: Rendered) -> Tensor:
        """Regularisation in training, a scalar: of the model at a sample of each path, and of the proposal."""
        one = torch.randint(rendered.samples.s.shape[1], (len(paths), 1), device=paths.near.device)
        total = self.model.penalty(paths.at(rendered.samples.s.gather(1, one))[:, 0])
        if self.proposal is not None:
            if not isinstance(rendered.samples, Proposed):
                raise TypeError("the proposal is trained by samples that it drew itself, got others")
            total = total + self.proposal.loss(rendered.samples, rendered.weights)
        return total

    def rates(self) -> list[Rates]:
        """Every parameter once, with its learning rate."""
        around = [m for m in (self.column, self.appearance, self.background) if m is not None]
        others = [p for m in around for p in m.parameters()]
        proposed = [] if self.proposal is None else self.proposal.rates()
        return [*self.model.rates(), *proposed, *([Rates(others, self.RATE)] if others else [])]


@dataclass(frozen=True)
class VolumeImage:
    """Image of a volume by a camera; where a path misses the box, the background, and NaN for distance and point."""

    rgb: np.ndarray  # (height, width, 3) float32: as a photograph stores it, 0 to 1
    distance: np.ndarray  # (height, width) float32 [m]: along the path to the median of the weights
    opacity: np.ndarray  # (height, width) float32
    points: np.ndarray  # (height, width, 3) float32 [m]: position of the path at `distance`


@half_the_threads()
@torch.no_grad()
def render_volume(
    renderer: VolumeRenderer,
    camera: PinholeCamera,
    water: WaterSurface | None,
    cells: Cells,
    *,
    samples: int = 48,
    view: int = 0,
    dry: bool = False,
    chunk: int | None = None,
    shown: np.ndarray | None = None,
) -> VolumeImage:
    """Image of a volume by a camera, with the appearance of photograph ``view``.

    Paths are rendered ``chunk`` at a time; by default as many as keep their samples within `WORKING_BYTES`, so that a
    model with wider features takes more chunks, not more memory. Where only the pixels ``shown``, flat indices (n,),
    are wanted, the others are black, their opacity 0 and their distance NaN.
    """
    chunk = chunk or chunk_of(renderer, samples)
    pixels = camera.pixel_centres().reshape(-1, 2)
    pixels = pixels if shown is None else pixels[shown]
    none = np.zeros((len(pixels), 3))
    place = renderer.model.place
    parts, cells = [], cells.to(place)
    for first in range(0, len(pixels), chunk):
        rows = slice(first, first + chunk)
        paths = paths_of(camera, water, pixels[rows], none[rows], renderer.model.box, view).to(place)
        seen = renderer.render(paths, renderer.samples(paths, cells, samples, jitter=False), dry=dry)
        depth = torch.where(paths.far > paths.near, seen.depth, torch.nan)
        parts.append((seen.rgb.clamp(max=1.0), depth, seen.opacity, paths.at(depth[:, None])[:, 0]))
    columns = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    images = []
    for column, unseen in zip(columns, _UNSEEN, strict=True):
        image = np.full((camera.height * camera.width, *column.shape[1:]), unseen, dtype=column.dtype)
        image[slice(None) if shown is None else shown] = column
        images.append(image.reshape(camera.height, camera.width, *column.shape[1:]))
    return VolumeImage(*images)


def chunk_of(renderer: VolumeRenderer, samples: int) -> int:
    """Number of paths that are rendered together, so that their samples take `WORKING_BYTES`."""
    # Four copies of the features of a sample, and some 60 others.
    numbers = 4 * renderer.model.num_features + 60
    return max(WORKING_BYTES[renderer.model.place.type] // (BYTES_PER_NUMBER * samples * numbers), 64)
