"""The path tracer: its geometry is that of `refract`, its light that of closed forms and of Mitsuba's own tracer."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from slow_cases import slow

from fields.device import choose_device
from refract import FlatWater, PinholeCamera
from refract.curved import BicubicWater, WavyWater
from refract.lens import Lens
from survey.errors import ConfigError, SurveyError
from survey.simulate.conditions import Light, Sensor, WaterOptics
from survey.simulate.direct import DirectRenderer
from survey.simulate.ground import Ground, Material, shade_of_normals, texture_of_bed
from survey.simulate.scene_file import TextureSettings
from survey.simulate.shapes import BedGrid, rotation

pytest.importorskip("mitsuba", reason="the physical mode needs the extra [simulate]: pip install 'bathynerf[simulate]'")

from survey.simulate.mitsuba_scene import load_mitsuba, solid_scene, water_scene
from survey.simulate.path_tracer import PathTracer, Sunlight

# What the two modes may differ by on the image [px].
SAME_PX = 0.02
# Float32 over 60 m of water, and the 1e-4 m by which Mitsuba's rays keep clear of a surface: 0.01 px; under waves their
# chords besides.
SAME_M = {"plane": 3e-4, "waves": 5e-4, "measured": 3e-4}
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333, slope_x=0.01, slope_y=-0.02)
DEPTH = 2.0
CLEAR = WaterOptics(absorption=(0.0, 0.0, 0.0), scattering=0.0)
NO_SUN = Light(sun_share=0.0)
# A sun that a path tracer hits by chance: 20 degrees across.
WIDE_SUN = Light(sun_share=0.5, sun_radius=math.radians(10.0))
# Of all cameras here [rad].
PIXEL = 1.0 / 300.0
# From a point to 69 degrees; in nature it is 0.0046 rad.
SUN_RADII = (0.0, 1e-5, 1e-4, 3e-4, 1e-3, 0.0046, 0.05, 0.5, 1.2)
# A mean lies further from its expectation, by this many of its standard errors, once in a million times.
SURE = 5.0
# Some hundred roundings of float32.
ROUNDING = 1e-5


@pytest.fixture(scope="module")
def mi():
    if choose_device("cpu").name == "torch":
        pytest.skip("the physical mode needs LLVM")
    return load_mitsuba("cpu")


def camera_at(x: float, y: float, z: float, tilt: float) -> PinholeCamera:
    axes = np.diag([1.0, -1.0, -1.0]) @ rotation(0.3, 0.0, tilt).T
    return PinholeCamera((x, y, z), axes, 300.0, 300.0, 40.0, 30.0, 80, 60)


LENS = Lens("PINHOLE", (300.0, 300.0, 40.0, 30.0), 80, 60)
CAMERAS = [camera_at(0.3, -0.2, 9.0, 0.05), camera_at(1.0, 4.5, 8.0, -0.5)]


def checkered(albedo: float | None = None, reach: float = 60.0) -> Ground:
    """A level bed with a corner of its checker under the origin, or of one albedo; wide, so that no light is lost."""
    bed = BedGrid(np.full((13, 13), -DEPTH), -reach, -reach, reach / 6.0)
    texture = texture_of_bed(
        TextureSettings(kind="checker", square_m=3.0), None, bed, None, (-reach, -reach, reach, reach), 1
    )
    if albedo is not None:
        texture.image[:] = albedo
    return Ground(bed, (), (Material(texture, shade_of_normals(np.array([[0.0, 0.0, 1.0]]), NO_SUN)),))


def tracer(
    mi, ground: Ground, water: FlatWater | None, *, colour=CLEAR, light=NO_SUN, bounces=12, kind=PathTracer
) -> PathTracer:
    surface = None if water is None else water_scene(mi, water, ground)
    plane = None if water is None else (np.array(water.point), np.array(water.up), water.n_water)
    sun = Sunlight(mi, solid_scene(mi, ground), plane, colour=colour, light=light, pixel=PIXEL)
    return kind(surface, sun, max_bounces=bounces)


def rays_down(count: int, slant: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    direction = np.array([math.sin(slant), 0.0, -math.cos(slant)])
    return np.tile([0.5, 0.5, 3.0], (count, 1)), np.tile(direction, (count, 1))


def assert_mean(seen: np.ndarray, expected, others: np.ndarray | None = None, rounding: float = ROUNDING) -> None:
    """Means of samples (N, 3) are `expected`, or those of other samples (M, 3), as far as their own spread can tell."""
    parts = [seen] if others is None else [seen, others]
    error = np.sqrt(sum(part.var(axis=0) / len(part) for part in parts))
    expected = expected if others is None else others.mean(axis=0)
    assert (np.abs(seen.mean(axis=0) - expected) < SURE * error + rounding * np.abs(expected)).all()


def mirrored(cosine: float, n: float) -> float:
    """Fresnel's share of unpolarised light that water of index n mirrors, by the cosine of incidence in air."""
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / n**2)
    across = ((cosine - n * inside) / (cosine + n * inside)) ** 2
    along = ((n * cosine - inside) / (n * cosine + inside)) ** 2
    return 0.5 * (across + along)


