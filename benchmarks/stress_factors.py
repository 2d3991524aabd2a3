"""What the stress campaign makes worse, step by step."""

import math
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from PIL import Image
from scipy.ndimage import gaussian_filter
from stress_faults import Fault, filling_disk, killed, little_address_space, little_disk, little_memory

from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater
from survey.simulate.conditions import Light
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground import Ground, Material, shade_of_map
from survey.simulate.shapes import BedGrid
from survey.simulate.sidecars import StagedScene
from survey.simulate.textures import TILE, ImageTexture, light_of_bed, periodic, sand
from survey.simulate.writing import write_survey

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


# Photographs of a quarter of the usual pixels: a run takes some ten seconds.
BASE = DrawnScene(
    size_m=(5.5, 5.0), depth_m=2.0, num_views=16, image_px=(320, 240), focal_px=560.0, flying_m=14.0, noise=1.0, seed=7
)
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_GRAVITY = 9.81
# Lengths of the waves [m], and the time between two photographs [s].
_WAVES_M, _BETWEEN_S = (0.9, 1.6, 2.7, 4.5), 2.3
# Spacings of the noise of a repeated tile, in its 512 texels, and its standard deviation.
_SPACINGS, _SPECKLE = (32, 64, 128), 0.2
# Of a bed on which nothing lies [m].
_SMOOTH_M = 0.2

Staging = Callable[[StagedScene, float], StagedScene]


def deep(scene: DrawnScene, depth: float) -> DrawnScene:
    """Where the flying height is too low for a depth, everything grows with it."""
    return replace(_grown(scene, max(1.0, 2.5 * depth / scene.flying_m)), depth_m=depth)


def _grown(scene: DrawnScene, factor: float) -> DrawnScene:
    width, height = scene.size_m
    return replace(
        scene,
        size_m=(factor * width, factor * height),
        flying_m=factor * scene.flying_m,
        cell_m=factor * scene.cell_m,
        texel_m=factor * scene.texel_m,
    )


def far_away(scene: DrawnScene, northing: float) -> DrawnScene:
    """The same survey, far from the equator."""
    return replace(scene, crs="EPSG:32733+3855", origin=(500_000.0, northing))


