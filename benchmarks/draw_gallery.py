"""What does a water surface do to a survey? Draws the nine pictures of the optics in docs/gallery.md.

    python benchmarks/draw_gallery.py [NAME ...] [-o FOLDER]

Names are those of the pictures without their ending; default: all, into docs/img. Takes seconds.
"""

import argparse
from pathlib import Path

import numpy as np
from gallery_canvas import (
    BED,
    BLUE,
    DARK_ORANGE,
    GREEN,
    GRID,
    IN_WATER,
    INK,
    ORANGE,
    RED,
    SOFT,
    canvas,
    label,
    line,
    note,
    save,
    section,
)  # fmt: skip
from gallery_matching import (
    convergent_block,
    draw_dispersion,
    draw_epipolar,
    draw_glitter,
    draw_water_errors,
    error_map,
    meeting_points,
    nadir_block,
)
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from refract import FlatWater, apparent_depth, apparent_depth_tangential, bend, crossing_point, tangential_shift, trace
from refract.curved.surfaces import WavyWater

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "img"
N_WATER = 1.333
WATER = FlatWater((0.0, 0.0, 0.0), n_water=N_WATER)
UP = np.array([0.0, 0.0, 1.0])
OVER_WAVES, OVER_BED = np.array([0.0, 0.0, 6.0]), 2.5


def draw_bending() -> Figure:
    """Rays of five cameras to two points of the bed, and where the same rays meet if they are not bent."""
    figure, plots = canvas(8.0, 4.6)
    axes = plots[0, 0]
    section(axes, -8.4, 8.4, -4.6, 4.6)
    cameras = np.array([[x, 0.0, 4.0] for x in (-6.6, -3.3, 0.0, 3.3, 6.6)])
    x = np.linspace(-10.0, 10.0, 801)
    bed = np.stack([x, 0.0 * x, -3.4 + 0.28 * np.sin(0.9 * x) + 0.9 * np.exp(-((x - 4.4) ** 2) / 0.5)], axis=-1)
    found, _ = meeting_points(cameras, crossing_point(bed[:, None], cameras, WATER), np.ones((len(x), 5), bool))
    axes.fill_between(x, bed[:, 2], -4.6, color=BED, alpha=0.35, lw=0)
    axes.plot(x, bed[:, 2], color=BED, lw=2.0)
    axes.plot(found[:, 0], found[:, 2], color=RED, lw=1.8, ls=(0, (5, 2)))
    for index in (np.argmin(np.abs(x + 2.2)), np.argmin(np.abs(x - 4.4))):
        for camera in cameras:
            crossing = crossing_point(bed[index], camera, WATER)
            ray = crossing - camera
            line(axes, camera, crossing, color=INK, lw=0.9)
            line(axes, crossing, bed[index], color=BLUE, lw=1.3)
            line(axes, crossing, crossing + ray * (found[index, 2] - 0.3) / ray[2], color=RED, lw=0.9, ls=":")
        axes.plot(bed[index, 0], bed[index, 2], "o", color=INK, ms=5)
        axes.plot(found[index, 0], found[index, 2], "o", color="white", mec=RED, mew=1.5, ms=5.5, zorder=3)
    axes.plot(cameras[:, 0], cameras[:, 2], "s", color=INK, ms=6)
    note(axes, "true bed", (-8.1, -4.25))
    note(axes, "apparent bed:\nwhere straight rays meet", (-8.1, -2.55), color=RED)
    note(axes, "water, n = 1.333", (5.85, -0.45), color=BLUE)
    note(axes, "five cameras", (0.25, 4.15))
    label(axes, "Bending at the surface", "along the strip [m]", "height over the water [m]")
    return figure


