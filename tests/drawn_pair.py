"""The folder of a survey of two photographs without poses, of a rough bed with or without water, drawn exactly."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from plane_survey import look, waves

from geo.crs import parse_crs
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import FlatWater, PinholeCamera
from survey.simulate.sidecars import gps_exif

FRAME = LocalFrame(parse_crs("EPSG:25832+7837"), (676120.0, 5311480.0, 584.0))
SIZE, FOCAL, NOISE = (480, 360), 600.0, 1.5
FLYING_M, BASE_M, INDEX = 30.0, 5.0, 1.335
# Wavelengths of the texture.
TEXTURE_M = (0.15, 3.0)


@dataclass(frozen=True)
class DrawnPair:
    """A folder, and the bed that its photographs show."""

    folder: Path
    depth: float
    slope: np.ndarray

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Height (...) [m] of the bed over the origin of `FRAME` at places (..., 2) [m] in it."""
        x, y = xy[..., 0], xy[..., 1]
        return xy @ self.slope - self.depth + 0.5 * np.sin(x / 2.3) * np.cos(y / 1.9)


def draw_pair(
    folder: Path,
    seed: int = 0,
    *,
    wet: bool = True,
    num_control: int = 6,
    gps: bool = False,
    settings: str = "",
    grey: bool = False,
) -> DrawnPair:
    """Draw two photographs, plain grey ones if asked, their control points, marked in both, and survey.toml."""
    rng = np.random.default_rng([seed, 2])
    pair = DrawnPair(folder, 2.0 if wet else 0.0, rng.uniform(-0.04, 0.04, 2))
    water = FlatWater((0.0, 0.0, 0.0), n_water=INDEX) if wet else None
    places = [np.array([x, 0.0, FLYING_M]) + rng.normal(0.0, 0.3, 3) for x in (-0.5 * BASE_M, 0.5 * BASE_M)]
    cameras = [look(at, (*(at[:2] + rng.normal(0.0, 0.5, 2)), 0.0), focal=FOCAL, size=SIZE) for at in places]
    (folder / "images").mkdir(parents=True)
    for number, camera in enumerate(cameras):
        levels = np.full(SIZE[::-1], 128.0)
        if not grey:
            levels += 30.0 * waves(5, _seen(camera, water, pair), TEXTURE_M) + rng.normal(0.0, NOISE, levels.shape)
        exif = Image.Exif()
        if gps:
            e, n, h = FRAME.crs_from_local(camera.centre)
            exif[ExifTags.IFD.GPSInfo] = gps_exif(*lon_lat(FRAME.crs, np.array([[e, n]]))[0].tolist(), float(h))
        picture = Image.fromarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8)).convert("RGB")
        picture.save(folder / "images" / f"{number}.png", exif=exif)
    lines = []
    for number in range(num_control):
        point = np.append(rng.uniform((-5.0, -6.0), (5.0, 6.0)), 0.0)
        point[2] = pair.height(point[:2])
        e, n, h = FRAME.crs_from_local(point + rng.normal(0.0, 0.01, 3))
        for view, camera in enumerate(cameras):
            x, y = camera.project(point[None], water)[0] + rng.normal(0.0, 0.3, 2) - 0.5
            lines.append(f"{e:.4f} {n:.4f} {h:.4f} {x:.2f} {y:.2f} {view}.png p{number}")
    lens = (
        f'model = "OPENCV"\nfocal_px = {FOCAL}\nsize_px = [{SIZE[0]}, {SIZE[1]}]\ndistortion = [0.0, 0.0, 0.0, 0.0]\n'
    )
    text = f'crs = "EPSG:25832+7837"\n[cameras]\n{settings or lens}'
    text += f"[water]\nlevel_m = 584.0\nlevel_std_m = 0.02\nrefractive_index = {INDEX}\n" if wet else ""
    if lines:
        (folder / "gcp_list.txt").write_text("\n".join(["EPSG:25832", *lines, ""]))
        text += '[control]\ngcps = "gcp_list.txt"\n'
    (folder / "survey.toml").write_text(text)
    return pair


def _seen(camera: PinholeCamera, water: FlatWater | None, pair: DrawnPair) -> np.ndarray:
    """Places (height, width, 2) [m] of the bed that a photograph shows."""
    path, height = camera.paths(camera.pixel_centres(), water), np.full(SIZE[::-1], -pair.depth)
    for _ in range(12):
        at = path.at_height(height, water)
        # The slope of the bed is at most a quarter, seen from at most 25 degrees aside.
        height = height - 0.9 * (at[..., 2] - pair.height(at[..., :2]))
    return at[..., :2]
