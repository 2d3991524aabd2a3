"""Pictures of what bends between two photographs, with the colour, and with errors of the water; of the sun's glitter.

Used by draw_gallery.py.
"""

from dataclasses import dataclass

import numpy as np
from gallery_canvas import BLUE, DARK_ORANGE, GREEN, GRID, IN_WATER, INK, ORANGE, RED, canvas, label, note
from matplotlib import colormaps
from matplotlib.figure import Figure

from refract import FlatWater, PinholeCamera, crossing_point, trace, water_index
from survey.plan.light import glitters

# 35 mm and pixels of 20 um: 59 by 46 degrees of view.
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 1750.0, 2000, 1500
FLYING_HEIGHT_M, DEPTH_M = 39.0, 3.5
N_WATER = 1.333
WATER = FlatWater((0.0, 0.0, 0.0), n_water=N_WATER)
# The pixel of the first photograph, and the depths of what may be seen there.
PIXEL, DEPTHS = np.array([1700.0, 200.0]), np.linspace(0.05, 8.0, 160)


@dataclass(frozen=True)
class Network:
    """Cameras over the bed, with a name for a picture."""

    name: str
    cameras: list[PinholeCamera]

    @property
    def centres(self) -> np.ndarray:
        return np.array([camera.centre for camera in self.cameras])


def look(centre, target) -> PinholeCamera:
    """A camera at `centre` with its axis through `target` (both local, m), its rows level."""
    forward = np.subtract(target, centre) / np.linalg.norm(np.subtract(target, centre))
    right = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[2]) > 0.999 else (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return PinholeCamera(centre, rotation, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2, WIDTH_PX, HEIGHT_PX)


def nadir_block() -> Network:
    """Four strips of five views, straight down."""
    places = [(x, y) for y in (-6.0, -2.0, 2.0, 6.0) for x in (-8.0, -4.0, 0.0, 4.0, 8.0)]
    return Network("nadir block", [look((x, y, FLYING_HEIGHT_M), (x, y, 0.0)) for x, y in places])


def convergent_block() -> Network:
    """The nadir block with three rings of twelve views of its middle, 30, 38 and 45 degrees off nadir."""
    rings = []
    for off_nadir in np.radians([30.0, 38.0, 45.0]):
        reach = FLYING_HEIGHT_M * np.tan(off_nadir)
        for azimuth in np.arange(12) * (2.0 * np.pi / 12) + off_nadir:
            centre = (reach * np.cos(azimuth), reach * np.sin(azimuth), FLYING_HEIGHT_M)
            rings.append(look(centre, (0.0, 0.0, -DEPTH_M)))
    return Network("the same with oblique rings", nadir_block().cameras + rings)


def meeting_points(cameras, toward, seen) -> tuple[np.ndarray, np.ndarray]:
    """Where straight rays from the cameras come nearest to each other, in least squares.

    Parameters
    ----------
    cameras : (V, 3) [m]
    toward : (P, V, 3) [m]
        A second point of each ray.
    seen : (P, V) bool
        Rays that count; at least two for each point.

    Returns
    -------
    points : (P, 3) [m]
    misses : (P,) [rad]
        Root mean square of the angles by which the rays miss their meeting point.
    """
    ray = toward - cameras
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) * seen[..., None, None]
    points = np.linalg.solve(across.sum(axis=1), np.einsum("pvij,vj->pi", across, cameras)[..., None])[..., 0]
    off = points[:, None] - cameras
    misses = np.linalg.norm(np.cross(off, ray), axis=-1) / np.linalg.norm(off, axis=-1)
    return points, np.sqrt((misses**2 * seen).sum(axis=1) / seen.sum(axis=1))


