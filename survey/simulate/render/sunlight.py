"""The sun for the path tracer: its light on a place, connected directly, and its disc as a camera sees it.

Symbols: ``r`` angular radius of the sun, ``E`` its irradiance on a surface that faces it, ``L`` the radiance of its
disc. The disc is uniform: ``E = pi sin(r)**2 L``, its solid angle is ``2 pi (1 - cos(r))``, and their product, the
irradiance on a surface that faces each point of the disc in turn, is ``E / cos(r / 2)**2``.
"""

from __future__ import annotations

import math
from types import ModuleType

import drjit as dr

from survey.simulate.light import Light
from survey.simulate.water import WaterColour

# Of the size of coordinates: some roundings of float32, as Mitsuba's own rays keep clear.
_CLEAR = 1e-5


class Sunlight:
    """Light of the sun at places, and its disc along directions.

    Parameters
    ----------
    mi : the Mitsuba module, with its variant set
    solids : Mitsuba scene
        What throws shadows.
    plane : (point, normal, index) or None
        Mean plane of the water: (3,) [m], (3,), [-].
    colour : WaterColour
    light : Light
    pixel : [rad]
        Angle of a pixel. A sun smaller than a pixel is seen as a disc with the area of a pixel and the same
        irradiance, because the few rays of a pixel would hit or miss a smaller one by chance.
    """

    def __init__(self, mi: ModuleType, solids, plane, *, colour: WaterColour, light: Light, pixel: float):
        self.mi, self.solids, self.plane, self.colour, self.light = mi, solids, plane, colour, light
        self.seen_radius = max(light.sun_radius, pixel / math.sqrt(math.pi))
        self.seen_radiance = light.sun_irradiance / (math.pi * math.sin(self.seen_radius) ** 2)
        self.scattering, _ = colour.similar

    def seen(self, direction):
        """Whether unit directions, local, meet the disc as a camera sees it."""
        # By the chord: in float32 the cosine of less than 0.3 mrad is 1.
        apart = dr.squared_norm(direction - self.mi.Vector3f(*self.light.sun.tolist()))
        return apart < (2.0 * math.sin(0.5 * self.seen_radius)) ** 2

    def on(self, sampler, place, normal, wet):
        """Direction from places toward a random point of the sun, bent by the water, and irradiance across it.

        The irradiance is that of the whole disc if all of it stood there: its mean over points of the disc, drawn
        uniformly, is the light of the disc. `normal` is that of the ground, or zero for a place within the water.
        """
        mi, r = self.mi, self.light.sun_radius
        in_air = mi.Frame3f(mi.Vector3f(*self.light.sun.tolist())).to_world(self._of_disc(sampler.next_2d()))
        toward, foot = mi.Vector3f(in_air), mi.Point3f(place)
        power = mi.Color3f(self.light.sun_irradiance / math.cos(0.5 * r) ** 2)
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
            # A point of the sun below a tilted surface does not shine into the water.
            free = not_(wet) | ((rise > 0.0) & not_(self.solids.ray_test(mi.Ray3f(start, bent, way, 0.0, []), wet)))
            passed = (1.0 - _fresnel(rise, climb, n)) * rise / climb
            lost = dr.exp(-way * self.scattering) * absorbed(mi, self.colour, way)
            power = dr.select(wet, power * passed * lost, power)
            foot = dr.select(wet, place + way * bent, start)
            toward = dr.select(wet, bent, in_air)
        else:
            foot = start
        free &= not_(self.solids.ray_test(mi.Ray3f(foot, in_air)))
        return toward, dr.select(free, power, 0.0)

    def _of_disc(self, drawn):
        """Directions uniform over a disc about z; by half angles, which float32 resolves however small they are."""
        half = dr.sqrt(drawn.x) * math.sin(0.5 * self.light.sun_radius)
        sine, angle = 2.0 * half * dr.sqrt(1.0 - half * half), 2.0 * math.pi * drawn.y
        return self.mi.Vector3f(sine * dr.cos(angle), sine * dr.sin(angle), 1.0 - 2.0 * half * half)


def absorbed(mi: ModuleType, colour: WaterColour, way):
    """Share of light, per channel, that is left after a way [m] through water; nothing after one without end."""
    left = mi.Color3f(*(dr.exp(-a * way) for a in colour.absorption))
    return dr.select(dr.isfinite(way), left, mi.Color3f(0.0))


def not_(mask):
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
