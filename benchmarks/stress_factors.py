"""What is made worse by stress.py, step by step, and the survey that it is done to."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from PIL import Image

from survey.simulate.drawn import DrawnScene, draw_survey

# Photographs of a ninth of the usual pixels: a run takes some ten seconds.
BASE = DrawnScene(
    size_m=(5.5, 5.0), depth_m=2.0, num_views=16, image_px=(320, 240), focal_px=560.0, flying_m=14.0, noise=1.0, seed=7
)
_SEED = 20_261_122


@dataclass(frozen=True)
class Factor:
    """One thing that is made worse.

    Attributes
    ----------
    words : str
    values : tuple of float
        From harmless to hopeless.
    scene : callable
        Of the base scene and a value: what is drawn.
    change : callable
        Of the drawn folder and a value: what is done to it.
    """

    words: str
    values: tuple[float, ...]
    scene: Callable[[DrawnScene, float], DrawnScene] = lambda scene, _value: scene
    change: Callable[[Path, float], None] = lambda _folder, _value: None


def prepared(factor: Factor, value: float, folder: Path) -> Path:
    """The survey of a step, drawn anew."""
    shutil.rmtree(folder, ignore_errors=True)
    draw_survey(folder, factor.scene(BASE, value))
    factor.change(folder, value)
    return folder


def _deep(scene: DrawnScene, depth: float) -> DrawnScene:
    """Where the flying height is too low for a depth, everything grows with it."""
    grown = max(1.0, 2.5 * depth / scene.flying_m)
    size = (grown * scene.size_m[0], grown * scene.size_m[1])
    flying, cell, texel = grown * scene.flying_m, grown * scene.cell_m, grown * scene.texel_m
    return replace(scene, depth_m=depth, size_m=size, flying_m=flying, cell_m=cell, texel_m=texel)


def _far_away(scene: DrawnScene, northing: float) -> DrawnScene:
    return replace(scene, crs="EPSG:32733+3855", origin=(500_000.0, northing))


def _images(change: Callable[[np.ndarray, float, np.random.Generator], np.ndarray]) -> Callable[[Path, float], None]:
    """A change of every photograph (height, width, 3) in grey levels."""

    def apply(folder: Path, value: float) -> None:
        rng = np.random.default_rng(_SEED)
        for path in sorted((folder / "images").iterdir()):
            with Image.open(path) as picture:
                exif, values = picture.getexif(), np.asarray(picture, dtype=np.float64)
            changed = np.clip(np.rint(change(values, value, rng)), 0, 255).astype(np.uint8)
            Image.fromarray(changed).save(path, "JPEG", quality=95, subsampling=0, exif=exif)

    return apply


def _compressed(folder: Path, quality: float) -> None:
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as picture:
            exif, same = picture.getexif(), picture.copy()
        same.save(path, "JPEG", quality=int(quality), exif=exif)


def _noise(image: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    return image + std * rng.standard_normal((*image.shape[:2], 1))


def _contrast(image: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Less contrast, under the same noise."""
    middle = image.mean(axis=(0, 1))
    return _noise(middle + share * (image - middle), 1.0, rng)


def _blur(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return _noise(cv2.GaussianBlur(image, (0, 0), sigma), 1.0, rng)


def _exposure(image: np.ndarray, spread: float, rng: np.random.Generator) -> np.ndarray:
    return image * np.exp(spread * rng.standard_normal())


def _settings(change: Callable[[dict, float], None]) -> Callable[[Path, float], None]:
    """A change of survey.toml."""

    def apply(folder: Path, value: float) -> None:
        path = folder / "survey.toml"
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        change(table, value)
        path.write_text(tomli_w.dumps(table), encoding="utf-8")

    return apply


def _level(table: dict, error: float) -> None:
    table["water"] |= {"level_m": table["water"]["level_m"] + error, "level_std_m": error}


def _index(table: dict, error: float) -> None:
    table["water"] |= {"refractive_index": table["water"]["refractive_index"] + error, "index_std": error}


def _focal(table: dict, error: float) -> None:
    table["cameras"]["focal_px"] *= 1.0 + error


def _poses(folder: Path, std: float) -> None:
    """Positions off by so many metres, rotations by a degree for each metre."""
    rng = np.random.default_rng(_SEED)
    path = folder / "cameras.csv"
    head, *lines = path.read_text(encoding="utf-8").split()
    rows = [head]
    for line in lines:
        image, *values = line.split(",")
        off = rng.standard_normal(6) * std
        rows.append(",".join([image, *(f"{float(v) + d:.8f}" for v, d in zip(values, off, strict=True))]))
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")


def _stated_poses(folder: Path, std: float) -> None:
    _poses(folder, std)
    _settings(lambda table, v: table["cameras"].update(position_std_m=[v] * 3, rotation_std_deg=v))(folder, std)


FACTORS = {
    "depth": Factor("depth [m]", (0.5, 2.0, 5.0, 12.0, 30.0), scene=_deep),
    "index": Factor("index", (1.0, 1.2, 1.333, 1.5), scene=lambda scene, n: replace(scene, n_water=n)),
    "place": Factor("northing [m]", (1e6, 5e6, 9.99e6), scene=_far_away),
    "views": Factor("photographs", (4, 6, 10, 40), scene=lambda scene, n: replace(scene, num_views=int(n))),
    "nadir": Factor("share looking down", (0.0, 0.6, 1.0), scene=lambda scene, v: replace(scene, nadir_share=v)),
    "noise": Factor("noise [grey levels]", (2.0, 5.0, 10.0, 20.0), change=_images(_noise)),
    "contrast": Factor("contrast, of what was drawn", (1.0, 0.4, 0.15, 0.05), change=_images(_contrast)),
    "blur": Factor("blur, sigma [px]", (0.5, 1.0, 2.0, 4.0), change=_images(_blur)),
    "exposure": Factor("exposures vary by", (0.1, 0.3, 0.6), change=_images(_exposure)),
    "jpeg": Factor("JPEG quality", (90, 60, 40, 15), change=_compressed),
    "level": Factor("level off, as stated [m]", (0.01, 0.05, 0.2, 1.0), change=_settings(_level)),
    "index_error": Factor("index off, as stated", (0.001, 0.005, 0.02), change=_settings(_index)),
    "focal": Factor("focal length off, not stated", (0.0005, 0.002, 0.01, 0.05), change=_settings(_focal)),
    "poses": Factor("poses off, not stated [m]", (0.005, 0.02, 0.1, 0.5), change=_poses),
    "stated": Factor("poses off, stated [m]", (0.005, 0.02, 0.1, 0.5), change=_stated_poses),
}
