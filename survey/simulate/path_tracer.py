"""Light followed from the camera to the sky, through the surface of the water and between bed and water.

Path tracing (Kajiya 1986; Veach 1997) on shapes and materials of Mitsuba 3, with one thing of its own: the sun. A
path that is scattered by chance never meets a disc of half a degree behind a refracting surface, and Mitsuba's
connections to lights stop at it. Here the ray toward the sun is bent at the mean plane of the water, which is exact
for still water: what a place under water gets from the sun is the flux through the surface above it, less Fresnel's
reflection and the absorption on its way.

The bias that this leaves: under waves the sun has no caustics, its light is that under the mean plane; and light of
the sun that is mirrored by the water onto dry ground is left out. All light of the sky, and the sun's after its first
scattering, follows every wave.
"""

from __future__ import annotations

import math
from types import ModuleType

import drjit as dr
import numpy as np

from survey.simulate.light import Light
from survey.simulate.watercolour import WaterColour

# Bounces that no path is ended before by chance.
_SURE_BOUNCES = 4
# Of the size of coordinates: some roundings of float32, as Mitsuba's own rays keep clear.
_CLEAR = 1e-5


class PathTracer:
    """Radiance along rays; an `Eye`. No dataclass, of which Dr.Jit would take the fields for variables of its loops.

    Parameters
    ----------
    mi : the Mitsuba module, with its variant set
    solids, surface : Mitsuba scenes
        What is solid; the surface of the water, or None.
    plane : (point, normal, index) or None
        Mean plane of the water: (3,) [m], (3,), [-].
    colour : WaterColour
    light : Light
    max_bounces : int
    """

    def __init__(self, mi: ModuleType, solids, surface, plane, *, colour: WaterColour, light: Light, max_bounces: int):
        self.mi, self.solids, self.surface, self.plane = mi, solids, surface, plane
        self.colour, self.light, self.max_bounces = colour, light, max_bounces
        self.scattering, self.asymmetry = colour.similar
        # Between two scatterings [m]; longer than any way where there is none.
        self._mean_flight = 1.0 / max(self.scattering, 1e-9)

    def __call__(self, origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
        """Linear radiance (N, 3) along rays from origins in unit directions (N, 3), local."""
        mi = self.mi
        origin = np.broadcast_to(origin, direction.shape).astype(np.float32)
        direction = direction.astype(np.float32)
        sampler = mi.load_dict({"type": "independent"})
        if self.is_scalar:
            sampler.seed(seed)
            rays = (mi.Ray3f(o, d) for o, d in zip(origin.tolist(), direction.tolist(), strict=True))
            return np.array([np.array(self._follow(sampler, ray)).ravel() for ray in rays])
        sampler.seed(seed, len(direction))
        columns = (np.ascontiguousarray(part.T) for part in (origin, direction))
        ray = mi.Ray3f(mi.Point3f(next(columns)), mi.Vector3f(next(columns)))
        return np.array(self._follow(sampler, ray)).T.reshape(-1, 3)

    @property
    def is_scalar(self) -> bool:
        """Whether rays are followed one by one."""
        return self.mi.variant().startswith("scalar")

    @dr.syntax
    def _follow(self, sampler, ray):
        """Radiance along rays.

        The state of a path: the share of light that comes through it so far, whether it is in water, and whether it
        was only mirrored and bent since the camera, so that it can meet the sun itself.
        """
        mi = self.mi
        light, share = mi.Color3f(0.0), mi.Color3f(1.0)
        wet, straight, active = mi.Bool(False), mi.Bool(True), mi.Bool(True)
        bounce = mi.UInt32(0)
        while active:
            ground = self.solids.ray_intersect(ray, active)
            t = dr.select(ground.is_valid(), ground.t, dr.inf)
            at_surface = mi.Bool(False)
            surface = ground
            if dr.hint(self.surface is not None, mode="scalar"):
                surface = self.surface.ray_intersect(ray, active)
                at_surface = active & surface.is_valid() & (surface.t < t)
                t = dr.select(at_surface, surface.t, t)
            # On its way through water a path is absorbed, and scattered by chance.
            flight = dr.select(wet, -dr.log(1.0 - sampler.next_1d(active)) * self._mean_flight, dr.inf)
            scattered = active & (flight < t)
            way = dr.minimum(t, flight)
            share = dr.select(wet, share * self._absorbed(way), share)
            gone = active & _not(scattered) & _not(dr.isfinite(t))
            light += dr.select(gone & _not(wet), share * self._sky(ray.d, straight), 0.0)
            active &= _not(gone)
            at_surface &= active & _not(scattered)
            at_ground = active & _not(scattered) & _not(at_surface)

            ahead = mi.Ray3f(ray)
            if at_surface:
                ahead, through, wet = self._cross(sampler, surface, ray, wet)
                share *= through
            if at_ground:
                ahead, reflected, sun = self._leave_ground(sampler, ground, ray, wet)
                light += share * sun
                share *= reflected
                straight = mi.Bool(False)
            if scattered:
                ahead, sun = self._scatter(sampler, ray, flight)
                light += share * sun
                straight = mi.Bool(False)
            ray = ahead
            bounce += 1
            active &= bounce < self.max_bounces
            # Faint paths are ended by chance, the others take over their share.
            keep = dr.minimum(dr.max(share), 0.95)
            late = bounce > _SURE_BOUNCES
            active &= _not(late) | (sampler.next_1d(active) < keep)
            share = dr.select(late, share / dr.maximum(keep, 1e-6), share)
        return light

    def _cross(self, sampler, surface, ray, wet):
        """Mirrored or bent at the water: the ray ahead, the share that goes on, and whether it is in water now."""
        mi = self.mi
        sample, through = surface.bsdf(ray).sample(mi.BSDFContext(), surface, sampler.next_1d(), sampler.next_2d())
        bent = mi.Frame3f.cos_theta(sample.wo) * mi.Frame3f.cos_theta(surface.wi) < 0.0
        return surface.spawn_ray(surface.to_world(sample.wo)), mi.Color3f(through), wet ^ bent

    def _leave_ground(self, sampler, ground, ray, wet):
        """Reflected by the ground: the ray ahead, the share that goes on, and the sun's light that is reflected."""
        mi = self.mi
        bsdf, context = ground.bsdf(ray), mi.BSDFContext()
        toward, irradiance = self._sun(sampler, ground.p, ground.n, wet)
        value = bsdf.eval(context, ground, ground.to_local(toward))
        sample, reflected = bsdf.sample(context, ground, sampler.next_1d(), sampler.next_2d())
        return ground.spawn_ray(ground.to_world(sample.wo)), mi.Color3f(reflected), mi.Color3f(value) * irradiance

    def _scatter(self, sampler, ray, flight):
        """Scattered in water: the ray ahead, and the sun's light that is scattered into the path."""
        mi, g = self.mi, self.asymmetry
        place = ray(flight)
        toward, irradiance = self._sun(sampler, place, mi.Normal3f(0.0), mi.Bool(True))
        cosine = dr.dot(toward, ray.d)
        value = (1.0 - g * g) / (4.0 * math.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)
        # Henyey and Greenstein's law drawn from, by its inverse.
        drawn = sampler.next_2d()
        turn = (1.0 - g * g) / (1.0 - g + 2.0 * g * drawn.x)
        cosine = dr.clip((1.0 + g * g - turn * turn) / (2.0 * g), -1.0, 1.0)
        sine, angle = dr.sqrt(1.0 - cosine * cosine), 2.0 * math.pi * drawn.y
        local = mi.Vector3f(sine * dr.cos(angle), sine * dr.sin(angle), cosine)
        return mi.Ray3f(place, mi.Frame3f(ray.d).to_world(local)), irradiance * value

    def _sun(self, sampler, place, normal, wet):
        """Direction toward the sun, bent by the water, and its irradiance across that direction at places."""
        mi = self.mi
        local = mi.warp.square_to_uniform_cone(sampler.next_2d(), math.cos(self.light.sun_radius))
        in_air = mi.Frame3f(mi.Vector3f(*self.light.sun.tolist())).to_world(local)
        toward, foot, power = mi.Vector3f(in_air), mi.Point3f(place), mi.Color3f(self.light.sun_irradiance)
        free = mi.Bool(True)
        # Off the ground, on the side of the sun.
        off = _clearance(place)
        start = place + dr.copysign(off, dr.dot(normal, in_air)) * normal
        if dr.hint(self.plane is not None, mode="scalar"):
            point, up, n = self.plane
            up = mi.Vector3f(*up.tolist())
            rise = dr.dot(in_air, up)
            along = (in_air - rise * up) / n
            climb = dr.safe_sqrt(1.0 - dr.squared_norm(along))
            bent = along + climb * up
            way = dr.maximum(dr.dot(mi.Point3f(*point.tolist()) - place, up), 0.0) / climb
            start = dr.select(wet, place + dr.copysign(off, dr.dot(normal, bent)) * normal, start)
            free = _not(wet) | _not(self.solids.ray_test(mi.Ray3f(start, bent, way, 0.0, []), wet))
            passed = (1.0 - _fresnel(rise, climb, n)) * rise / climb
            lost = dr.exp(-way * self.scattering) * self._absorbed(way)
            power = dr.select(wet, power * passed * lost, power)
            foot = dr.select(wet, place + way * bent, start)
            toward = dr.select(wet, bent, in_air)
        else:
            foot = start
        free &= _not(self.solids.ray_test(mi.Ray3f(foot, in_air)))
        return toward, dr.select(free, power, 0.0)

    def _sky(self, direction, straight):
        """Radiance from above along directions; the sun itself only for paths that came straight."""
        mi = self.mi
        sky = dr.select(direction.z > 0.0, self.light.sky(direction.z), 0.0)
        at_sun = dr.dot(direction, mi.Vector3f(*self.light.sun.tolist())) > math.cos(self.light.sun_radius)
        disc = self.light.sun_irradiance / self.light.sun_solid_angle
        return mi.Color3f(sky + dr.select(straight & at_sun, disc, 0.0))

    def _absorbed(self, way):
        """What is left after a way [m] through water; nothing after one without end."""
        mi = self.mi
        left = mi.Color3f(*(dr.exp(-a * way) for a in self.colour.absorption))
        return dr.select(dr.isfinite(way), left, mi.Color3f(0.0))


def _not(mask):
    """The other way round; ``~`` would make a number of the plain bool that the scalar variant has."""
    return mask ^ True


def _clearance(place):
    """How far off a surface a ray starts [m]: above the rounding of float32 at that distance from the origin."""
    return (1.0 + dr.max(dr.abs(place))) * _CLEAR


def _fresnel(cosine, inside, n: float):
    """Share of unpolarised light that the surface mirrors, by the cosines in air and water."""
    across = (cosine - n * inside) / (cosine + n * inside)
    along = (n * cosine - inside) / (n * cosine + inside)
    return 0.5 * (across * across + along * along)