def many(scene: DrawnScene, number: float) -> DrawnScene:
    """A quarter of the pixels in each of many photographs, at the same number of them to the square metre."""
    grown = math.sqrt(number / scene.num_views)
    width, height = scene.image_px
    return replace(
        scene,
        num_views=int(number),
        image_px=(width // 2, height // 2),
        focal_px=0.5 * scene.focal_px,
        size_m=(grown * scene.size_m[0], grown * scene.size_m[1]),
        cell_m=2.0 * scene.cell_m,
        texel_m=2.0 * scene.texel_m,
    )


@dataclass(frozen=True)
class SidewaysScene(DrawnScene):
    """All cameras look in from around, so that no ray is steeper in the middle of an image.

    Attributes
    ----------
    incidence_deg : [deg]
        Greatest, at the middle of the upper edge of an image.
    """

    incidence_deg: float = 40.0

    def cameras(self) -> list[PinholeCamera]:
        """A ring of views about the middle."""
        rng = np.random.default_rng([self.seed, 1])
        tilt = math.radians(self.incidence_deg) - math.atan(0.5 * self.image_px[1] / self.focal_px)
        return [self.look_in(tilt, _GOLDEN_ANGLE * number, rng) for number in range(self.num_views)]


def sideways(scene: DrawnScene, incidence_deg: float) -> DrawnScene:
    """The ground that is seen far away needs no finer grid than its pixels."""
    coarse = 1.0 if incidence_deg < 55.0 else 2.0
    fields = {name: getattr(scene, name) for name in scene.__dataclass_fields__}
    fields |= {"cell_m": coarse * scene.cell_m, "texel_m": coarse * scene.texel_m, "nadir_share": 0.0}
    return SidewaysScene(**fields, incidence_deg=incidence_deg)


@dataclass(frozen=True)
class WavyScene(StagedScene):
    """A scene whose waves move from photograph to photograph; its truth is that of still water.

    Attributes
    ----------
    waves : WavyWater
        At the time zero.
    """

    waves: WavyWater | None = None

    @cached_property
    def _times(self) -> np.ndarray:
        return np.cumsum(np.random.default_rng([self.seed, 31]).uniform(0.8, 1.2, len(self.cameras))) * _BETWEEN_S

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera through the waves of its moment."""
        assert self.waves is not None
        moved = replace(self.renderer, water=self.waves.at(float(self._times[index])))
        return self.sensor.photograph(moved.radiance_of_rays, self.cameras[index], self.lens, (self.seed, index))


def with_waves(scene: StagedScene, amplitude_m: float) -> StagedScene:
    """Four trains of equal steepness that run roughly one way, as fast as on deep water.

    `amplitude_m` is the root of the sum of their squared amplitudes.
    """
    plane = scene.water
    assert isinstance(plane, FlatWater)
    rng, lengths = np.random.default_rng([scene.seed, 30]), np.array(_WAVES_M)
    toward = rng.uniform(0.0, 2.0 * math.pi) + rng.normal(0.0, 0.5, len(lengths))
    number = 2.0 * math.pi / lengths
    waves = WavyWater(
        plane.point,
        (amplitude_m * lengths / np.linalg.norm(lengths)).tolist(),
        np.stack([number * np.sin(toward), number * np.cos(toward)], axis=-1).tolist(),
        rng.uniform(0.0, 2.0 * math.pi, len(lengths)).tolist(),
        frequencies=np.sqrt(_GRAVITY * number).tolist(),
        n_water=plane.n_water,
    )
    return WavyScene(**{name: getattr(scene, name) for name in scene.__dataclass_fields__}, waves=waves)


def repeated(scene: StagedScene, period_m: float) -> StagedScene:
    """A smooth bed painted with a tile that is repeated, square by square."""
    rng, scale = np.random.default_rng([scene.seed, 32]), TILE / period_m
    bright = np.exp(sum(_SPECKLE * periodic(rng, spacing) for spacing in _SPACINGS))
    return _smooth(
        scene,
        ImageTexture(
            image=(0.5 * bright[..., None] * np.array([0.66, 0.57, 0.42])).astype(np.float32),
            texel_from_point=np.array([[[scale, 0.0, 0.0, 0.0], [0.0, scale, 0.0, 0.0]]]),
            map_of_face=np.zeros(1, dtype=np.int64),
            repeats=True,
        ),
    )


def bare_sand(scene: StagedScene, share: float) -> StagedScene:
    """A smooth bed of sand without stones or bodies, whose paint keeps a share of its contrast."""
    bed, texture = scene.renderer.ground.bed, scene.renderer.ground.materials[0].texture
    assert isinstance(bed, BedGrid)
    assert isinstance(texture, ImageTexture)
    texel_m = float(1.0 / texture.texel_from_point[0, 0, 0])
    paint = sand(texture.image.shape[:2], texel_m, np.random.default_rng([scene.seed, 33]))
    middle = paint.mean(axis=(0, 1))
    return _smooth(scene, replace(texture, image=(middle + share * (paint - middle)).astype(np.float32)))


def _smooth(scene: StagedScene, texture: ImageTexture) -> StagedScene:
    """The same scene with nothing on its bed, and nothing in it that is smaller than `_SMOOTH_M`."""
    bed = scene.renderer.ground.bed
    assert isinstance(bed, BedGrid)
    bed = BedGrid(gaussian_filter(bed.heights, _SMOOTH_M / bed.cell), bed.west, bed.south, bed.cell)
    material = Material(texture, shade_of_map(bed, light_of_bed(bed, (), Light())))
    return replace(scene, renderer=replace(scene.renderer, ground=Ground(bed, (), (material,))))


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
