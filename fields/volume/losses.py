"""Optional terms beside the squared error of the colours; each is off unless it has a weight.

The density loss is for large scenes:

    a        = 1 - exp(-density l), the opacity of a piece of length l                                            (1)
    L_dens   = mean (exp |l da/dx| - 1) + mean (exp var a - 1)                                                    (2)
    L_gauss  = mean (a - a_s)^2, a_s the mean of a over Gaussian neighbours                                       (3)
    L_dens   = mean exp |ds/dp| + mean exp var s,   L_gauss = mean (s - s_s)^2                                    (4)
    L_empty  = mean a                                                                                             (5)

As printed the losses are (4), of the density s itself, here per half of the box's longest edge, which is 1 in p as in
the authors' scenes. It has no bound, and where an exponent exceeds `LIMIT` exp goes on along its tangent, since a wall
overflows it. The printed l1(exp(grad s)) has no magnitude inside; without one it would depend on the way that axes
point. In (2) and (3), which are used here, opacity over one length takes the place of density: its differences over l
and its variance stay within 1, and the one taken off in (2) lets even density cost nothing. Means and variances run
over the points drawn uniformly in each node of a coarse grid. (5) is the transparency of Inf-NeRF's code, of opacity
over a cell in place of the unit of its scenes.

Losses from prior knowledge take monocular depth and normals. Those on patches (P, size, size, 3) of neighbouring
pixels, colours as stored, 0 to 1, are correlation, structural similarity, and both in virtual views close to the
photographs' own. MonoPatchNeRF (Wu et al. 2024) trains with these.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from fields.models import Losses
from fields.volume.model import VolumeModel
from fields.volume.paths import Box, Paths, paths_along
from fields.volume.photographs import prior_columns
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells, Samples
from refract import WaterSurface, crossing_point

NODES, DRAWN, POINTS = 16, 128, 8  # Nodes along the longest edge; nodes drawn a step, and points in each
PAIRS = 4  # Pairs of Gaussian neighbours of a point
LIMIT = 5.0  # Above this exponent, exp is replaced by its tangent


def added_loss(
    losses: Losses, renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None
) -> Tensor:
    """The weighted sum of the terms, a scalar."""
    model, size, cell = renderer.model, losses.patch, cells.edge
    median = rendered.depth.detach()[:, None]
    terms: list[tuple[float, Callable[[], Tensor]]] = [
        (losses.transparency, lambda: transparency_loss(rendered)),
        (losses.distortion, lambda: distortion_loss(paths, rendered)),
        (losses.density, lambda: density_loss(*draw_nodes(model, cell))),
        (losses.gaussian_density, lambda: gaussian_density_loss(model, cell)),
        (losses.printed_density, lambda: printed_density_loss(model, cell)),
        (losses.printed_gaussian_density, lambda: gaussian_density_loss(model, cell, of=density_per_half)),
        (losses.empty, lambda: empty_loss(model, cell)),
        (losses.ncc, lambda: ncc_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
        (losses.ssim, lambda: ssim_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
        (losses.virtual_patches, lambda: virtual_patch_loss(renderer, paths, rendered, cells, water, size)),
        (losses.depth, lambda: relative_depth_loss(paths, rendered, model.box.edge)),
        (losses.normal, lambda: normal_prior_loss(paths, model.normals(paths.at(median)[:, 0], 0.5 * cell))),
    ]
    return sum((weight * loss() for weight, loss in terms if weight), rendered.rgb.new_zeros(()))


def transparency_loss(rendered: Rendered) -> Tensor:
    """Mean transmittance of the paths: for scenes in which every path ends on the bed.

    Without a background it is always zero: the last sample then takes all that reaches it.
    """
    return (1.0 - rendered.opacity).mean()


def distortion_loss(paths: Paths, rendered: Rendered) -> Tensor:
    """Spread of the weights along a path, mean over paths (mip-NeRF 360, Barron et al. 2022, equation 15).

        sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 d_i / 3

    ``m_i`` is the middle and ``d_i`` the length of interval i, in shares of the path from near to far. Middles rise, so
    that the double sum is twice ``sum_i w_i (m_i sum_{j<i} w_j - sum_{j<i} w_j m_j)``.
    """
    w, edges = rendered.weights, rendered.samples.edges
    span = (paths.far - paths.near).clamp(min=1e-9)[:, None]
    edges = (edges - paths.near[:, None]) / span
    middle, length = 0.5 * (edges[:, 1:] + edges[:, :-1]), edges[:, 1:] - edges[:, :-1]
    before = torch.cumsum(w, dim=1) - w
    moment = torch.cumsum(w * middle, dim=1) - w * middle
    return (2.0 * w * (middle * before - moment) + w**2 * length / 3.0).sum(dim=1).mean()


def opacity(model: VolumeModel, x: Tensor, length: float) -> Tensor:
    """Share (...) of light that a piece of ``length`` [m] stops, at positions (..., 3) [m]."""
    density = model.evaluate(x.reshape(-1, 3))[0].view(x.shape[:-1])
    return -torch.expm1(-density * length)


def density_per_half(model: VolumeModel, x: Tensor, length: float) -> Tensor:
    """Density (...) [1 / half of the longest edge] at positions (..., 3) [m], whatever the length."""
    return 0.5 * model.box.edge * model.evaluate(x.reshape(-1, 3))[0].view(x.shape[:-1])


def _placed(model: VolumeModel, shares: Tensor) -> Tensor:
    """Positions (..., 3) [m] at shares (..., 3) of the edges of the box."""
    low, size = (torch.as_tensor(v, dtype=torch.float32, device=model.place) for v in (model.box.low, model.box.size))
    return low + size * shares


def draw_nodes(
    model: VolumeModel,
    length: float,
    *,
    drawn: int = DRAWN,
    points: int = POINTS,
    of: Callable[[VolumeModel, Tensor, float], Tensor] = opacity,
) -> tuple[Tensor, Tensor]:
    """Opacities (M, P), or ``of``, and gradients (M, P, 3) at points drawn uniformly in nodes, themselves drawn.

    ``length`` is l [m]; the gradients are ``l grad a``, by central differences over l, each component within 1.
    """
    counts = model.box.counts(NODES)
    place = model.place
    node = torch.randint(0, int(np.prod(counts)), (drawn,), device=place)
    corner = torch.stack(torch.unravel_index(node, counts), dim=-1)
    shares = (corner[:, None] + torch.rand(drawn, points, 3, device=place)) / torch.tensor(counts, device=place)
    x = _placed(model, shares)
    axes = torch.eye(3, device=place)
    offsets = 0.5 * length * torch.cat([axes.new_zeros(1, 3), axes, -axes])
    middle, after, before = of(model, x[:, :, None] + offsets, length).split([1, 3, 3], dim=2)
    return middle[:, :, 0], after - before


def density_loss(opacities: Tensor, gradient: Tensor) -> Tensor:
    """Equation (2): l1 of the exponentials of gradient and variance, of what `draw_nodes` gives."""
    return torch.expm1(gradient.abs()).mean() + torch.expm1(opacities.var(dim=1, correction=0)).mean()


def printed_density_loss(model: VolumeModel, length: float, *, drawn: int = DRAWN, points: int = POINTS) -> Tensor:
    """Equation (4), with central differences over ``length`` [m]."""
    density, gradient = draw_nodes(model, length, drawn=drawn, points=points, of=density_per_half)
    gradient = gradient.abs() * (0.5 * model.box.edge / length)
    return limited_exp(gradient).mean() + limited_exp(density.var(dim=1, correction=0)).mean()


def limited_exp(x: Tensor) -> Tensor:
    """exp up to `LIMIT`, and its tangent there beyond it."""
    return torch.exp(x.clamp(max=LIMIT)) * (1.0 + (x - LIMIT).clamp(min=0.0))


def empty_loss(model: VolumeModel, length: float, *, points: int = DRAWN * POINTS) -> Tensor:
    """Equation (5) at points drawn uniformly in the box, of pieces of ``length`` [m]."""
    return opacity(model, _placed(model, torch.rand(points, 3, device=model.place)), length).mean()


def gaussian_density_loss(
    model: VolumeModel,
    length: float,
    *,
    points: int = DRAWN * POINTS,
    of: Callable[[VolumeModel, Tensor, float], Tensor] = opacity,
) -> Tensor:
    """Equation (3) at points drawn uniformly in the box; neighbours at a standard deviation of ``length`` [m].

    With `density_per_half` it is that of (4). Neighbours come in pairs about the point, so that density that changes
    linearly costs nothing.
    """
    place = model.place
    x = _placed(model, torch.rand(points, 1, 3, device=place))
    offsets = length * torch.randn(points, PAIRS, 3, device=place)
    a = of(model, torch.cat([x, x + offsets, x - offsets], dim=1), length)
    return ((a[:, 0] - a[:, 1:].mean(dim=1)) ** 2).mean()


# Scale and shift of a photograph are fitted to at least this many paths of a batch; to two, any depth fits.
MIN_FITTED = 8
MIN_OPACITY = 0.5  # A path meets a surface if its opacity exceeds this
NOISE = (1.0 / 255.0) ** 2  # Below a standard deviation of one grey value of 255 a patch has no structure to correlate
# C1 and C2 of SSIM for colours from 0 to 1 (Wang et al. 2004).
C1, C2 = 0.01**2, 0.03**2
WINDOW = 3
BASELINE = 0.1  # Distance of virtual cameras from the photograph's, as a share of the mean path length
EVERY = 4  # One in this many paths of a batch gets a virtual view
HIDDEN_CELLS = 3.0  # A point is hidden where the virtual view stops these many cells of the proxy before it
SAMPLES = 48  # Samples of a virtual path


def relative_depth_loss(paths: Paths, rendered: Rendered, edge: float) -> Tensor:
    """Mean absolute difference of mean path lengths from monocular depth, in edges of the box.

    Scale and shift of each photograph are those of least squares in this batch (as in MonoSDF, Yu et al. 2022,
    equation 12), found in closed form; no gradient flows through them. Depth is taken along the bent path: the
    refraction of a view straight down is an affine map of depth, which the fit absorbs.
    """
    terms, power, _ = prior_columns(paths)
    known = torch.isfinite(terms).all(dim=1) & (rendered.opacity.detach() > MIN_OPACITY)
    terms, power, view = terms[known], power[known], paths.view[known]
    # Of the light that stops.
    length = ((rendered.weights * rendered.samples.s).sum(dim=1) / rendered.opacity.clamp(min=1e-6))[known]
    target = length**power
    scale_shift, fitted = fit_views(terms, target.detach(), view)
    departure = (target - (terms * scale_shift).sum(dim=1)) * length.detach() ** (1.0 - power)
    return _mean(departure[fitted].abs()) / edge


def normal_prior_loss(paths: Paths, normals: Tensor) -> Tensor:
    """Mean of ``|n - prior|_1 + 1 - n . prior`` over paths with a prior (MonoSDF, Yu et al. 2022, equation 13)."""
    _, _, prior = prior_columns(paths)
    known = torch.isfinite(prior).all(dim=1)
    n, prior = normals[known], prior[known]
    return _mean((n - prior).abs().sum(dim=1) + 1.0 - (n * prior).sum(dim=1))


def fit_views(terms: Tensor, target: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares of ``target = a terms[0] + b terms[1]`` for each view, by its normal equations in float64.

    ``terms``, ``target``, ``view`` (N, 2), (N,), (N,) int64. Returns ``(a, b)`` (N, 2): of the view of each row, dtype
    of `target`; ``fitted`` (N,) bool: the view has enough rows, and they separate scale from shift.
    """
    views, index = torch.unique(view, return_inverse=True)
    t, y = terms.double(), target.double()
    products = torch.stack([t[:, 0] ** 2, t[:, 0] * t[:, 1], t[:, 1] ** 2, t[:, 0] * y, t[:, 1] * y], dim=1)
    xx, xc, cc, xy, cy = products.new_zeros(len(views), 5).index_add(0, index, products).unbind(1)
    determinant = xx * cc - xc**2
    # The priors are float32: a determinant under their rounding, squared, is none.
    solved = determinant > 1e-12 * xx * cc
    solved &= torch.bincount(index, minlength=len(views)) >= MIN_FITTED
    determinant = torch.where(solved, determinant, 1.0)
    fit = torch.stack([(cc * xy - xc * cy) / determinant, (xx * cy - xc * xy) / determinant], dim=1)
    return fit[index].to(target.dtype), solved[index]


