"""Points of the bed in holes of a cloud, where photographs agree on colours and heights that nothing else explains.

Photographs that nearly look along each other show the same colours at whatever height is assumed for what they see. If
that is an object over the layer, other photographs show those colours at its height, too: some heights are tried.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_dilation

from evaluation.summary import std_by_median
from fields.occluded.holes import Holes
from fields.occluded.sightings import MISFIT_CLIP, WINDOW, Colours, Sighting, consensus, windowed

# Trial heights over the layer at which other photographs are tested, in ground sampling distances: steps of a fourth.
_TRIAL_HEIGHTS_GSD = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0, 64.0)
# Largest misfit with which a photograph agrees at a trial height: mean square, in variances of the noise.
_TRIAL_MISFIT = 1.5
_BY_CHANCE = 0.3  # Share of the other photographs that agree by chance at one of the trial heights
# Heights over the layer: steps of the search, how far it goes, and how far the layer may be off, beyond the roughness
# of the bed (standard deviation): in ground sampling distances.
_STEP_GSD, _PRIOR_GSD = 1.0, 2.0
_ROUNDS = 3
# Windows of heights, of so many cells on each side, and which share of them counts: neighbours see the same errors.
_WINDOW, _INDEPENDENT = 15, 0.012
# Photographs that are compared: those that may show most. The time grows with the square of their number.
_MOST_VIEWS = 20
LEAST_VIEWS, _LEAST_CELLS = 3, 6  # Photographs that have to agree on a point, and cells that have to hang together
# Share of the cells on which photographs agree that objects over the layer may explain: beyond it the layer is no bed.
_MOST_EXPLAINED = 0.4
# Fewest cells for the gain of a photograph, and photographs for a mean.
_LEAST_SHOWN, _LEAST_MEAN = 100, 3
_GAINS = (0.6, 1.6)
_LEAST_NOISE = 0.5  # Quantisation alone has 0.3


def explained_above(
    slopes: np.ndarray,
    on_layer: Colours,
    on_trial: Iterable[Colours],
    members: np.ndarray,
    gsd: float,
    part: tuple[slice, slice] = np.s_[:, :],
) -> np.ndarray:
    """Cells bool whose agreement an object above the bed explains: non-members see the same colours there.

    Only of a ``part`` of the rows and columns. ``slopes`` (K, 2): how far the rays of each photograph move over the
    ground with the height [m/m]. ``on_layer``: at the cells. ``on_trial``: at the `trial_heights` over the layer.
    ``members`` (K, rows, columns) bool: photographs that agree on each cell. ``gsd`` [m]: side of a cell.
    """
    row, column = (each[part] for each in np.mgrid[: members.shape[1], : members.shape[2]])
    members = members[:, *part]
    share, count = members[..., None].astype(np.float32), np.maximum(members.sum(axis=0), 1)
    mean = (share * on_layer.values[:, *part]).sum(axis=0) / count[..., None]
    shift = (
        np.einsum("kij,kc->ijc", members.astype(np.float32), slopes.astype(np.float32))
        / count[..., None]
        / np.float32(gsd)
    )
    variance = on_layer.noise**2 * (1.0 + 1.0 / count)[..., None]
    most = np.zeros(count.shape)
    for height, colours in zip(trial_heights(gsd), on_trial, strict=True):
        x, y = ((each + height * shift[..., axis]).astype(np.float32) for axis, each in enumerate((column, row)))
        agree, others = np.zeros(count.shape), np.zeros(count.shape)
        for values, use, is_member in zip(colours.values, colours.use, members, strict=True):
            seen = cv2.remap(use.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
            difference = cv2.remap(values, x, y, cv2.INTER_LINEAR) - mean
            square = cv2.transform(difference**2 / variance, np.full((1, 3), 1.0 / 3.0))
            square = np.minimum(square, MISFIT_CLIP).astype(np.float32)
            agree += seen & ~is_member & (windowed(square, seen) < _TRIAL_MISFIT)
            others += seen & ~is_member
        most = np.maximum(most, agree / np.maximum(others, 1.0))
    return most > _BY_CHANCE


def trial_heights(gsd: float) -> list[float]:
    """Heights [m] over the layer at which other photographs are tested."""
    return [gsd * each for each in _TRIAL_HEIGHTS_GSD]


@dataclass(frozen=True)
class FoundPoints:
    """Points of the bed; N of them."""

    xyz: np.ndarray  # (N, 3) [m], local
    rgb: np.ndarray  # (N, 3) uint8: by the steepest photograph that shows the point
    std: np.ndarray  # (N,) float32 [m]: standard deviation of the height
    num_views: np.ndarray  # (N,) uint8
    incidence: np.ndarray  # (N,) float32 [rad]: of the ray in air of that photograph
    view: np.ndarray  # (N,): that photograph


def points_of_holes(holes: Holes, sightings: Sequence[Sighting]) -> FoundPoints | None:
    """Points where photographs agree in holes beside what stands over the layer.

    None where none do, or where objects over the layer explain what they show.
    """
    if len(sightings) < LEAST_VIEWS:
        return None
    is_candidate = holes.are_holes & np.any([each.near_obstacle for each in sightings], axis=0)
    if len(sightings) > _MOST_VIEWS:
        shown = [int((is_candidate & each.is_inside & ~each.is_hidden).sum()) for each in sightings]
        sightings = [sightings[k] for k in np.sort(np.argsort(shown, kind="stable")[-_MOST_VIEWS:])]
    radiometry = _Radiometry.of(sightings) if is_candidate.any() else None
    if radiometry is None:
        return None
    context = binary_dilation(is_candidate, iterations=_WINDOW // 2)
    part = _extent(context)
    found = _search(holes, [each.part(part) for each in sightings], radiometry, context[part])
    height, information = np.zeros(holes.shape), np.full(holes.shape, np.inf)
    members = np.zeros((len(sightings), *holes.shape), dtype=bool)
    height[part], information[part], members[:, *part] = found
    kept = is_candidate & (members.sum(axis=0) >= LEAST_VIEWS)
    # Cells that touch enough others: a chance agreement stands alone.
    _, label, stats, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=8)
    kept &= (stats[:, cv2.CC_STAT_AREA] >= _LEAST_CELLS)[label]
    if not kept.any():
        return None
    kept = _unexplained(holes, sightings, radiometry, height, members, kept)
    if not kept.any():
        return None
    std = np.sqrt(1.0 / information + holes.roughness**2)
    return _found(holes, sightings, kept, height, std, members)


def _extent(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the True cells of a mask."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _search(
    holes: Holes, sightings: Sequence[Sighting], radiometry: _Radiometry, context: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights (rows, columns) [m] over the layer by Gauss-Newton steps, their information [1/m2], and the members."""
    use = np.stack([each.is_inside & ~each.is_hidden & context for each in sightings])
    height, step = np.zeros(context.shape), _STEP_GSD * holes.gsd
    prior = 1.0 / ((_PRIOR_GSD * holes.gsd) ** 2 + holes.roughness**2)
    members = consensus(radiometry.colours(sightings, height, use))
    for _ in range(_ROUNDS):
        low, middle, high = (
            _misfit(radiometry.colours(sightings, height + d, use), members) for d in (-step, 0.0, step)
        )
        slope, bend = (high - low) / (2.0 * step), np.maximum(low + high - 2.0 * middle, 0.0) / (2.0 * step**2)
        # The misfit is twice the negative logarithm of the likelihood.
        information = bend + prior
        height = height - np.clip((0.5 * slope + prior * height) / information, -step, step)
    return height, information, consensus(radiometry.colours(sightings, height, use))