@pytest.mark.parametrize("kind", ["plane", "waves", "measured"])
def test_rays_of_the_path_tracer_end_where_those_of_the_direct_mode_do(mi, rng, kind):
    ground, water = checkered(reach=12.0), WATER
    if kind == "waves":
        water = WavyWater((0.0, 0.0, 0.0), [0.03, 0.02], [(3.0, 1.0), (-1.0, 4.0)], slope_x=0.01)
    if kind == "measured":
        nodes = np.stack(np.meshgrid(*[np.linspace(-40.0, 40.0, 81)] * 2), axis=-1).reshape(-1, 2)
        water = BicubicWater.from_points(nodes, 0.02 * np.sin(nodes @ (1.0, 0.4)))
    solids, surface = solid_scene(mi, ground), water_scene(mi, water, ground)
    renderer = DirectRenderer(ground, water, CLEAR)
    for camera in CAMERAS:
        pixels = rng.uniform((0.0, 0.0), (80.0, 60.0), (500, 2))
        direction = camera.directions(pixels)
        ray = mi.Ray3f(
            mi.Point3f(*camera.centre.tolist()), mi.Vector3f(np.ascontiguousarray(direction.T, dtype=np.float32))
        )
        meeting = surface.ray_intersect(ray)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, len(pixels))
        sample, _ = meeting.bsdf(ray).sample(mi.BSDFContext(), meeting, mi.Float(0.999), sampler.next_2d())
        ends = np.array(solids.ray_intersect(meeting.spawn_ray(meeting.to_world(sample.wo))).p).T
        apart = np.linalg.norm(ends - renderer.trace(camera, pixels).points, axis=1)
        assert apart.max() < SAME_M[kind]
        assert SAME_M[kind] / 8.0 * camera.fx < SAME_PX


def test_a_white_bed_under_clear_water_and_a_sky_alike_everywhere_is_as_bright_as_the_sky(mi):
    # Nothing is absorbed anywhere: light is the same in all directions, whatever the surface does (Kirchhoff).
    eye = tracer(mi, checkered(albedo=1.0), WATER, bounces=400)
    seen = eye(*rays_down(20_000, 0.4), 1)
    assert_mean(seen, 1.0)


def test_light_of_the_sky_is_that_of_mitsubas_volumetric_path_tracer(mi):
    colour = WaterOptics(absorption=(0.2, 0.05, 0.02), scattering=0.25, asymmetry=0.5)
    ground = checkered(albedo=0.5)
    ours = tracer(mi, ground, WATER, colour=colour)(*rays_down(60_000, 0.3), 2)
    theirs = of_volpath(mi, ground, colour, rays_down(60_000, 0.3))
    assert_mean(ours, None, theirs)


def of_volpath(mi, ground: Ground, colour: WaterOptics, rays) -> np.ndarray:
    """Radiance (N, 3) by Mitsuba's integrator, in a box of the same water with the same bed as its floor."""
    scattering, asymmetry = colour.delta_eddington
    extinction = [a + scattering for a in colour.absorption]
    medium = {
        "type": "homogeneous",
        "sigma_t": {"type": "rgb", "value": extinction},
        "albedo": {"type": "rgb", "value": [scattering / e for e in extinction]},
        "phase": {"type": "hg", "g": asymmetry},
    }
    normal = np.array(WATER.up)
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=normal.tolist(), up=[0.0, 1.0, 0.0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
            "water": {
                "type": "rectangle",
                "to_world": to_world @ mi.ScalarTransform4f().scale(60.0),
                "bsdf": {"type": "dielectric", "int_ior": WATER.n_water, "ext_ior": 1.0},
                "interior": medium,
            },
            "bed": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0.0, 0.0, -DEPTH]).scale(60.0),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
                "exterior": medium,
            },
        }
    )
    origin, direction = (np.ascontiguousarray(part.T, dtype=np.float32) for part in rays)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, origin.shape[1])
    integrator = mi.load_dict({"type": "volpath", "max_depth": 13})
    colours, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(mi.Point3f(origin), mi.Vector3f(direction)))
    return np.array(colours).T


