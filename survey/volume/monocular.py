"""Monocular depth and normals of photographs, from the files of networks that predict them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fields.volume.photographs import PriorImages
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.stage_key import content_hash

# After a photograph's name without its suffix, with what each holds.
DEPTH, DISPARITY, NORMAL = _KINDS = "_depth", "_disparity", "_normal"
SUFFIXES = (".npy", ".tif", ".tiff", ".png")
# By which the shapes of a prior and of its photograph may differ: networks take multiples of 14 or 32 pixels.
_MOST_STRETCH = 0.05


def monocular_priors(folder: Path, names: Sequence[str], cameras: list[PinholeCamera]) -> list[PriorImages]:
    """Priors of photographs, empty where a photograph has no file.

    Of the photograph ``a/0001.jpg`` they are ``a/0001_depth``, or ``a/0001_disparity`` for its inverse, and
    ``a/0001_normal``, each ``.npy``, ``.tif`` or ``.png``. Depth is true up to a scale and a shift, and unknown where
    it is not finite, or 0 in whole numbers. Normals (height, width, 3) have the axes of the camera, x right, y down, z
    forward, and point at the camera; unsigned integers are ``2 value / maximum - 1``, with the maximum of their type.
    """
    if not folder.is_dir():
        raise SurveyError(f"{folder} is not a folder; expected one with monocular depth or normals of the photographs")
    found = [_priors(folder, name, camera) for name, camera in zip(names, cameras, strict=True)]
    if all(each.depth is None and each.normal is None for each in found):
        stem = Path(names[0]).with_suffix("")
        raise SurveyError(
            f"{folder} has no depth or normals of any of {len(names)} photographs; expected files such as "
            f"{stem}{DEPTH}.npy, {stem}{DISPARITY}.png or {stem}{NORMAL}.npy"
        )
    return found


def priors_hash(folder: Path) -> str:
    """Hash of the priors in a folder, by name and content."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stem.endswith(_KINDS)]
    return hashlib.sha256(
        "".join(f"{path.relative_to(folder)}\0{content_hash(path)}\0" for path in files).encode()
    ).hexdigest()


def _priors(folder: Path, name: str, camera: PinholeCamera) -> PriorImages:
    depth, disparity, normal = (_file(folder, name, kind) for kind in (DEPTH, DISPARITY, NORMAL))
    if depth is not None and disparity is not None:
        raise SurveyError(f"{depth} and {disparity} are both there; keep one of depth and its inverse")
    given = depth or disparity
    return PriorImages(
        depth=None if given is None else _resized(_depth(given), given, camera),
        is_inverse=disparity is not None,
        normal=None if normal is None else _normals(normal, camera),
    )


def _file(folder: Path, name: str, kind: str) -> Path | None:
    stem = folder / Path(name).with_suffix("")
    return next((path for suffix in SUFFIXES if (path := stem.with_name(stem.name + kind + suffix)).is_file()), None)


def _read(path: Path, dimensions: int) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False) if path.suffix == ".npy" else cv2.imread(str(path), -1)
    except (OSError, ValueError, EOFError) as error:
        raise SurveyError(f"{path} cannot be read ({error})") from error
    if values is None or np.ndim(values) != dimensions or not np.issubdtype(np.asarray(values).dtype, np.number):
        shape = "nothing" if values is None else f"an array {np.shape(values)}"
        expected = "(height, width)" if dimensions == 2 else "(height, width, 3)"
        raise SurveyError(f"{path} holds {shape}, expected numbers {expected}")
    return values


def _depth(path: Path) -> np.ndarray:
    values = _read(path, 2)
    known = np.isfinite(values) if np.issubdtype(values.dtype, np.floating) else values > 0
    return np.where(known, values, np.nan).astype(np.float32)


def _normals(path: Path, camera: PinholeCamera) -> np.ndarray:
    """Unit normals (height, width, 3), local, of the camera's size."""
    values = _read(path, 3)
    if values.shape[2] != 3:
        raise SurveyError(f"{path} holds {values.shape[2]} channels, expected x, y and z")
    if path.suffix != ".npy":  # OpenCV has blue first
        values = values[..., ::-1]
    if np.issubdtype(values.dtype, np.floating):
        given = values.astype(np.float32)
    else:
        given = np.float32(2.0 / np.iinfo(values.dtype).max) * values - np.float32(1.0)
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    normals = np.asarray(given / np.where(length > 0.5, length, np.nan), dtype=np.float32)
    is_away = normals[..., 2][np.isfinite(normals[..., 2])] > 0.0
    share_away = float(is_away.mean()) if is_away.size else 0.0
    if share_away > 0.5:
        raise SurveyError(
            f"{path}: {100 * share_away:.0f} % of its normals point away from the camera; expected axes x right, y "
            "down, z forward, in which z of a normal that points at the camera is negative"
        )
    return _resized(normals, path, camera) @ camera.cam_from_local.astype(np.float32)


def _resized(values: np.ndarray, path: Path, camera: PinholeCamera) -> np.ndarray:
    height, width = values.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1.0) > _MOST_STRETCH:
        raise SurveyError(
            f"{path} is {width} x {height} px, and its photograph is {camera.width} x {camera.height}; expected the "
            "same ratio of width to height"
        )
    return cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