def draw_apparent_depth() -> Figure:
    """Both apparent depths over incidence, and the error that remains after multiplying them by the index."""
    figure, ((left, right),) = canvas(8.0, 3.7, ncols=2)
    degrees = np.linspace(0.0, 80.0, 801)
    angle = np.radians(degrees)
    sagittal = apparent_depth(1.0, angle, n_water=N_WATER)
    tangential = apparent_depth_tangential(1.0, angle, n_water=N_WATER)
    for axes, base, draw in ((left, 1.0, lambda h: h), (right, 0.0, lambda h: 100.0 * (N_WATER * h - 1.0))):
        axes.grid(color=GRID, lw=0.7)
        axes.axhline(base, color=INK, lw=1.4)
        axes.plot(degrees, draw(sagittal), color=BLUE, lw=2.0)
        axes.plot(degrees, draw(tangential), color=ORANGE, lw=2.0, ls=(0, (6, 1.5)))
    left.set(xlim=(0, 80), ylim=(0.0, 1.08))
    left.axhline(1.0 / N_WATER, color=SOFT, lw=1.0, ls=":")
    note(left, "true depth", (1.5, 1.02))
    note(left, "1/n", (75, 1.0 / N_WATER + 0.02), color=SOFT)
    note(left, "sagittal: cameras\naround the point", (49, 0.63), color=BLUE)
    note(left, "tangential:\ncameras in line\nwith the point", (8, 0.30), (35.5, 0.555), color=DARK_ORANGE)
    label(left, "What straight rays make of one metre", "incidence in air [°]", "apparent depth / true depth")
    right.axhspan(-1.0, 1.0, color=GREEN, alpha=0.18, lw=0)
    right.set(xlim=(0, 50), ylim=(-31, 3))
    for curve, colour, side in ((sagittal, BLUE, 1.5), (tangential, DARK_ORANGE, -11.5)):
        for share in (1, 5, 10):
            at = float(np.interp(0.01 * share, 1.0 - N_WATER * curve, degrees))
            right.plot(at, -share, "o", color=colour, ms=5, zorder=3)
            if share > 1:
                note(right, f"{share} % at {at:.0f}°", (at + side, -share + (0.1 if side > 0 else -1.4)), color=colour)
    first = [np.interp(0.01, 1.0 - N_WATER * curve, degrees) for curve in (sagittal, tangential)]
    note(right, "within 1 %: up to {:.0f}° and {:.0f}°".format(*first), (17.5, 1.35), color=GREEN)
    label(right, "Multiplied by n: what is left", "incidence in air [°]", "error of depth [% of depth]")
    return figure


def draw_caustic() -> Figure:
    """The envelopes of bent rays extended straight: of a bed point seen from air, of a camera seen from the water."""
    figure, ((left, right),) = canvas(8.0, 3.9, ncols=2)
    caustic_of_point(left)
    caustic_of_camera(right)
    return figure


def caustic_of_point(axes: Axes) -> None:
    """Rays of a point one metre down leave the water as if they came from places above it."""
    section(axes, -1.6, 1.6, -1.2, 1.7)
    point = np.array([0.0, 0.0, -1.0])
    for angle in np.radians(np.arange(-45.0, 45.1, 5.0)):
        up = np.array([np.sin(angle), 0.0, np.cos(angle)])
        crossing = point + up / up[2]
        out = bend(up, -UP, n_from=N_WATER, n_to=1.0)
        depth = apparent_depth_tangential(1.0, np.arccos(out[2]), n_water=N_WATER)
        line(axes, point, crossing, color=BLUE, lw=0.7)
        line(axes, crossing, crossing + 6.0 * out, color=INK, lw=0.8)
        line(axes, crossing, crossing - depth / out[2] * out, color=RED, lw=0.8, ls=":")
    in_air = np.radians(np.linspace(0.0, 89.0, 400))
    shift = tangential_shift(1.0, in_air, n_water=N_WATER)
    caustic(axes, shift, -apparent_depth_tangential(1.0, in_air, n_water=N_WATER))
    axes.plot([0.0, 0.0], [-1.0 / N_WATER, 0.0], color=GREEN, lw=2.4, zorder=4)
    axes.plot(*point[[0, 2]], "o", color=INK, ms=6, zorder=5)
    note(axes, "bed point", (0.08, -1.13))
    note(axes, "seen in line\nwith it: here", (0.85, -0.85), (0.42, -0.36), color=RED)
    note(axes, "seen from all\naround: here", (-1.55, -0.85), (-0.01, -0.62), color=GREEN)
    label(axes, "A bed point, seen from air", "distance / depth", "height / depth")