@pytest.mark.parametrize("n_water", [1.0, 1.333])
def test_the_sun_through_still_water_is_what_fresnel_and_beer_leave_of_it(mi, n_water):
    # One reflection at the bed; the light of the sky, which the same seed follows the same way, is taken off.
    water = FlatWater((0.0, 0.0, 0.0), n_water=n_water)
    colour = WaterOptics(absorption=(0.3, 0.1, 0.0), scattering=0.0)
    light = Light(to_sun=(1.0, 0.0, 1.0), sun_share=0.6, sun_radius=1e-3)
    albedo = 0.4
    eye = tracer(mi, checkered(albedo=albedo), water, colour=colour, light=light, bounces=3)
    dark = tracer(mi, checkered(albedo=albedo), water, colour=colour, light=Light(sun_share=0.0), bounces=3)
    seen = eye(*rays_down(40_000), 3) - 0.4 * dark(*rays_down(40_000), 3)
    inside = math.sqrt(1.0 - 0.5 / n_water**2)
    down = (1.0 - mirrored(math.sqrt(0.5), n_water)) * np.exp(-np.array(colour.absorption) * DEPTH / inside)
    up = (1.0 - mirrored(1.0, n_water)) / n_water**2 * np.exp(-np.array(colour.absorption) * DEPTH)
    # Absorption down and up, over ways as long as the tracer takes them.
    assert_mean(seen, 0.6 * albedo * down * up, rounding=2.0 * max(colour.absorption) * SAME_M["plane"])


def let_in(radius: float, n: float) -> float:
    """Of a disc of radiance 1 / pi around the zenith, what level water lets in [per area]."""

    def ring(angle: float) -> float:
        return 2.0 * math.sin(angle) * math.cos(angle) * (1.0 - mirrored(math.cos(angle), n))

    return quad(ring, 0.0, radius)[0]


@pytest.mark.parametrize("radius", [r for r in SUN_RADII if r < Light().elevation])
def test_dry_ground_has_sun_and_sky_as_the_light_says(mi, radius):
    eye = tracer(mi, checkered(albedo=0.3), None, light=Light(sun_share=0.5, sun_radius=radius))
    assert_mean(eye(*rays_down(20_000), 3), 0.3)


def test_a_sun_that_reaches_below_the_horizon_is_refused():
    with pytest.raises(ConfigError, match="twice the elevation"):
        Light(to_sun=(1.0, 0.0, 0.1), sun_radius=0.11)


def bed_under_water(light: Light, albedo: float, slant: float, n: float) -> float:
    """Radiance of a matt bed under level clear water and a sun at noon, along a ray from above.

    Light goes to and fro between bed and surface, a geometric series; the sky is alike everywhere.
    """
    share, radius = light.sun_share, light.sun_radius
    from_sky = let_in(math.pi / 2.0, n)
    from_sun = let_in(radius, n) / math.sin(radius) ** 2 if radius > 0.0 else 1.0 - mirrored(1.0, n)
    # What a matt bed throws up is mirrored down by the surface but for the share that leaves into all of the sky.
    down = share * from_sun + (1.0 - share) * from_sky
    bed = albedo * down / (1.0 - albedo * (1.0 - from_sky / n**2))
    above = (1.0 - share) + (share / math.sin(radius) ** 2 if slant < radius else 0.0)
    reflected = mirrored(math.cos(slant), n)
    return (1.0 - reflected) * bed / n**2 + reflected * above


@pytest.mark.parametrize("radius", SUN_RADII)
def test_a_bed_under_still_water_has_the_light_of_the_closed_form_for_any_sun(mi, radius):
    light = Light(to_sun=(0.0, 0.0, 1.0), sun_share=0.5, sun_radius=radius)
    level = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    eye = tracer(mi, checkered(albedo=0.5, reach=600.0), level, light=light, bounces=400)
    assert_mean(eye(*rays_down(40_000, 0.4), 3), bed_under_water(light, 0.5, 0.4, level.n_water))