def _unexplained(
    holes: Holes,
    sightings: Sequence[Sighting],
    radiometry: _Radiometry,
    height: np.ndarray,
    members: np.ndarray,
    kept: np.ndarray,
) -> np.ndarray:
    """Kept cells (rows, columns) that no object over the layer explains; none where many are explained."""
    inside = np.stack([each.is_inside for each in sightings])
    on_trial = (radiometry.colours(sightings, each, inside) for each in trial_heights(holes.gsd))
    slopes, on_layer = np.array([each.slope for each in sightings]), radiometry.colours(sightings, height, inside)
    part = _extent(binary_dilation(kept, iterations=WINDOW))
    is_explained = np.zeros_like(kept)
    is_explained[part] = explained_above(slopes, on_layer, on_trial, members, holes.gsd, part)
    if is_explained[kept].mean() > _MOST_EXPLAINED:
        return np.zeros_like(kept)
    return kept & ~is_explained


def _misfit(colours: Colours, members: np.ndarray) -> np.ndarray:
    """Sum of squares (rows, columns) of the differences of the members (K, rows, columns) from their mean, in windows.

    In variances of the noise; of as many cells as are independent of each other.
    """
    share = members.astype(np.float32)[..., None]
    mean = (share * colours.values).sum(axis=0) / np.maximum(share.sum(axis=0), 1.0)
    square = (share * (colours.values - mean) ** 2 / colours.noise**2).sum(axis=0).mean(axis=-1)
    known = members.sum(axis=0) >= 2
    cells = cv2.blur(known.astype(np.float32), (_WINDOW, _WINDOW), borderType=cv2.BORDER_CONSTANT) * _WINDOW**2
    return windowed(square, known, _WINDOW) * _INDEPENDENT * cells


