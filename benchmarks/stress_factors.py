"""What the stress campaign makes worse, step by step."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from PIL import Image
from stress_faults import Fault, filling_disk, killed, little_address_space, little_disk, little_memory
from stress_scenes import BASE, Staging, bare_sand, deep, far_away, many, repeated, sideways, with_waves

from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.output.writing import write_survey

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
    staging : callable or None
        Of the staged scene and a value: what is photographed.
    change : callable
        Of the drawn folder and a value: what is done to it.
    fault : Fault or None
        What a run of the base scene is exposed to, instead of a harder survey.
    """

    words: str
    values: tuple[float, ...]
    scene: Callable[[DrawnScene, float], DrawnScene] = lambda scene, _value: scene
    staging: Staging | None = None
    change: Callable[[Path, float], None] = lambda _folder, _value: None
    fault: Fault | None = None


def prepared(factor: Factor, value: float, folder: Path) -> Path:
    """The survey of a step, drawn anew."""
    shutil.rmtree(folder, ignore_errors=True)
    scene, staging = factor.scene(BASE, value), factor.staging
    write_survey(
        folder, asdict(scene), lambda: staging(stage_drawing(scene), value) if staging else stage_drawing(scene)
    )
    factor.change(folder, value)
    return folder


FACTORS = {
    "depth": Factor("depth [m]", (0.5, 2.0, 5.0, 12.0, 30.0), scene=deep),
    "incidence": Factor("incidence, at most [deg]", (40.0, 50.0, 60.0, 70.0), scene=sideways),
    "index": Factor("index", (1.0, 1.2, 1.333, 1.5), scene=lambda scene, n: replace(scene, n_water=n)),
    "place": Factor("northing [m]", (1e6, 5e6, 9.99e6), scene=far_away),
    "views": Factor("photographs", (4, 6, 10, 40), scene=lambda scene, n: replace(scene, num_views=int(n))),
    "many": Factor("photographs of 160 x 120 pixels", (60, 600), scene=many),
    "nadir": Factor("share looking down", (0.0, 0.6, 1.0), scene=lambda scene, v: replace(scene, nadir_share=v)),
    "waves": Factor("waves, amplitude [m]", (0.002, 0.005, 0.01, 0.02, 0.05), staging=with_waves),
    "sand": Factor("bare sand, contrast", (1.0, 0.3, 0.1, 0.03), staging=bare_sand),
    "repeated": Factor("a pattern repeats every [m]", (1.0, 0.4, 0.2, 0.1), staging=repeated),
    "noise": Factor("noise [grey levels]", (2.0, 5.0, 10.0, 20.0), change=images(noise)),
    "contrast": Factor("contrast, of what was drawn", (1.0, 0.4, 0.15, 0.05), change=images(contrast)),
    "blur": Factor("blur, sigma [px]", (0.5, 1.0, 2.0, 4.0), change=images(blur)),
    "exposure": Factor("exposures vary by", (0.1, 0.3, 0.6), change=images(exposure)),
    "jpeg": Factor("JPEG quality", (90, 60, 40, 15), change=compressed),
    "level": Factor("level off, as stated [m]", (0.01, 0.05, 0.2, 1.0), change=settings(level)),
    "exact_level": Factor("level off, not stated [m]", (0.005, 0.02, 0.1, 0.5), change=settings(unstated_level)),
    "datum": Factor("level too low, another datum [m]", (3.0, 5.0, 20.0, 50.0), change=settings(low_level)),
    "index_error": Factor("index off, as stated", (0.001, 0.005, 0.02), change=settings(index)),
    "focal": Factor("focal length off, not stated", (0.0005, 0.002, 0.01, 0.05), change=settings(focal)),
    "principal": Factor("principal point off, not stated [px]", (0.5, 2.0, 10.0), change=settings(principal_point)),
    "distortion": Factor("distortion k1 off, not stated", (0.002, 0.01, 0.05, 0.2), change=settings(distortion)),
    "poses": Factor("poses off, not stated [m]", (0.005, 0.02, 0.1, 0.5), change=poses),
    "stated": Factor("poses off, stated [m]", (0.005, 0.02, 0.1, 0.5), change=stated_poses),
    "memory": Factor("memory [GB]", (1.0, 0.65, 0.5, 0.2), fault=little_memory),
    "space": Factor("address space [GB]", (4.0, 3.2, 2.0), fault=little_address_space),
    "disk": Factor("disk [MB]", (80.0, 30.0, 3.0), fault=little_disk),
    "full": Factor("disk that others fill, room left [MB]", (15.0, 5.0, 1.0), fault=filling_disk),
    "kill": Factor("killed after a share of the time", (0.2, 0.4, 0.6, 0.8), fault=killed),
}