@pytest.mark.parametrize("radius", SUN_RADII)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_pixel_is_brighter_than_the_water_can_mirror_of_the_sun(mi, radius, seed):
    light = Light(to_sun=(0.0, 0.0, 1.0), sun_share=0.9, sun_radius=radius)
    camera, level = CAMERAS[0], FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    eye = tracer(mi, checkered(albedo=0.5), level, light=light, bounces=6)
    image = Sensor(samples=16, is_jittered=True).light(eye, camera, LENS, (seed, 1)).max(axis=-1)
    rows, columns = np.indices(image.shape) + 0.5
    cosine = -camera.directions(np.stack([columns, rows], axis=-1).reshape(-1, 2))[:, 2].reshape(image.shape)
    # At most a pixel is all in the disc, which has at least its area; all other light is that on white ground.
    widest = max(radius, PIXEL / math.sqrt(math.pi))
    glint = light.sun_irradiance / (math.pi * math.sin(widest) ** 2) * mirrored(cosine.min() - PIXEL, 1.333)
    assert image.max() <= glint + 1.0
    away = np.arccos(cosine) > widest + PIXEL
    assert (image[away] <= 1.0).all()
    if radius < 0.05:
        assert image.max() > 1.0


@pytest.mark.parametrize("radius", [r for r in SUN_RADII if r < 0.02])
def test_the_glint_of_the_sun_on_still_water_has_the_light_that_fresnel_mirrors(mi, rng, radius):
    light = Light(to_sun=(0.0, 0.0, 1.0), sun_share=1.0, sun_radius=radius)
    level = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    eye = tracer(mi, checkered(albedo=0.0), level, light=light, bounces=3)
    # Rays spread evenly over a cone around the nadir, of which the area on the unit sphere is taken.
    spread, count = 0.02, 400_000
    fall = 1.0 - rng.random(count) * (1.0 - math.cos(spread))
    side, turn = np.sqrt(1.0 - fall**2), rng.uniform(0.0, 2.0 * math.pi, count)
    direction = np.stack([side * np.cos(turn), side * np.sin(turn), -fall], axis=-1)
    seen = eye(np.tile([0.5, 0.5, 3.0], (count, 1)), direction, 1)
    assert_mean(seen * 2.0 * math.pi * (1.0 - math.cos(spread)), mirrored(1.0, 1.333) * light.sun_irradiance)


class ByChance(PathTracer):
    """Takes the sun for a part of the sky, which every path may meet: right, and for a wide sun not too noisy."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.sun.connection = lambda sampler, place, normal, wet: (
            self.mi.Vector3f(0.0, 0.0, 1.0),
            self.mi.Color3f(0.0),
        )

    def _glint(self, surface, active):
        return self.mi.Color3f(0.0)

    def _above(self, direction, sees_sun):
        return super()._above(direction, self.mi.Bool(True))


@pytest.mark.parametrize(("slant", "water"), [(0.0, WATER), (0.5, None), slow(0.5, WATER), slow(0.0, None)])
def test_light_of_a_wide_sun_that_is_met_by_chance_is_that_of_direct_connections(mi, water, slant):
    # 46 degrees across, mirrored into the second of the rays.
    light = Light(to_sun=(0.5, 0.1, 0.8), sun_share=0.7, sun_radius=0.4)
    colour = WaterOptics(absorption=(0.2, 0.05, 0.0), scattering=0.5, asymmetry=0.5)
    rays = rays_down(200_000, slant)
    direct, by_chance = (
        tracer(mi, checkered(albedo=0.6), water, colour=colour, light=light, bounces=200, kind=kind)(*rays, seed)
        for kind, seed in ((PathTracer, 7), (ByChance, 8))
    )
    assert_mean(direct, None, by_chance)


def test_the_same_seed_gives_the_same_light_and_another_seed_another(mi):
    eye = tracer(mi, checkered(), WATER, colour=WaterOptics(), light=WIDE_SUN)
    first, again, other = (eye(*rays_down(500), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.0


def test_without_cuda_and_llvm_the_fast_mode_is_named():
    with pytest.raises(SurveyError, match="needs CUDA or libLLVM; install one, or give --mode direct"):
        load_mitsuba("torch")
