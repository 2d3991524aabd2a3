"""What real photographs hold beside a still bed: scenes of bench_conditions.py, each photograph with light of its own.

The truth of all of them is the bed under still water; the poses are those of the flight.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree
from stress_factors import with_waves
from sun_on_waves import HIGH_SUN, sunlit, suns_of

from refract import FlatWater
from refract.curved import WavyWater
from survey.simulate.conditions import Light, RadianceFunction, WaterOptics
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground import Ground, Material, shade_of_normals
from survey.simulate.shapes import Solid
from survey.simulate.sidecars import StagedScene
from survey.simulate.textures import TILE, ImageTexture, periodic

# Between two photographs [s], and the acceleration of gravity [m/s2].
BETWEEN_S, _GRAVITY = 2.0, 9.81
# Water of a brown stream: yellow substance takes blue first, and what is suspended veils the bed.
BROWN = WaterOptics(absorption=(0.9, 1.3, 2.4), veil=(0.07, 0.05, 0.02), veiling=1.2)

# The scene as one photograph of it shows it.
OfPhotograph = Callable[[StagedScene, int], StagedScene]


def scene_of(seed: int, **changes) -> DrawnScene:
    """A survey of 16 photographs of 320 x 240 pixels, 2.5 cm a pixel, over a bed 1.5 to 2.5 m deep."""
    rng = np.random.default_rng([seed, 51])
    base = DrawnScene(
        size_m=(5.5, 5.0), depth_m=float(rng.uniform(1.5, 2.5)), num_views=16, image_px=(320, 240), focal_px=560.0,
        flying_m=14.0, noise=1.5, seed=seed, objects=False,
    )  # fmt: skip
    return replace(base, **changes)


@dataclass(frozen=True)
class ChangingScene(StagedScene):
    """A scene that every photograph shows otherwise.

    Attributes
    ----------
    of_photograph : callable
        Of the scene without changes and the number of a photograph: the scene that it shows.
    """

    of_photograph: OfPhotograph | None = None

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera."""
        assert self.of_photograph is not None
        plain = StagedScene(**{each.name: getattr(self, each.name) for each in fields(StagedScene)})
        return self.of_photograph(plain, index).photograph(index)


def changing(scene: StagedScene, of_photograph: OfPhotograph) -> ChangingScene:
    """A scene with photographs that are each taken of another one."""
    return ChangingScene(
        **{each.name: getattr(scene, each.name) for each in fields(scene)}, of_photograph=of_photograph
    )


