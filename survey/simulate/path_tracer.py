"""Path tracing from the camera to sky and sun, through the water surface and between bed and water.

Path tracing (Kajiya 1986; Veach 1997) on shapes and materials of Mitsuba 3, with its own treatment of the sun: a
scattered path rarely hits a disc of half a degree, and when it does, a single pixel becomes far too bright; Mitsuba's
connections to lights end at a refracting surface. Each kind of path from the sun to the camera is counted once:

=========================================================  =============================================================
the light of the sun arrives                               and is counted
=========================================================  =============================================================
at ground, or at a point in the water that scatters it     there, by a direct connection to the sun, refracted at the
                                                           mean plane of the water if the point is in it
in the camera, directly                                    where the camera ray ends
at the water, which reflects it into the camera (maybe     at that reflection, weighted by Fresnel's reflectance; its
by way of further reflections and refractions)             direction is unique, and the path need not take it
in the water through its surface, and leaves it toward     by paths that happen to leave toward the sun: nearly all
the camera without meeting anything (wave crests)          that reach such a crossing do
at ground after a reflection by the water                  not at all
=========================================================  =============================================================

A path that ground or water has scattered therefore adds nothing when it ends in the disc of the sun. The direct
connection is exact for still water, level or tilted: flux through the surface, less Fresnel reflection, absorption
and scattering along the way. Two biases remain. Under waves there are no caustics: the sunlight in the water is that
under the mean plane. And light of the last row is missing. Skylight, and sunlight after its first scattering, is
refracted by every wave.
"""

import math
from types import ModuleType

import drjit as dr
import numpy as np

from survey.simulate.conditions import Light, WaterOptics

# Russian roulette starts after this many bounces.
_SURE_BOUNCES = 4
# Offset of rays from surfaces, relative to coordinates: some roundings of float32, as in Mitsuba.
_CLEAR = 1e-5


class Sunlight:
    """Direct light of the sun, and its disc as cameras see it; `solids` is the Mitsuba scene that casts shadows.

    `plane` is point (3,) [m], normal (3,) and index of the mean plane of the water, or None. A sun smaller than
    `pixel`, the angle of a pixel [rad], is seen as a disc with the area of a pixel and the same irradiance, because the
    few rays of a pixel would hit or miss a smaller one by chance.
    """

    def __init__(self, mi: ModuleType, solids, plane, *, colour: WaterOptics, light: Light, pixel: float):
        self.mi, self.solids, self.plane, self.colour, self.light = mi, solids, plane, colour, light
        self.seen_radius = max(light.sun_radius, pixel / math.sqrt(math.pi))
        self.seen_radiance = light.sun_irradiance / (math.pi * math.sin(self.seen_radius) ** 2)
        self.scattering, _ = colour.delta_eddington

    def seen(self, direction):
        """Whether unit directions, local, meet the disc as a camera sees it."""
        # By the chord: in float32 the cosine of less than 0.3 mrad is 1.
        chord2 = dr.squared_norm(direction - self.mi.Vector3f(*self.light.sun.tolist()))
        return chord2 < (2.0 * math.sin(0.5 * self.seen_radius)) ** 2

    def connection(self, sampler, place, normal, wet):
        """Direct connections of places to a random point of the sun: refracted direction, and irradiance across it.

        The irradiance is that of the whole disc if all of it stood there: its mean over points of the disc, drawn
        uniformly, is the light of the disc. `normal` is that of the ground, or zero for a place within the water.
        """
        mi, r = self.mi, self.light.sun_radius
        in_air = mi.Frame3f(mi.Vector3f(*self.light.sun.tolist())).to_world(self._of_disc(sampler.next_2d()))
        toward, foot = mi.Vector3f(in_air), mi.Point3f(place)
        power = mi.Color3f(self.light.sun_irradiance / math.cos(0.5 * r) ** 2)
        free = mi.Bool(True)
        # Off the ground, on the side of the sun, above the rounding of float32 at that distance from the origin.
        off = (1.0 + dr.max(dr.abs(place))) * _CLEAR
        start = place + dr.copysign(off, dr.dot(normal, in_air)) * normal
        if dr.hint(self.plane is not None, mode="scalar"):
            point, up, n = self.plane
            up = mi.Vector3f(*up.tolist())
            rise = dr.dot(in_air, up)
            along = (in_air - rise * up) / n
            cosine = dr.safe_sqrt(1.0 - dr.squared_norm(along))
            bent = along + cosine * up
            length = dr.maximum(dr.dot(mi.Point3f(*point.tolist()) - place, up), 0.0) / cosine
            start = dr.select(wet, place + dr.copysign(off, dr.dot(normal, bent)) * normal, start)
            # A point of the sun below a tilted surface does not shine into the water.
            free = ~wet | ((rise > 0.0) & ~self.solids.ray_test(mi.Ray3f(start, bent, length, 0.0, []), wet))
            passed = (1.0 - _fresnel(rise, cosine, n)) * rise / cosine
            lost = dr.exp(-length * self.scattering) * absorbed(mi, self.colour, length)
            power = dr.select(wet, power * passed * lost, power)
            foot = dr.select(wet, place + length * bent, start)
            toward = dr.select(wet, bent, in_air)
        else:
            foot = start
        free &= ~self.solids.ray_test(mi.Ray3f(foot, in_air))
        return toward, dr.select(free, power, 0.0)

    def _of_disc(self, drawn):
        """Directions uniform over a disc about z, by half angles, which float32 resolves even if tiny."""
        half = dr.sqrt(drawn.x) * math.sin(0.5 * self.light.sun_radius)
        sine, angle = 2.0 * half * dr.sqrt(1.0 - half * half), 2.0 * math.pi * drawn.y
        return self.mi.Vector3f(sine * dr.cos(angle), sine * dr.sin(angle), 1.0 - 2.0 * half * half)