def error_map(network: Network, water: FlatWater, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height error of straight rays [m] and their rms miss [px] at places (P, 2) of a bed 3.5 m deep; NaN unseen."""
    bed = np.concatenate([places, np.full((len(places), 1), -DEPTH_M)], axis=1)
    pixels = np.stack([camera.project(bed, water) for camera in network.cameras], axis=1)
    seen = ((pixels >= 0.0) & (pixels <= (WIDTH_PX, HEIGHT_PX))).all(axis=-1)
    error, miss = np.full((2, len(bed)), np.nan)
    usable = seen.sum(axis=1) >= 3
    toward = crossing_point(bed[usable, None], network.centres, water)
    points, angles = meeting_points(network.centres, toward, seen[usable])
    error[usable], miss[usable] = points[:, 2] + DEPTH_M, FOCAL_PX * angles
    return error, miss


def epipolar_places() -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2) [px] in a second photograph of what a pixel of the first may show: bent, and with straight rays."""
    first, second = look((0.0, 0.0, 25.0), (4.0, 4.0, 0.0)), look((14.0, -3.0, 25.0), (4.0, 4.0, 0.0))
    bent = first.paths(PIXEL, WATER).at_height(-DEPTHS, WATER)
    straight = first.paths(PIXEL, None).at_height(-DEPTHS, None)
    return second.project(bent, WATER), second.project(straight, None)


def beside_line(places: np.ndarray, straight: np.ndarray) -> np.ndarray:
    """How far [px] places (N, 2) lie beside the line through straight ones (N, 2)."""
    along = straight[-1] - straight[0]
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return (places - straight[0]) @ across


def draw_epipolar() -> Figure:
    """The epipolar curve of a pixel through the water, and how far it lies beside the epipolar line."""
    figure, ((left, right),) = canvas(8.0, 3.7, ncols=2)
    bent, straight = epipolar_places()
    left.grid(color=GRID, lw=0.7)
    left.plot(*straight.T, color=RED, lw=1.2, ls=(0, (5, 2)))
    drawn = left.scatter(*bent.T, c=DEPTHS, s=7, cmap=colormaps["viridis_r"], zorder=3)
    left.invert_yaxis()
    bar = figure.colorbar(drawn, ax=left, shrink=0.9)
    bar.set_label("depth [m]", color=INK)
    bar.outline.set_visible(False)
    note(left, "epipolar line\nof straight rays", (1580.0, 1690.0), color=RED)
    label(left, "One pixel's places in the next photograph", "column [px]", "row [px]")
    beside = beside_line(bent, straight)
    right.grid(color=GRID, lw=0.7)
    right.axhline(0.0, color=RED, lw=1.2, ls=(0, (5, 2)))
    right.plot(DEPTHS, beside, color=BLUE, lw=2.0)
    right.set(xlim=(0, 8))
    label(right, "Beside the epipolar line", "depth [m]", "[px]")
    return figure


def colour_shift_px(angle: np.ndarray, depth_m: float, other_nm: float) -> np.ndarray:
    """How far [px] light of a wavelength is seen from green light (550 nm) of the same point, over the incidence [rad].

    A camera 20 m over the water with a focal length of 3000 px.
    """
    height, focal = 20.0, 3000.0
    rays = np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=-1)
    shift = []
    for wavelength in (550.0, other_nm):
        water = FlatWater((0.0, 0.0, 0.0), n_water=float(water_index(wavelength, 15.0, 0.0)))
        shift.append(trace(np.array([0.0, 0.0, height]), rays, water).at_height(-depth_m, water)[..., 0])
    # Metres on the bed to pixels, along the radius of the photograph.
    scale = np.gradient(focal * np.tan(angle), shift[0])
    return (shift[0] - shift[1]) * scale


def draw_dispersion() -> Figure:
    """The index of water over the wavelength, and how far red and blue light are seen apart."""
    figure, ((left, right),) = canvas(8.0, 3.6, ncols=2)
    wavelength = np.linspace(420.0, 680.0, 200)
    for salinity, name, colour in ((0.0, "fresh, 15 °C", BLUE), (35.0, "sea, 15 °C", GREEN)):
        index = water_index(wavelength, 15.0, salinity)
        left.plot(wavelength, index, color=colour, lw=2.0)
        note(left, name, (560.0, float(np.interp(560.0, wavelength, index)) + 0.0008), color=colour)
    left.grid(color=GRID, lw=0.7)
    label(left, "Index of water relative to air", "wavelength [nm]", "")
    degrees = np.linspace(0.0, 40.0, 200)
    for other, name, colour in ((470.0, "blue", BLUE), (610.0, "red", RED)):
        shift = colour_shift_px(np.radians(degrees), 4.0, other)
        right.plot(degrees, shift, color=colour, lw=2.0)
        note(right, f"{name}, {other:.0f} nm", (12.0, float(shift[100]) + 0.07), color=colour)
    right.axhline(0.0, color=GREEN, lw=1.2)
    right.grid(color=GRID, lw=0.7)
    label(right, "Seen beside green, bed at 4 m", "incidence in air [°]", "[px]")
    return figure