@dataclass(frozen=True)
class Flakes:
    """Discs on the water: foam, leaves, swimmers.

    Attributes
    ----------
    places : (N, 2) [m], local, at the time zero
    radii : (N,) [m]
    colours : (N, 3)
        Linear radiance.
    velocities : (N, 2) [m/s]
    """

    places: np.ndarray
    radii: np.ndarray
    colours: np.ndarray
    velocities: np.ndarray

    def over(self, radiance_of: RadianceFunction, time_s: float) -> RadianceFunction:
        """Radiance along rays with the discs, at a time, on the plane z = 0."""
        tree, order = cKDTree(self.places + time_s * self.velocities), min(6, len(self.places))

        def seen(origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
            light = radiance_of(origin, direction, seed)
            at = origin[:, :2] - (origin[:, 2] / direction[:, 2])[:, None] * direction[:, :2]
            distance, which = tree.query(at, k=order)
            inside = distance < self.radii[which]
            covered = inside.any(axis=1)
            first = which[covered, inside[covered].argmax(axis=1)]
            light[covered] = self.colours[first]
            return light

        return seen


def glitter(scene: StagedScene, share: float) -> StagedScene:
    """The sun on waves, whose mirror image saturates a share of all pixels; for a scene with `HIGH_SUN`."""
    suns = suns_of(scene.cameras, _plane(scene), Light(to_sun=HIGH_SUN), seed=scene.seed, glint_share=share)
    return changing(scene, lambda plain, k: sunlit(plain, suns[k]))


def caustics(scene: StagedScene, contrast: float) -> StagedScene:
    """Light that waves focus on the bed: standard deviation over mean, at the mean depth of the bed."""
    depth = -float(np.mean(scene.renderer.ground.bed.mesh()[0][:, 2]))
    suns = suns_of(scene.cameras, _plane(scene), Light(), seed=scene.seed, glint_share=0.0)
    return changing(scene, lambda plain, k: sunlit(plain, suns[k].with_caustics(depth, contrast)))


def _plane(scene: StagedScene) -> FlatWater:
    assert isinstance(scene.water, FlatWater)
    return scene.water


def foam(scene: StagedScene, share: float) -> StagedScene:
    """Flecks of foam and leaves that cover a share of the water and drift with it at 0.15 m/s, spinning apart."""
    rng = np.random.default_rng([scene.seed, 52])
    reach = 9.0
    # A patch is a cluster of flecks; a third are single leaves.
    radii, places = [], []
    while sum(math.pi * each**2 for each in radii) < share * (2.0 * reach) ** 2:
        centre, size = rng.uniform(-reach, reach, 2), float(rng.uniform(0.05, 0.4))
        count = int(rng.integers(1, 30)) if rng.random() < 0.67 else 1
        places += list(centre + size * rng.standard_normal((count, 2)))
        radii += list(rng.uniform(0.02, 0.09, count))
    toward = rng.uniform(0.0, 2.0 * math.pi)
    drift = 0.15 * np.array([math.sin(toward), math.cos(toward)])
    number = len(radii)
    white, leaf = np.array([0.85, 0.88, 0.85]), np.array([0.45, 0.30, 0.10])
    colours = np.where(rng.random((number, 1)) < 0.75, white, leaf) * rng.uniform(0.6, 1.1, (number, 1))
    flakes = Flakes(np.array(places), np.array(radii), colours, drift + 0.01 * rng.standard_normal((number, 2)))
    return changing(scene, lambda plain, k: replace(plain, radiance_of=flakes.over(_radiance_of(plain), BETWEEN_S * k)))


def people(scene: StagedScene, number: float) -> StagedScene:
    """Swimmers of 0.5 m, each of some discs, that go their own ways at up to 0.5 m/s."""
    rng = np.random.default_rng([scene.seed, 53])
    count = int(number)
    centres, ways = rng.uniform(-4.0, 4.0, (count, 2)), rng.uniform(-0.5, 0.5, (count, 2))
    parts = np.array([[0.0, 0.0], [0.2, 0.05], [-0.2, -0.05], [0.35, 0.1], [-0.3, 0.15]])
    radii = np.tile([0.16, 0.14, 0.13, 0.09, 0.09], count)
    colours = rng.uniform(0.05, 0.7, (5 * count, 3))

    def at(plain: StagedScene, k: int) -> StagedScene:
        # They turn back within the area: a triangle wave.
        place = np.abs((centres + BETWEEN_S * k * ways + 4.0) % 16.0 - 8.0) - 4.0
        turned = parts @ _turn(0.7 * k)
        flakes = Flakes((place[:, None] + turned).reshape(-1, 2), radii, colours, np.zeros((5 * count, 2)))
        return replace(plain, radiance_of=flakes.over(_radiance_of(plain), 0.0))

    return changing(scene, at)


def shadow(scene: StagedScene, size_m: float) -> StagedScene:
    """The shadow of the aircraft on the bed, under a high sun: it moves with the camera."""
    to_sun, darkest, soft = np.array([0.1, 0.06, 1.0]), 0.35, 0.15

    def at(plain: StagedScene, k: int) -> StagedScene:
        radiance_of, centre = _radiance_of(plain), plain.cameras[k].centre

        def seen(origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
            points = plain.renderer.trace_rays(origin, direction).points
            middle = centre[:2] - (centre[2] - points[:, 2:]) * to_sun[:2]
            away = np.nan_to_num(np.abs(points[:, :2] - middle).max(axis=1), nan=np.inf)
            light = 1.0 - (1.0 - darkest) * np.clip((0.5 * size_m * (1.0 + soft) - away) / (soft * size_m), 0.0, 1.0)
            return radiance_of(origin, direction, seed) * light[:, None]

        return replace(plain, radiance_of=seen)

    return changing(scene, at)


def brown(scene: StagedScene, strength: float) -> StagedScene:
    """Water in which the bed fades out, as a multiple of `BROWN`."""
    colour = replace(
        BROWN, absorption=tuple(strength * each for each in BROWN.absorption), veiling=strength * BROWN.veiling
    )
    return replace(scene, renderer=replace(scene.renderer, colour=colour))


def ripples(scene: StagedScene, slope: float) -> StagedScene:
    """Waves 5 to 30 cm long of a standard deviation of slope, that bend rays and mirror the sky, and run on.

    The sky is brighter to one side, so that the surface shows them: 4 % of white for slopes of 0.1.
    """
    plane = scene.water
    assert isinstance(plane, FlatWater)
    rng, lengths = np.random.default_rng([scene.seed, 54]), np.geomspace(0.05, 0.3, 6)
    toward = rng.uniform(0.0, 2.0 * math.pi) + rng.normal(0.0, 0.7, len(lengths))
    number = 2.0 * math.pi / lengths
    # Gravity and surface tension over density.
    frequencies = np.sqrt(_GRAVITY * number + 7.3e-5 * number**3)
    waves = WavyWater(
        plane.point,
        (math.sqrt(2.0 / len(lengths)) * slope / number).tolist(),
        np.stack([number * np.sin(toward), number * np.cos(toward)], axis=-1).tolist(),
        rng.uniform(0.0, 2.0 * math.pi, len(lengths)).tolist(),
        frequencies=frequencies.tolist(),
        n_water=plane.n_water,
    )
    times = BETWEEN_S * np.cumsum(rng.uniform(0.8, 1.2, len(scene.cameras)))

    def at(plain: StagedScene, k: int) -> StagedScene:
        water = waves.at(float(times[k]))
        moved = replace(plain.renderer, water=water)

        def seen(origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
            at = origin[:, :2] - (origin[:, 2] / direction[:, 2])[:, None] * direction[:, :2]
            nx, _, nz = water.normal(at[:, 0], at[:, 1])
            return (
                moved.radiance_of_rays(origin, direction, seed) + 0.04 * np.clip(1.0 - nx / nz / 0.1, 0.0, 4.0)[:, None]
            )

        return replace(plain, radiance_of=seen)

    return changing(scene, at)


def motion_blur(scene: StagedScene, blur_px: float) -> StagedScene:
    """The camera flies so many pixels of the ground on while the shutter is open, to the top of its image."""
    gsd = scene.cameras[0].centre[2] / scene.lens.focal[0]
    return replace(scene, sensor=replace(scene.sensor, blur_m=blur_px * gsd, samples=9))


def focal_drift(scene: StagedScene, share: float) -> StagedScene:
    """Focal lengths that differ from photograph to photograph by a standard deviation of a share (autofocus)."""
    factors = 1.0 + share * np.random.default_rng([scene.seed, 55]).standard_normal(len(scene.cameras))

    def at(plain: StagedScene, k: int) -> StagedScene:
        fx, fy, *others = plain.lens.params
        return replace(plain, lens=replace(plain.lens, params=(factors[k] * fx, factors[k] * fy, *others)))

    return changing(scene, at)


def zones(scene: StagedScene, number: float) -> StagedScene:
    """Rolling shutters read in so many zones of rows: all rows of a zone at once, in its middle."""

    def at(plain: StagedScene, k: int) -> StagedScene:
        radiance_of, camera = _radiance_of(plain), plain.cameras[k]
        motion, rows = camera.motion, camera.height / number

        def seen(origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
            late = (origin - camera.centre) @ motion / (motion @ motion)
            read = (np.floor((late + camera.cy) / rows) + 0.5) * rows - camera.cy
            return radiance_of(origin + (read - late)[:, None] * motion, direction, seed)

        return replace(plain, radiance_of=seen)

    return changing(scene, at)


def reeds(scene: StagedScene, number: float) -> StagedScene:
    """Stalks along the shore that sway in the wind, and boughs with leaves over the bank."""
    rng, bed = np.random.default_rng([scene.seed, 56]), scene.renderer.ground.bed
    places = np.column_stack([rng.uniform(-4.0, 4.0, int(number)), rng.uniform(-0.5, 1.6, int(number))])
    feet = np.column_stack([places, bed.height(*places.T)])
    tall, lean = rng.uniform(0.8, 1.4, int(number)), rng.normal(0.0, 0.12, (int(number), 2))
    tile = np.exp(sum(0.15 * periodic(rng, size) for size in (2, 4, 8, 32))).astype(np.float32)
    boughs = rng.uniform((-4.0, 1.2, 1.5), (4.0, 3.0, 2.6), (12, 3))
    light, green = Light(), np.array([0.20, 0.30, 0.08], dtype=np.float32)
    matrix = np.array([[[TILE / 0.6, 0.0, 0.0, 0.0], [0.0, TILE / 0.6, 0.0, 0.0]]])
    texture = ImageTexture(tile[..., None] * green, matrix, np.zeros(1, dtype=np.int64), repeats=True)

    def at(plain: StagedScene, k: int) -> StagedScene:
        wind = np.random.default_rng([scene.seed, 57, k])
        sway = lean + 0.06 * wind.standard_normal(2) + 0.03 * wind.standard_normal(lean.shape)
        solids = [Solid.around(_stalk(foot, high, way)) for foot, high, way in zip(feet, tall, sway, strict=True)] + [
            _leaves(place + 0.04 * wind.standard_normal(3)) for place in boughs
        ]
        materials = [Material(texture, shade_of_normals(solid.normals, light)) for solid in solids]
        ground = Ground(bed, tuple(solids), (plain.renderer.ground.materials[0], *materials))
        return replace(plain, renderer=replace(plain.renderer, ground=ground))

    return changing(scene, at)


def bursts(scene: StagedScene, number: float) -> StagedScene:
    """So many photographs from each place, one after the other, over a sea of 2 cm."""
    return with_waves(replace(scene, cameras=tuple(np.repeat(scene.cameras, int(number)).tolist())), 0.02)


@dataclass(frozen=True)
class MedianScene(StagedScene):
    """A scene of which a photograph is the median, pixel by pixel, of those of a burst."""

    burst: StagedScene | None = None  # With as many photographs from each place, one place after the other

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 from one place."""
        assert self.burst is not None
        number = len(self.burst.cameras) // len(self.cameras)
        taken = [self.burst.photograph(number * index + k) for k in range(number)]
        return np.rint(np.median(taken, axis=0)).astype(np.uint8)


def medians(scene: StagedScene, number: float) -> StagedScene:
    """What is made of `bursts` where the water is to look still: one photograph for each place."""
    return MedianScene(**{each.name: getattr(scene, each.name) for each in fields(scene)}, burst=bursts(scene, number))


def _radiance_of(scene: StagedScene) -> RadianceFunction:
    return scene.radiance_of or scene.renderer.radiance_of_rays


def _turn(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])


def _stalk(foot: np.ndarray, high: float, way: np.ndarray) -> np.ndarray:
    """Points of a stalk 1 to 2 cm thick."""
    angle = 2.0 * math.pi * np.arange(4) / 4
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return np.concatenate([foot + 0.01 * ring, foot + (high * way[0], high * way[1], high) + 0.006 * ring])


def _leaves(place: np.ndarray) -> Solid:
    """A flat clump of leaves, 0.3 m across."""
    angle = 2.0 * math.pi * np.arange(7) / 7
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return Solid.around(np.concatenate([place + 0.15 * ring, place + 0.1 * ring + (0.0, 0.0, 0.08)]))


@dataclass(frozen=True)
class Condition:
    """One thing that photographs hold.

    Attributes
    ----------
    words : str
    value : float
        Of `change`.
    change : callable or None
        Of the staged scene and the value.
    scene : dict
        Changes of the drawn scene.
    poses : "given" or "images"
        Exact, or found from the photographs with positions good to 2 cm.
    cameras : dict
        Keys of [cameras] that differ from the scene; None leaves one out.
    """

    words: str
    value: float = 0.0
    change: Callable[[StagedScene, float], StagedScene] | None = None
    scene: tuple[tuple[str, object], ...] = ()
    poses: str = "given"
    cameras: tuple[tuple[str, object], ...] = ()

    def stage(self, seed: int) -> StagedScene:
        """The scene of a seed."""
        staged = stage_drawing(scene_of(seed, **dict(self.scene)))
        return staged if self.change is None else self.change(staged, self.value)


_ROLLS = (("speed_m_s", 5.0), ("readout_s", 0.03))
_PLACES = (("num_views", 8),)
_UNKNOWN_READOUT = (("rolling_shutter_s", 0.015), ("rolling_shutter_std_s", 0.015))
CONDITIONS = {
    "nothing": Condition("nothing"),
    "glitter": Condition("glitter on 10 % of all pixels", 0.1, glitter, (("to_sun", HIGH_SUN),)),
    "glitter30": Condition("glitter on 30 %", 0.3, glitter, (("to_sun", HIGH_SUN),)),
    "caustics": Condition("caustics of 30 % contrast", 0.3, caustics),
    "foam": Condition("foam and leaves on 10 % of the water, drifting", 0.1, foam),
    "people": Condition("six swimmers", 6.0, people),
    "shadow": Condition("shadow of the aircraft, 0.8 m", 0.8, shadow),
    "brown": Condition("brown water over a shore", 1.0, brown, (("shore", True), ("depth_m", 3.0))),
    "ripples": Condition("ripples of 5 to 30 cm, slopes of 0.05", 0.05, ripples),
    "ripples10": Condition("ripples of 5 to 30 cm, slopes of 0.1", 0.1, ripples),
    "blur": Condition("motion blur of 3 pixels", 3.0, motion_blur),
    "rolling": Condition("rolling shutter of 30 ms at 5 m/s, stated", scene=_ROLLS),
    "zones_ignored": Condition(
        "shutter read in four zones, 30 ms at 5 m/s, not stated",
        4.0,
        zones,
        _ROLLS,
        "images",
        (("rolling_shutter_s", None),),
    ),
    "zones": Condition("the same, readout found (15 ± 15 ms given)", 4.0, zones, _ROLLS, "images", _UNKNOWN_READOUT),
    "autofocus": Condition("focal lengths that differ by 0.2 %", 0.002, focal_drift, poses="images"),
    "bursts": Condition("bursts of 4 over 8 places, waves of 2 cm", 4.0, bursts, _PLACES),
    "medians": Condition("the medians of these bursts", 4.0, medians, _PLACES),
    "reeds": Condition("reeds and boughs over a bank", 40.0, reeds, (("shore", True),)),
    "found": Condition("nothing, poses found", poses="images"),
}
