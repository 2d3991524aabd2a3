"""Blocks as they come from the field, one for each seed: few photographs or many, good GPS, bad or none, any control.

Photographs are chosen from three flights of two lines over a wet bed, a dry one and a shore, which are drawn once
(`draw_flights`); a block takes some in a row, and writes what a surveyor would know of them, right or wrong.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import tomli_w
from PIL import ExifTags, Image

from geo.crs import parse_crs
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import FlatWater, PinholeCamera
from refract.lens import Lens, distorted
from survey.simulate.drawn.ground import build_ground
from survey.simulate.drawn.settings import DrawnScene
from survey.simulate.ground.shapes import BedGrid
from survey.simulate.light import Light
from survey.simulate.output.sidecars import cameras_csv, gps_exif
from survey.simulate.render.direct import DirectRenderer
from survey.simulate.sensor import Sensor
from survey.simulate.water import WaterOptics

GROUNDS = ("wet", "dry", "shore")
# Of each of the two lines of a flight, and between two photographs and two lines [m]: 78 and 60 % overlap.
PER_LINE, _STEP_M, _APART_M = 60, 1.3, 3.2
LENS = Lens("OPENCV", (700.0, 700.0, 203.0, 148.0, -0.04, 0.02, 0.0, 0.0), 400, 300)
_FLYING_M, _INDEX = 14.0, 1.333
_CRS, _ORIGIN, _LEVEL_M = "EPSG:25832+7837", (676120.0, 5311480.0), 584.2
_BED = "bed.npz"
# Standard deviations of GPS [m], and how far off one position in eight of a bad receiver is.
_GPS_STD = {"good": 0.02, "fair": 0.5, "bad": 3.0}
_FAR_OFF_M = 25.0
_MARK_STD_PX, _POINT_STD_M, _POSE_STD_M, _POSE_STD_DEG = 0.4, 0.02, 0.03, 0.05


@dataclass(frozen=True)
class RealLikeBlock:
    """What a seed stands for.

    Attributes
    ----------
    seed : int
    ground : one of `GROUNDS`
    num_views : int
        Two to sixty.
    num_lines : 1 or 2
    has_gap : bool
        Between two halves of the flight nothing overlaps.
    gps : "good", "fair", "bad" or "none"
    num_control : int
        Points, with one to five marks each.
    wrong_control : bool
        One of them is 1.5 m off.
    given : "found", "exact" or "stated"
        Poses: to be found from the photographs, from a file, or from a file with a standard deviation.
    level : "stated", "exact", "off" or "missing"
        Of the water: with its standard deviation or without, off by 0.3 m, or not given.
    has_lens, has_area : bool
        Whether survey.toml knows the lens, and bounds.
    """

    seed: int
    ground: str
    num_views: int
    num_lines: int
    has_gap: bool
    gps: str
    num_control: int
    wrong_control: bool
    given: str
    level: str
    has_lens: bool
    has_area: bool

    @classmethod
    def of(cls, seed: int) -> RealLikeBlock:
        """The block of a seed."""
        rng = np.random.default_rng([seed, 33])
        # As likely in each factor of two.
        num_views = round(float(np.exp(rng.uniform(math.log(1.6), math.log(60.4)))))
        given = str(rng.choice(["found", "exact", "stated"], p=[0.6, 0.2, 0.2]))
        return cls(
            seed=seed,
            ground=str(rng.choice(GROUNDS)),
            num_views=max(num_views, 2),
            num_lines=int(rng.integers(1, 3)),
            has_gap=bool(rng.random() < 0.15),
            gps=str(rng.choice([*_GPS_STD, "none"])),
            num_control=int(rng.integers(0, 13)) if rng.random() < 0.7 else 0,
            wrong_control=bool(rng.random() < 0.15),
            given=given,
            level=str(rng.choice(["stated", "exact", "off", "missing"], p=[0.5, 0.2, 0.15, 0.15])),
            has_lens=given != "found" or bool(rng.random() < 0.5),
            has_area=bool(rng.random() < 0.5),
        )

    def __str__(self) -> str:
        words = [
            self.ground,
            f"{self.num_views} photographs in {self.num_lines} line{'s' * (self.num_lines - 1)}",
            *(["gap"] if self.has_gap else []),
            f"poses {self.given}",
            f"GPS {self.gps}",
            f"control {self.num_control}{' (one wrong)' if self.wrong_control and self.num_control else ''}",
            *([f"level {self.level}"] if self.ground != "dry" else []),
            *([] if self.has_lens else ["no lens"]),
        ]
        return ", ".join(words)

    def draw(self, folder: Path, flights: Path, *, grey: bool = False) -> None:
        """Write the block into a folder; what was there goes. Its photographs may be plain grey."""
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "images").mkdir(parents=True)
        rng, flight = np.random.default_rng([self.seed, 34]), Flight.of(self.ground)
        taken = self.taken(rng)
        cameras, names = [flight.cameras[k] for k in taken], [name_of(k) for k in taken]
        exifs = self._exifs(cameras, flight.frame, rng)
        for k, name, exif in zip(taken, names, exifs, strict=True):
            path = flights / self.ground / f"{k:03d}.png"
            picture = Image.new("RGB", (LENS.width, LENS.height), "gray") if grey else Image.open(path)
            picture.save(folder / "images" / name, "JPEG", quality=92, exif=exif)
        if self.given != "found":
            (folder / "cameras.csv").write_text(cameras_csv(names, _moved(cameras, rng), flight.frame), "utf-8")
        control = self._control(cameras, names, flight, bed_of(flights / self.ground), rng)
        if control:
            (folder / "gcp_list.txt").write_text(control, "utf-8")
        table = self._table(cameras, flight.frame, controlled=bool(control))
        (folder / "survey.toml").write_text(tomli_w.dumps(table), "utf-8")

    def taken(self, rng: np.random.Generator) -> list[int]:
        """Numbers of photographs in the flight, some in a row of each line."""
        lines = [int(rng.integers(2))] if self.num_lines == 1 else [0, 1]
        per_line = [self.num_views // len(lines) + (k < self.num_views % len(lines)) for k in range(len(lines))]
        # Photographs five steps apart do not overlap.
        gap = 6 if self.has_gap and self.num_views >= 4 else 0
        first = int(rng.integers(0, max(PER_LINE - gap - max(per_line), 0) + 1))
        taken = []
        for line, count in zip(lines, per_line, strict=True):
            places = [first + k + (gap if k >= count // 2 and count > 1 else 0) for k in range(count)]
            taken += [line * PER_LINE + place for place in places if place < PER_LINE]
        return taken

    def _exifs(self, cameras: list[PinholeCamera], frame: LocalFrame, rng: np.random.Generator) -> list[Image.Exif]:
        centres = np.array([camera.centre for camera in cameras])
        if self.gps != "none":
            centres = centres + _GPS_STD[self.gps] * rng.standard_normal(centres.shape)
        if self.gps == "bad":
            centres[rng.random(len(centres)) < 0.125] += _FAR_OFF_M
        e, n, heights = frame.crs_from_local(centres).T
        lon, lat = lon_lat(frame.crs, np.column_stack([e, n])).T
        exifs = []
        for place in zip(lon, lat, heights, strict=True):
            exif = Image.Exif()
            exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Simulated", "field"
            film_mm = 36.0 * LENS.focal[0] / LENS.width
            exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(film_mm)}
            if self.gps != "none":
                exif[ExifTags.IFD.GPSInfo] = gps_exif(*(float(v) for v in place))
            exifs.append(exif)
        return exifs

    def _control(
        self, cameras: list[PinholeCamera], names: list[str], flight: Flight, bed: BedGrid, rng: np.random.Generator
    ) -> str:
        """gcp_list.txt: points on the ground that the photographs show, each with one to five marks of those it has."""
        centres = np.array([camera.centre for camera in cameras])
        low, high = centres[:, :2].min(axis=0) - 2.5, centres[:, :2].max(axis=0) + 2.5
        places = rng.uniform(low, high, (self.num_control, 2))
        points = np.column_stack([places, bed.height(*places.T)])
        lines = []
        for number, point in enumerate(points):
            seen = []
            for camera, name in zip(cameras, names, strict=True):
                (pixel,) = distorted(LENS, camera.project(point[None], flight.water))
                inside = (
                    np.isfinite(pixel).all()
                    and (pixel > 2.0).all()
                    and (pixel < (LENS.width - 2, LENS.height - 2)).all()
                )
                seen += [(name, pixel + _MARK_STD_PX * rng.standard_normal(2) - 0.5)] if inside else []
            off = _POINT_STD_M * rng.standard_normal(3) + (1.5 if self.wrong_control and number == 0 else 0.0)
            (place,) = flight.frame.crs_from_local(point[None] + off)
            shown = rng.permutation(len(seen))[: int(rng.integers(1, 6))]
            role = " check" if number % 5 == 4 else ""
            for name, pixel in (seen[k] for k in sorted(shown)):
                e, n, h = place
                lines.append(f"{e:.4f} {n:.4f} {h:.4f} {pixel[0]:.2f} {pixel[1]:.2f} {name} p{number}{role}")
        return "\n".join([_CRS.split("+")[0], *lines, ""]) if lines else ""

    def _table(self, cameras: list[PinholeCamera], frame: LocalFrame, *, controlled: bool) -> dict:
        """Survey.toml."""
        table: dict = {"name": f"block {self.seed}", "crs": _CRS, "cameras": {}}
        if self.has_lens:
            fx, _, cx, cy, *distortion = LENS.params
            table["cameras"] = {"model": "OPENCV", "size_px": [LENS.width, LENS.height], "focal_px": fx}
            table["cameras"] |= {"principal_point_px": [cx, cy], "distortion": distortion}
        if self.given != "found":
            table["cameras"]["poses"] = "cameras.csv"
        if self.given == "stated":
            table["cameras"] |= {"position_std_m": _POSE_STD_M, "rotation_std_deg": _POSE_STD_DEG}
        if self.ground != "dry":
            table["water"] = {"refractive_index": _INDEX}
            if self.level != "missing":
                table["water"]["level_m"] = _LEVEL_M + (0.3 if self.level == "off" else 0.0)
            if self.level == "stated":
                table["water"]["level_std_m"] = 0.02
        if controlled:
            table["control"] = {"gcps": "gcp_list.txt"}
        if self.has_area:
            places = frame.crs_from_local(np.array([camera.centre for camera in cameras]))[:, :2]
            (e0, n0), (e1, n1) = places.min(axis=0) - 2.0, places.max(axis=0) + 2.0
            table["area"] = {"bounds": [round(float(v), 3) for v in (e0, n0, e1, n1)]}
        return table


@dataclass(frozen=True)
class Flight:
    """A flight of two lines over one ground; its frame has its origin on the water, or where it would be.

    Attributes
    ----------
    frame : LocalFrame
    cameras : tuple of PinholeCamera
        The lines one after the other.
    water : FlatWater or None
    scene : DrawnScene
    """

    frame: LocalFrame
    cameras: tuple[PinholeCamera, ...]
    water: FlatWater | None
    scene: DrawnScene

    @classmethod
    @cache
    def of(cls, ground: str) -> Flight:
        """That over one of `GROUNDS`."""
        number = GROUNDS.index(ground)
        rng = np.random.default_rng([number, 35])
        cameras = []
        for line in range(2):
            for k in range(PER_LINE):
                x, y = _STEP_M * (k - 0.5 * PER_LINE), _APART_M * (line - 0.5)
                centre = np.array([x, y, _FLYING_M]) + rng.normal(0.0, (0.15, 0.15, 0.2))
                cameras.append(LENS.pinhole(centre, _shaken(rng, 1 - 2 * line)))
        water = None if ground == "dry" else FlatWater((0.0, 0.0, 0.0), n_water=_INDEX)
        frame = LocalFrame(parse_crs(_CRS), (*_ORIGIN, _LEVEL_M))
        scene = DrawnScene(
            size_m=(_STEP_M * PER_LINE, 9.0), depth_m=1.6, seed=number, objects=False, shore=ground != "wet"
        )
        return cls(frame, tuple(cameras), water, scene)


def name_of(number: int) -> str:
    """The name of a photograph of a flight."""
    return f"DJI_{number:04d}.jpg"


def is_inside(pixels: np.ndarray) -> np.ndarray:
    """Which pixels (N, 2) lie in a photograph (N,) bool, two from its border at least."""
    return ((pixels > 2.0) & (pixels < (LENS.width - 2.0, LENS.height - 2.0))).all(axis=1)


def draw_flights(folder: Path) -> None:
    """Draw the photographs of the three flights, those that are missing; some minutes of one core."""
    for ground in GROUNDS:
        own, flight = folder / ground, Flight.of(ground)
        own.mkdir(parents=True, exist_ok=True)
        names = [own / f"{k:03d}.png" for k in range(len(flight.cameras))]
        if all(path.is_file() for path in names) and (own / _BED).is_file():
            continue
        drawn = build_ground(flight.scene, flight.cameras, Light())
        bed = drawn.bed
        assert isinstance(bed, BedGrid)
        np.savez(own / _BED, heights=bed.heights, corner=np.array([bed.west, bed.south, bed.cell]))
        renderer, sensor = DirectRenderer(drawn, flight.water, WaterOptics()), Sensor(noise=1.5)
        for k, path in enumerate(names):
            if not path.is_file():
                light = sensor.photograph(renderer.radiance_of_rays, flight.cameras[k], LENS, (flight.scene.seed, k))
                Image.fromarray(light).save(path)


@cache
def bed_of(folder: Path) -> BedGrid:
    """The true bed under a flight, local."""
    with np.load(folder / _BED) as arrays:
        west, south, cell = (float(v) for v in arrays["corner"])
        return BedGrid(arrays["heights"], west, south, cell)


def _shaken(rng: np.random.Generator, along: int) -> np.ndarray:
    """A camera (3, 3) from local that looks down, the top of its image to the east or the west, shaken by wind."""
    axes = np.array([[0.0, -along, 0.0], [-along, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return _turned(axes, rng.normal(0.0, (0.03, 0.04, 0.05)))


def _turned(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    x, y, z = angles
    small = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    # The nearest rotation.
    u, _, vt = np.linalg.svd(small)
    return u @ vt @ axes


def _moved(cameras: list[PinholeCamera], rng: np.random.Generator) -> list[PinholeCamera]:
    """Poses as another program found them."""
    return [
        LENS.pinhole(
            camera.centre + _POSE_STD_M * rng.standard_normal(3),
            _turned(camera.cam_from_local, np.radians(_POSE_STD_DEG) * rng.standard_normal(3)),
        )
        for camera in cameras
    ]