def absorbed(mi: ModuleType, colour: WaterOptics, length):
    """Transmittance per channel of a path [m] through water; zero for an infinite one."""
    left = mi.Color3f(*(dr.exp(-a * length) for a in colour.absorption))
    return dr.select(dr.isfinite(length), left, mi.Color3f(0.0))


def _fresnel(cosine, inside, n: float):
    """Reflectance of the surface for unpolarised light, by the cosines in air and water."""
    across = (cosine - n * inside) / (cosine + n * inside)
    along = (n * cosine - inside) / (n * cosine + inside)
    return 0.5 * (across * across + along * along)


class PathTracer:
    """Radiance along rays; a `RadianceFunction`. Not a dataclass: Dr.Jit would treat its fields as loop variables.

    `surface` is the Mitsuba scene of the water's surface, or None; `sun` has what is solid, the mean plane and the
    colour of the water, and the light.
    """

    def __init__(self, surface, sun: Sunlight, *, max_bounces: int):
        self.mi, self.solids, self.surface, self.sun = sun.mi, sun.solids, surface, sun
        self.n_water = 1.0 if sun.plane is None else float(sun.plane[2])
        self.colour, self.light, self.max_bounces = sun.colour, sun.light, max_bounces
        self.scattering, self.asymmetry = sun.colour.delta_eddington

    def __call__(self, origin: np.ndarray, direction: np.ndarray, seed: int) -> np.ndarray:
        """Linear radiance (N, 3) along rays from origins in unit directions (N, 3), local."""
        mi = self.mi
        origin = np.broadcast_to(origin, direction.shape).astype(np.float32)
        direction = direction.astype(np.float32)
        sampler = mi.load_dict({"type": "independent"})

        sampler.seed(seed, len(direction))
        columns = (np.ascontiguousarray(part.T) for part in (origin, direction))
        ray = mi.Ray3f(mi.Point3f(next(columns)), mi.Vector3f(next(columns)))
        return np.array(self._follow(sampler, ray)).T.reshape(-1, 3)

    @dr.syntax
    def _follow(self, sampler, ray):
        """Radiance along rays.

        The state of a path: its throughput, whether it is in water, whether it was only reflected and refracted since
        the camera, and whether the sun was counted at its last reflection.
        """
        mi = self.mi
        light, throughput = mi.Color3f(0.0), mi.Color3f(1.0)
        wet, straight, counted, active = mi.Bool(False), mi.Bool(True), mi.Bool(False), mi.Bool(True)
        bounce = mi.UInt32(0)
        while active:
            ground, surface, t, at_surface = self._meet(ray, active)
            # Water absorbs along the way, and scatters after a random length.
            flight = mi.Float(dr.inf)
            if dr.hint(self.scattering > 0.0, mode="scalar"):
                flight = dr.select(wet, -dr.log(1.0 - sampler.next_1d(active)) / self.scattering, dr.inf)
            scattered = active & (flight < t)
            length = dr.minimum(t, flight)
            throughput = dr.select(wet, throughput * absorbed(mi, self.colour, length), throughput)
            gone = active & ~scattered & ~dr.isfinite(t)
            light += dr.select(gone & ~wet, throughput * self._above(ray.d, straight & ~counted), 0.0)
            active &= ~gone
            at_surface &= active & ~scattered
            at_ground = active & ~scattered & ~at_surface

            next_ray = mi.Ray3f(ray)
            if at_surface:
                light += dr.select(straight & ~wet, throughput * self._glint(surface, straight & ~wet), 0.0)
                next_ray, through, bent = self._cross(sampler, surface, ray)
                throughput *= through
                counted = ~wet & ~bent
                wet ^= bent
            if at_ground:
                next_ray, reflected, sun = self._leave_ground(sampler, ground, ray, wet)
                light += throughput * sun
                throughput *= reflected
                straight = mi.Bool(False)
            if scattered:
                next_ray, sun = self._scatter(sampler, ray, flight)
                light += throughput * sun
                straight = mi.Bool(False)
            ray = next_ray
            bounce += 1
            active &= bounce < self.max_bounces
            throughput, active = self._thinned(sampler, throughput, bounce, active)
        return light

    def _meet(self, ray, active):
        """Hits of rays with ground and water, the distance to the first of both, and whether it is the water."""
        ground = self.solids.ray_intersect(ray, active)
        t = dr.select(ground.is_valid(), ground.t, dr.inf)
        if self.surface is None:
            return ground, ground, t, self.mi.Bool(False)
        surface = self.surface.ray_intersect(ray, active)
        at_surface = active & surface.is_valid() & (surface.t < t)
        return ground, surface, dr.select(at_surface, surface.t, t), at_surface

    def _thinned(self, sampler, throughput, bounce, active):
        """Russian roulette: faint paths end and others are weighted up; the new throughputs, and which paths go on."""
        keep = dr.minimum(dr.max(throughput), 0.95)
        late = bounce > _SURE_BOUNCES
        goes_on = active & (~late | (sampler.next_1d(active) < keep))
        return dr.select(late, throughput / dr.maximum(keep, 1e-6), throughput), goes_on

    def _cross(self, sampler, surface, ray):
        """Reflected or refracted by the water: the next ray, its weight, and whether it was refracted."""
        mi = self.mi
        sample, through = surface.bsdf(ray).sample(mi.BSDFContext(), surface, sampler.next_1d(), sampler.next_2d())
        bent = mi.Frame3f.cos_theta(sample.wo) * mi.Frame3f.cos_theta(surface.wi) < 0.0
        return surface.spawn_ray(surface.to_world(sample.wo)), mi.Color3f(through), bent

    def _glint(self, surface, active):
        """Radiance of the sun that the water reflects into rays from above, where nothing hides the sun."""
        mi = self.mi
        toward = surface.to_world(mi.Vector3f(-surface.wi.x, -surface.wi.y, surface.wi.z))
        active &= self.sun.seen(toward)
        shadow_ray = surface.spawn_ray(toward)
        active &= ~self.solids.ray_test(shadow_ray, active) & ~self.surface.ray_test(shadow_ray, active)
        mirrored = mi.fresnel(mi.Frame3f.cos_theta(surface.wi), self.n_water)[0]
        return mi.Color3f(dr.select(active, mirrored * self.sun.seen_radiance, 0.0))

    def _leave_ground(self, sampler, ground, ray, wet):
        """Reflected by the ground: the next ray, its weight, and the sunlight that is reflected."""
        mi = self.mi
        bsdf, context = ground.bsdf(ray), mi.BSDFContext()
        toward, irradiance = self.sun.connection(sampler, ground.p, ground.n, wet)
        value = bsdf.eval(context, ground, ground.to_local(toward))
        sample, reflected = bsdf.sample(context, ground, sampler.next_1d(), sampler.next_2d())
        return ground.spawn_ray(ground.to_world(sample.wo)), mi.Color3f(reflected), mi.Color3f(value) * irradiance

    def _scatter(self, sampler, ray, flight):
        """Scattered in water: the next ray, and the sunlight that is scattered into the path."""
        mi, g = self.mi, self.asymmetry
        place = ray(flight)
        toward, irradiance = self.sun.connection(sampler, place, mi.Normal3f(0.0), mi.Bool(True))
        cosine = dr.dot(toward, ray.d)
        value = (1.0 - g * g) / (4.0 * math.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)
        # A direction by Henyey and Greenstein's law, from the inverse of its distribution.
        drawn = sampler.next_2d()
        turn = (1.0 - g * g) / (1.0 - g + 2.0 * g * drawn.x)
        cosine = dr.clip((1.0 + g * g - turn * turn) / (2.0 * g), -1.0, 1.0)
        sine, angle = dr.sqrt(1.0 - cosine * cosine), 2.0 * math.pi * drawn.y
        local = mi.Vector3f(sine * dr.cos(angle), sine * dr.sin(angle), cosine)
        return mi.Ray3f(place, mi.Frame3f(ray.d).to_world(local)), irradiance * value

    def _above(self, direction, sees_sun):
        """Radiance of the sky along directions, and of the sun where it is seen."""
        sky = dr.select(direction.z > 0.0, self.light.sky(direction.z), 0.0)
        return self.mi.Color3f(sky + dr.select(sees_sun & self.sun.seen(direction), self.sun.seen_radiance, 0.0))