def caustic_of_camera(axes: Axes) -> None:
    """Rays of a camera one metre up continue in the water as if they came from places above it."""
    section(axes, -2.2, 2.2, -1.1, 2.8875)
    camera = np.array([0.0, 0.0, 1.0])
    for angle in np.radians(np.arange(-60.0, 60.1, 6.0)):
        path = trace(camera, np.array([np.sin(angle), 0.0, -np.cos(angle)]), WATER)
        wet = path.water_direction
        # The closed forms hold both ways: seen from the water, air has the index 1 / n.
        height = apparent_depth_tangential(1.0, np.arccos(-wet[2]), n_water=1.0 / N_WATER)
        line(axes, camera, path.crossing, color=INK, lw=0.8)
        line(axes, path.crossing, path.crossing + 3.0 * wet, color=BLUE, lw=0.7)
        line(axes, path.crossing, path.crossing + height / wet[2] * wet, color=RED, lw=0.8, ls=":")
    in_water = np.radians(np.linspace(0.0, 40.0, 400))
    height = apparent_depth_tangential(1.0, in_water, n_water=1.0 / N_WATER)
    caustic(axes, tangential_shift(1.0, in_water, n_water=1.0 / N_WATER), height)
    axes.plot([0.0, 0.0], [N_WATER, 2.9], color=GREEN, lw=2.4, zorder=4)
    axes.plot(*camera[[0, 2]], "s", color=INK, ms=6, zorder=5)
    note(axes, "camera", (0.95, 0.95), (0.07, 1.0))
    note(axes, "the rays in water\nhave no centre", (0.75, 1.75), (0.11, 1.62), color=RED)
    label(axes, "A camera, seen from the water", "distance / flying height", "height / flying height")


def caustic(axes: Axes, x: np.ndarray, z: np.ndarray) -> None:
    """Both branches of an envelope that is mirrored in the vertical through its tip."""
    for side in (-1.0, 1.0):
        axes.plot(side * x, z, color=RED, lw=2.2, zorder=4)


def draw_error_map() -> Figure:
    """Height errors of straight rays over the plan, and how far the rays miss each other, for two networks."""
    figure, plots = canvas(8.0, 7.0, nrows=2, ncols=2, sharex=True, sharey=True)
    grid = np.linspace(-10.0, 10.0, 161)
    places = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    networks = (nadir_block(), convergent_block())
    maps = [error_map(network, WATER, places) for network in networks]
    rows = (
        ("m too high", "height error of straight rays [m]", "viridis", (0.85, 1.25, 16)),
        ("px", "straight rays miss each other by [px rms]", "YlOrBr", (0.0, 3.25, 13)),
    )
    for row, (unit, meaning, colours, (low, high, levels)) in enumerate(rows):
        for axes, network, values in zip(plots[row], networks, (found[row] for found in maps), strict=True):
            cells = {"vmin": low, "vmax": high, "cmap": colormaps[colours].resampled(levels), "rasterized": True}
            drawn = axes.pcolormesh(grid, grid, values.reshape(len(grid), -1), **cells)
            axes.plot(network.centres[:, 0], network.centres[:, 1], "^", color="white", mec=INK, mew=0.7, ms=5)
            axes.set(xlim=(-10, 10), ylim=(-10, 10), aspect="equal", xticks=range(-10, 11, 5), yticks=range(-10, 11, 5))
            edges = ("east [m]" if row else "", "north [m]" if network is networks[0] else "")
            label(axes, f"{network.name}: {values.mean():.2f} {unit}", *edges)
        bar = figure.colorbar(drawn, ax=plots[row], shrink=0.9)
        bar.set_label(meaning, color=INK)
        bar.outline.set_visible(False)
        bar.ax.tick_params(colors=SOFT, labelsize=8.5)
    return figure


