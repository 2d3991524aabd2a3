"""What the stress campaign does to a survey that is drawn: to its photographs and its settings."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from PIL import Image

_SEED = 20_261_122


def images(change: Callable[[np.ndarray, float, np.random.Generator], np.ndarray]) -> Callable[[Path, float], None]:
    """A change of every photograph (height, width, 3) in grey levels."""

    def apply(folder: Path, value: float) -> None:
        rng = np.random.default_rng(_SEED)
        for path in sorted((folder / "images").iterdir()):
            with Image.open(path) as picture:
                exif, values = picture.getexif(), np.asarray(picture, dtype=np.float64)
            changed = np.clip(np.rint(change(values, value, rng)), 0, 255).astype(np.uint8)
            Image.fromarray(changed).save(path, "JPEG", quality=95, subsampling=0, exif=exif)

    return apply


def compressed(folder: Path, quality: float) -> None:
    """The photographs as JPEG of a lower quality."""
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as picture:
            exif, same = picture.getexif(), picture.copy()
        same.save(path, "JPEG", quality=int(quality), exif=exif)


def noise(image: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    """Noise that is alike in all colours."""
    return image + std * rng.standard_normal((*image.shape[:2], 1))


def contrast(image: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Less contrast, under the same noise."""
    middle = image.mean(axis=(0, 1))
    return noise(middle + share * (image - middle), 1.0, rng)


def blur(image: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """A blur, under the same noise."""
    return noise(cv2.GaussianBlur(image, (0, 0), sigma), 1.0, rng)


def exposure(image: np.ndarray, spread: float, rng: np.random.Generator) -> np.ndarray:
    """Every photograph exposed differently."""
    return image * np.exp(spread * rng.standard_normal())


def settings(change: Callable[[dict, float], None]) -> Callable[[Path, float], None]:
    """A change of survey.toml."""

    def apply(folder: Path, value: float) -> None:
        path = folder / "survey.toml"
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        change(table, value)
        path.write_text(tomli_w.dumps(table), encoding="utf-8")

    return apply


def level(table: dict, error: float) -> None:
    """A level that is off by its standard deviation."""
    table["water"] |= {"level_m": table["water"]["level_m"] + error, "level_std_m": error}


def low_level(table: dict, error: float) -> None:
    """A level that is too low and counts as exact, as one in another vertical datum."""
    table["water"]["level_m"] -= error


def index(table: dict, error: float) -> None:
    """An index that is off by its standard deviation."""
    table["water"] |= {"refractive_index": table["water"]["refractive_index"] + error, "index_std": error}


def unstated_level(table: dict, error: float) -> None:
    """A level that is off and counts as exact."""
    table["water"]["level_m"] += error


def focal(table: dict, error: float) -> None:
    """A focal length that is off by a share of it, and counts as exact."""
    table["cameras"]["focal_px"] *= 1.0 + error


def principal_point(table: dict, error_px: float) -> None:
    """A principal point that is off along both axes, and counts as exact."""
    table["cameras"]["principal_point_px"] = [v + error_px for v in table["cameras"]["principal_point_px"]]


def distortion(table: dict, k1: float) -> None:
    """A distortion that the photographs do not have."""
    table["cameras"] |= {"model": "OPENCV", "distortion": [k1, 0.0, 0.0, 0.0]}


def poses(folder: Path, std: float) -> None:
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


def stated_poses(folder: Path, std: float) -> None:
    """The same, with their standard deviations stated."""
    poses(folder, std)
    settings(lambda table, v: table["cameras"].update(position_std_m=[v] * 3, rotation_std_deg=v))(folder, std)