def depth_errors(degrees: np.ndarray, depth_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the depth [m] over the incidence [°]: of a level taken 5 cm too high, of an index 0.01 too large.

    Two cameras see a point at the same incidence from opposite sides; their rays through the water that is assumed
    meet over its place.
    """
    angle = np.radians(degrees)
    tangent = np.tan(np.arcsin(np.sin(angle) / N_WATER))
    offset = depth_m * tangent
    level, index = 0.05, 0.01
    # Higher water: the crossing moves back along the ray in air, and the rest of the way is wet.
    by_level = (offset + level * np.tan(angle)) / tangent - depth_m - level
    by_index = offset / np.tan(np.arcsin(np.sin(angle) / (N_WATER + index))) - depth_m
    return by_level, by_index


def draw_water_errors() -> Figure:
    """What a wrong level and a wrong index make of the height of the bed."""
    figure, ((left, right),) = canvas(8.0, 3.5, ncols=2, sharex=True)
    degrees = np.linspace(0.5, 45.0, 200)
    for depth, colour in ((1.0, GREEN), (3.0, BLUE), (6.0, ORANGE)):
        by_level, by_index = depth_errors(degrees, depth)
        left.plot(degrees, -100.0 * by_level, color=colour, lw=2.0)
        right.plot(degrees, -100.0 * by_index, color=colour, lw=2.0)
        note(
            right,
            f"{depth:.0f} m",
            (40.5, -100.0 * float(by_index[180]) + 0.25),
            color=DARK_ORANGE if depth > 5 else colour,
        )
    for axes in (left, right):
        axes.grid(color=GRID, lw=0.7)
        axes.axhline(0.0, color=INK, lw=1.0)
        axes.set(xlim=(0, 45))
    note(left, "at any depth", (17.0, -100.0 * float(depth_errors(np.array([17.0]), 1.0)[0][0]) + 0.06))
    label(left, "A level 5 cm too high", "incidence in air [°]", "error of the height of the bed [cm]")
    label(right, "An index 0.01 too large", "incidence in air [°]", "")
    return figure


def glitter_share(sun_deg: float, wind_m_s: float) -> float:
    """Share of a photograph straight down that glitter of a sun at a height covers, the sun ahead."""
    return float(_glitter(sun_deg, wind_m_s).mean())


def _glitter(sun_deg: float, wind_m_s: float) -> np.ndarray:
    """Whether pixels (rows, columns) of the frame show glitter."""
    camera = look((0.0, 0.0, 25.0), (0.0, 0.0, 0.0))
    columns, rows = np.meshgrid(np.arange(5.0, camera.width, 10.0), np.arange(5.0, camera.height, 10.0))
    sun = np.radians(sun_deg)
    toward = np.array([0.0, np.cos(sun), np.sin(sun)])
    return glitters(camera.directions(np.stack([columns, rows], axis=-1)), toward, np.array([0.0, 0.0, 1.0]), wind_m_s)


def draw_glitter() -> Figure:
    """Where the sun's glitter lies in a photograph straight down, for two heights of the sun and three winds."""
    figure, plots = canvas(8.0, 3.4, ncols=2)
    for axes, sun in zip(plots[0], (50.0, 68.0), strict=True):
        axes.set(facecolor=IN_WATER, xticks=[], yticks=[], aspect="equal")
        for wind, alpha in ((6.0, 0.35), (3.0, 0.6), (1.0, 1.0)):
            shown = _glitter(sun, wind)
            extent = (0.0, shown.shape[1], 0.0, shown.shape[0])
            axes.contourf(
                shown.astype(float), levels=[0.5, 1.5], colors=[ORANGE], alpha=alpha, extent=extent, origin="upper"
            )
        shares = ", ".join(f"{100.0 * glitter_share(sun, wind):.0f} %" for wind in (1.0, 3.0, 6.0))
        label(axes, f"Sun at {sun:.0f}°: {shares} of the photograph", "in a wind of 1, 3, 6 m/s", "")
    return figure