def draw_waves() -> Figure:
    """Camera rays through swell and through ripples, and by how much they shift what is seen."""
    figure, plots = canvas(8.0, 6.3, nrows=2, ncols=2, sharex=True, sharey="row", height_ratios=(3, 2))
    seas = (("Swell: 3 m long, 12 cm high", 3.0, 0.06), ("Ripples: 0.5 m long, 5 cm high", 0.5, 0.025))
    for (title, length, height), (above, below) in zip(seas, plots.T, strict=True):
        water = WavyWater((0.0, 0.0, 0.0), [height], [(2.0 * np.pi / length, 0.0)], [0.9], n_water=N_WATER)
        draw_rays(above, water)
        draw_shifts(below, water)
        label(above, title, "", "" if length < 1.0 else "height over the water [m]")
        label(below, "", "place on the bed [m]", "" if length < 1.0 else "seen aside by [cm]")
    note(plots[1, 1], "orange: seen in three places", (-1.93, 23.2), color=DARK_ORANGE)
    return figure


def fan(number: int) -> np.ndarray:
    """Unit directions (number, 3) from the camera over the waves, at equal angles."""
    angle = np.linspace(-0.37, 0.37, number)
    return np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=-1)


def draw_rays(axes: Axes, water: WavyWater) -> None:
    """Rays at equal angles from the camera to the bed: crests gather them."""
    bottom, top = -OVER_BED - 0.25, 0.75
    axes.set(xlim=(-2.0, 2.0), ylim=(bottom, top), aspect="equal")
    x = np.linspace(-2.0, 2.0, 600)
    axes.fill_between(x, water.height(x, 0.0 * x), bottom, color=IN_WATER, lw=0, zorder=0)
    axes.fill_between(x, -OVER_BED + 0.0 * x, bottom, color=BED, alpha=0.5, lw=0)
    axes.plot(x, water.height(x, 0.0 * x), color=BLUE, lw=1.2)
    path = trace(OVER_WAVES, fan(91), water)
    for crossing, ray, wet in zip(path.crossing, path.air_direction, path.water_direction, strict=True):
        line(axes, crossing - 2.0 * ray, crossing, color=INK, lw=0.45)
        line(axes, crossing, crossing - wet * (crossing[2] + OVER_BED) / wet[2], color=BLUE, lw=0.6)


def draw_shifts(axes: Axes, water: WavyWater) -> None:
    """Apparent displacement of points of the bed if the water is assumed flat, along every path."""
    path = trace(OVER_WAVES, fan(4001), water)
    fall = (path.crossing[:, 2] + OVER_BED) / path.water_direction[:, 2]
    true = path.crossing[:, 0] - fall * path.water_direction[:, 0]
    taken = trace(OVER_WAVES, fan(4001), WATER).at_height(-OVER_BED, WATER)[:, 0]
    axes.plot(true, 100.0 * (taken - true), color=RED, lw=1.4)
    axes.axhline(0.0, color=INK, lw=1.0)
    axes.grid(color=GRID, lw=0.7)
    axes.set(xlim=(-2.0, 2.0), ylim=(-27.0, 27.0))
    x = np.linspace(-2.0, 2.0, 801)
    # Each end of a stretch of rays whose order is reversed on the bed lies between two other paths.
    several = np.array([np.count_nonzero(np.diff(np.sign(true - place))) > 1 for place in x])
    axes.fill_between(x, -27.0, 27.0, where=several, color=ORANGE, alpha=0.3, lw=0)


PICTURES = {
    "bending": draw_bending,
    "apparent-depth": draw_apparent_depth,
    "caustic": draw_caustic,
    "error-map": draw_error_map,
    "waves": draw_waves,
    "epipolar": draw_epipolar,
    "dispersion": draw_dispersion,
    "water-errors": draw_water_errors,
    "glitter": draw_glitter,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    parser.add_argument("-o", "--out", type=Path, default=IMAGES, metavar="FOLDER")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - PICTURES.keys())
    if unknown:
        parser.error(f"no picture {', '.join(unknown)}, expected some of {', '.join(PICTURES)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names or PICTURES:
        path = arguments.out / f"gallery-{name}.png"
        save(PICTURES[name](), path)
        print(f"{path} {path.stat().st_size / 1000:.0f} kB")  # noqa: T201


if __name__ == "__main__":
    main()