@dataclass(frozen=True)
class _Radiometry:
    """Gain and offset (K, 3) of each photograph against the mean of all, and the noise (3,) of one."""

    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray

    @staticmethod
    def of(sightings: Sequence[Sighting]) -> _Radiometry | None:
        """Gain, offset and noise from certain sightings of the bed; None where these are too few."""
        values = np.stack([each.colours(0.0) for each in sightings])
        shown = np.stack([each.is_shown & each.is_inside for each in sightings])
        values[~shown] = 0.0
        count = shown.sum(axis=0)
        mean, common = values.sum(axis=0) / np.maximum(count, 1)[..., None], count >= _LEAST_MEAN
        gain, offset = np.ones((len(values), 3), np.float32), np.zeros((len(values), 3), np.float32)
        residuals = []
        for number, mask in enumerate(shown & common):
            if mask.sum() < _LEAST_SHOWN:
                continue
            reference, colours = mean[mask], values[number][mask]
            about = reference - reference.mean(axis=0)
            slope = (about * colours).sum(axis=0) / np.maximum((about**2).sum(axis=0), 1e-6)
            gain[number] = np.clip(slope, *_GAINS)
            offset[number] = colours.mean(axis=0) - gain[number] * reference.mean(axis=0)
            residuals.append((colours - offset[number]) / gain[number] - reference)
        if not residuals:
            return None
        noise = std_by_median(np.concatenate(residuals), axis=0)
        return _Radiometry(gain, offset, np.maximum(noise, _LEAST_NOISE))

    def colours(self, sightings: Sequence[Sighting], height: np.ndarray | float, use: np.ndarray) -> Colours:
        """Colours of the photographs at heights over the layer, corrected for gain and offset."""
        values = np.stack([each.colours(height) for each in sightings])
        # Whole rows at a time: numpy takes several times as long where the last axis has three values.
        rows = values.reshape(*use.shape[:2], -1)
        rows -= np.tile(self.offset, use.shape[2])[:, None]
        rows /= np.tile(self.gain, use.shape[2])[:, None]
        rows *= use.repeat(3, axis=2)
        return Colours(values, use, self.noise)


def _found(
    holes: Holes,
    sightings: Sequence[Sighting],
    kept: np.ndarray,
    height: np.ndarray,
    std: np.ndarray,
    members: np.ndarray,
) -> FoundPoints:
    xyz = holes.points[kept].copy()
    xyz[:, 2] += height[kept]
    incidence, seen = np.array([each.incidence for each in sightings]), members[:, kept]
    order = np.argsort(incidence)
    steepest = order[seen[order].argmax(axis=0)]
    rgb = np.stack([each.colours(height)[kept] for each in sightings])[steepest, np.arange(len(xyz))]
    return FoundPoints(
        xyz,
        np.rint(rgb).astype(np.uint8),
        std[kept].astype(np.float32),
        seen.sum(axis=0).astype(np.uint8),
        incidence[steepest].astype(np.float32),
        np.array([each.view for each in sightings])[steepest],
    )
