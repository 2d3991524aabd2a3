"""Predicted places, epipolar curves through the water, and the information of a further mark."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from refract import FlatWater
from survey.photos.cameras import View
from survey.photos.intersection import projection_and_slope

# Samples of a ray; the curves are smooth, and a photograph is some thousand pixels wide.
_SAMPLES = 400
# Nearer to its camera than this share of the distance to the water, or to the other camera, nothing is looked for.
_NEAREST = 0.1
# A dry ray is followed to this multiple of the distance to the other camera, where it is at infinity for all purposes.
_FARTHEST = 300.0
# Of the leg under water [m]: no bed is seen through more.
_DEEPEST_M = 60.0
# Without marks a place is taken as known to this [m], so that a first mark has something to add to.
_UNKNOWN_M = 1.0


class Curve(NamedTuple):
    """An epipolar curve: pixels (N, 2) of the part of a ray above the water and of that below, in image order."""

    dry: np.ndarray
    wet: np.ndarray


def seen_at(view: View, place: np.ndarray, water: FlatWater | None) -> tuple[float, float] | None:
    """The pixel at which a photograph shows a place (3,), local; None where it does not show it."""
    pixel = view.camera.project(place, water)
    return (float(pixel[0]), float(pixel[1])) if view.camera.sees(pixel) else None


def epipolar_curve(source: View, pixel: tuple[float, float], target: View, water: FlatWater | None) -> Curve:
    """Epipolar curve: the places along the ray of a pixel, as another photograph shows them.

    The ray is bent at the water and each place is projected back up through it, so that the part below the water is a
    curve. Samples are spaced evenly in the inverse of the distance above the water, evenly in length below it.

    Parameters
    ----------
    source : View
        Of `pixel`.
    target : View
        In whose pixels the curve is; samples outside its photograph are left out.
    water : FlatWater or None
        None: the ray is straight.
    """
    path = source.camera.paths(np.array(pixel), water)
    apart = float(np.linalg.norm(target.camera.centre - source.camera.centre))
    air, is_wet = float(path.air_length), bool(path.wet)
    if not np.isfinite(path.air_direction).all() or apart == 0.0:
        return Curve(np.zeros((0, 2)), np.zeros((0, 2)))
    far = air if is_wet else _FARTHEST * apart
    dry = 1.0 / np.linspace(1.0 / (_NEAREST * min(apart, far)), 1.0 / far, _SAMPLES)
    wet = air + np.linspace(0.0, _DEEPEST_M, _SAMPLES) if is_wet else np.zeros(0)
    shown = target.camera.project(path.at(np.concatenate([dry, wet])), water)
    inside = target.camera.sees(shown)
    return Curve(shown[:_SAMPLES][inside[:_SAMPLES]], shown[_SAMPLES:][inside[_SAMPLES:]])


def crossing(view: View, pixel: tuple[float, float], water: FlatWater) -> np.ndarray | None:
    """Crossing of the ray of a pixel with the water (3,), local; None where it never meets it."""
    place = np.asarray(view.camera.paths(np.array(pixel), water).crossing)
    return place if np.isfinite(place).all() else None


def by_gain(
    views: Iterable[View], place: np.ndarray, water: FlatWater | None, marked: Sequence[View], std_px: float
) -> list[str]:
    """Names of the photographs that show a place and have no mark of it, by what a mark in each would add.

    The first is the one after whose mark the trace of the covariance of the place is smallest.
    """
    information = np.eye(3) / _UNKNOWN_M**2
    for view in marked:
        information += _information(view, place, water, std_px)
    done = {view.name for view in marked}
    left: Mapping[str, float] = {
        view.name: float(np.trace(np.linalg.inv(information + _information(view, place, water, std_px))))
        for view in views
        if view.name not in done and seen_at(view, place, water) is not None
    }
    return sorted(left, key=lambda name: (left[name], name))


def _information(view: View, place: np.ndarray, water: FlatWater | None, std_px: float) -> np.ndarray:
    """Information of a mark in a photograph about a place (3, 3) [1/m^2]."""
    _, slope = projection_and_slope(view.camera, place, water)
    # A place on the other side of a camera is told nothing of.
    return slope.T @ slope / std_px**2 if np.isfinite(slope).all() else np.zeros((3, 3))