def _mean(values: Tensor) -> Tensor:
    """Mean of values (N,), 0 where there are none."""
    return values.sum() / max(len(values), 1)


def as_patches(values: Tensor, size: int) -> Tensor:
    """Values (N, ...) of paths drawn as patches, as (P, size, size, ...).

    Raises ValueError if the paths are no whole number of patches.
    """
    if size < 2 or len(values) % size**2:
        raise ValueError(
            f"expected paths in whole patches of {size} x {size} px, 2 px or more, got {len(values)} paths"
        )
    return values.view(-1, size, size, *values.shape[1:])


def ncc_loss(rendered: Tensor, seen: Tensor) -> Tensor:
    """One less `masked_ncc` of whole patches."""
    return 1.0 - masked_ncc(rendered, seen, torch.ones_like(seen[..., 0]))


def ssim_loss(rendered: Tensor, seen: Tensor, shown: Tensor | None = None) -> Tensor:
    """``(1 - SSIM) / 2``, mean over channels and all windows of 3 x 3 px with even weights inside the patches.

    With ``shown`` (P, size, size), 1 or 0, over the windows that are shown whole; 0 where there is none.
    """
    x, y = (v.permute(0, 3, 1, 2) for v in (rendered, seen))

    def mean(values: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(values, WINDOW, stride=1)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    ssim = (2.0 * mx * my + C1) * (2.0 * cov + C2) / ((mx**2 + my**2 + C1) * (vx + vy + C2))
    if shown is None:
        return 0.5 * (1.0 - ssim).mean()
    complete = (mean(shown[:, None]) > 1.0 - 0.5 / WINDOW**2).to(ssim.dtype).expand_as(ssim)
    return 0.5 * ((1.0 - ssim) * complete).sum() / complete.sum().clamp(min=1.0)


def virtual_view(
    renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None
) -> tuple[Rendered, Tensor]:
    """The points at the median of the weights, taken without gradient, from a camera beside each photograph's.

    With them (N,) bool, which of them the virtual view does not hide.
    """
    is_hit = ((rendered.opacity > MIN_OPACITY) & (paths.near < paths.far)).detach()
    depth = rendered.depth.detach()
    box = renderer.model.box
    middle = torch.as_tensor(0.5 * (box.low + box.high), dtype=depth.dtype, device=depth.device)
    points = torch.where(is_hit[:, None], paths.at(depth[:, None])[:, 0], middle)
    baseline = BASELINE * (depth * is_hit).sum() / is_hit.sum().clamp(min=1)
    # A random direction for each view, the same for all of its paths.
    away = nn.functional.normalize(torch.randn(int(paths.view.max()) + 1, 3, device=depth.device), dim=1)
    moved, length = paths_through(paths.origin + baseline * away[paths.view], points, water, paths, box)
    virtual = renderer.render(moved, renderer.samples(moved, cells, SAMPLES, jitter=True))
    shown = (virtual.depth > length - HIDDEN_CELLS * cells.edge) & (moved.near < moved.far) & is_hit
    return virtual, shown.detach()


def virtual_patch_loss(
    renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None, size: int
) -> Tensor:
    """``(1 - NCC)^2 + 1 - SSIM`` of patches rendered in virtual views and as photographed, where these show them.

    NCC is the mean over channels and patches, weighted by the pixels that are shown (MonoPatchNeRF, Wu et al. 2024, its
    losses on virtual patches; it takes as hidden what lies 10 degrees off, and windows of 5 px for SSIM).
    """
    patches = len(paths) // size**2
    rows = torch.arange(len(paths), device=paths.near.device).view(patches, -1)[::EVERY].reshape(-1)
    of = rendered.samples
    samples = Samples(of.s[rows], of.length[rows], of.edges[rows])
    some = Rendered(rendered.rgb[rows].detach(), rendered.weights[rows].detach(), samples)
    found, is_shown = virtual_view(renderer, paths[rows], some, cells, water)
    seen, virtual = as_patches(paths.rgb[rows], size), as_patches(found.rgb, size)
    shown = as_patches(is_shown, size).to(virtual.dtype)
    return (1.0 - masked_ncc(virtual, seen, shown)) ** 2 + 2.0 * ssim_loss(virtual, seen, shown)


def masked_ncc(rendered: Tensor, seen: Tensor, shown: Tensor) -> Tensor:
    """Correlation of patches (P, size, size, 3) over the pixels with ``shown`` (P, size, size) 1, not 0; a scalar.

    ``(cov + e) / sqrt((var + e) (var' + e))``, mean over patches, by the pixels that they show, and channels; blind to
    brightness and contrast. ``e`` is the variance of one grey value: patches without texture count as alike.
    """
    mask = shown.flatten(1)[..., None]
    count = mask.sum(dim=1, keepdim=True).clamp(min=1.0)
    x, y = (mask * v.flatten(1, 2) for v in (rendered, seen))
    x, y = (mask * (v - v.sum(dim=1, keepdim=True) / count) for v in (x, y))
    cov, vx, vy = ((p * q).sum(dim=1) / count[:, 0] for p, q in ((x, y), (x, x), (y, y)))
    ncc = ((cov + NOISE) / ((vx + NOISE) * (vy + NOISE)).sqrt()).mean(dim=1)
    weight = mask.sum(dim=(1, 2))
    return (ncc * weight).sum() / weight.sum().clamp(min=1.0)


def paths_through(
    centres: Tensor, points: Tensor, water: WaterSurface | None, seen: Paths, box: Box
) -> tuple[Paths, Tensor]:
    """Paths from centres (N, 3) through points (N, 3) [m], bent at the water, and the lengths (N,) [m] to the points.

    They carry the colours and views of the paths ``seen``. A point that no light reaches has a path that misses the
    box.
    """
    origin, target = (v.detach().double().cpu().numpy() for v in (centres, points))
    entry = crossing_point(target, origin, water)
    first = np.linalg.norm(entry - origin, axis=-1, keepdims=True)
    direction = (entry - origin) / np.maximum(first, 1e-9)
    place = points.device
    moved = paths_along(origin, direction, water, seen.rgb.cpu(), box, seen.view.cpu()).to(place)
    length = first[:, 0] + np.linalg.norm(target - entry, axis=-1)
    return moved, torch.as_tensor(length, dtype=points.dtype, device=place)
