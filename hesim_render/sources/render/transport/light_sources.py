"""Light sources as diffuse surfaces see them: irradiance in closed form, and points drawn on them."""

from collections.abc import Callable
from math import pi
from typing import Protocol

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Interaction, MitsubaObject, Ray, Vector3
from hesim_render.sources.render.scene.direct_lights import DirectLight
from hesim_render.sources.render.transport.irradiance import BESIDE_BALL, RectangleLight, ball_above_horizon
from hesim_render.sources.render.transport.leaving import Leaving


class LightSource(Protocol):
    """A light of strength 1 on its own plane."""

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """See `RectangleLamp.seen_from`."""


class RectangleLamp:
    """A rectangle light; its strength is its radiance."""

    def __init__(self, leaving: Leaving, light: DirectLight) -> None:
        self.rectangle, self._leaving = RectangleLight(leaving.mi, light.place), leaving
        self.scale = dr.opaque(leaving.mi.Float, 1 / light.geometry)

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """e_k and r at surface points, and the shadow ray to the point drawn on the light.

        Parameters
        ----------
        point : Interaction3f, world space.
        normal : unit Vector3f, on the visible side.
        sampler : random numbers.
        """
        drawn, share = self.rectangle.sample(point.p, normal, sampler.surface_2d())
        shadow = self._leaving.to(point, drawn)
        return self.rectangle.irradiance(point.p, normal) * self.scale, share * self.scale, shadow


class BallLamp:
    """A ball that shines; its strength is its radiance."""

    def __init__(self, leaving: Leaving, light: DirectLight) -> None:
        mi, self._leaving = leaving.mi, leaving
        self._middle, self._square = mi.Point3f(light.place[:3]), mi.Float(float(light.place[3]) ** 2)
        dr.make_opaque(self._middle, self._square)

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """See `RectangleLamp.seen_from`. Directions are uniform in the cone around the ball."""
        mi, place = self._leaving.mi, sampler.surface_2d()
        to = self._middle - point.p
        distance = dr.norm(to)
        towards, square = to / distance, self._square / dr.square(distance)
        # from within, and from its own surface, nothing is seen of it
        is_seen = square < 1 / BESIDE_BALL
        square = dr.select(is_seen, square, 0.5)
        # 1 - cos of the cone's half angle and of the angle drawn
        width = square / (1 + dr.sqrt(1 - square))
        off = place.x * width
        sine_square = off * (2 - off)
        sine, phase = dr.sqrt(sine_square), 2 * pi * place.y
        local = mi.Vector3f(sine * dr.cos(phase), sine * dr.sin(phase), 1 - off)
        direction = mi.Frame3f(towards).to_world(local)
        # where the ray enters the ball
        t = distance * ((1 - off) - dr.sqrt(dr.maximum(square - sine_square, 0)))
        share = 2 * pi * width * dr.maximum(dr.dot(direction, normal), 0)
        level = dr.select(dr.dot(towards, normal) > -dr.sqrt(square), ball_above_horizon(towards, square, normal), 0.0)
        shadow = self._leaving.to(point, dr.fma(direction, t, point.p))
        return dr.select(is_seen, level, 0), dr.select(is_seen, share, 0), shadow


class PointLight:
    """A point light; its strength is its intensity."""

    def __init__(self, leaving: Leaving, light: DirectLight) -> None:
        mi, self._leaving = leaving.mi, leaving
        self._position, self._scale = mi.Point3f(light.place), dr.opaque(mi.Float, 1 / light.geometry)
        dr.make_opaque(self._position)

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """See `RectangleLamp.seen_from`."""
        to = self._position - point.p
        square = dr.squared_norm(to)
        level = dr.maximum(dr.dot(to, normal), 0.0) * dr.rsqrt(square) / square * self._scale
        return level, level, self._leaving.to(point, self._position)


class Beam:
    """Parallel light; its strength is the irradiance across the beam."""

    def __init__(self, leaving: Leaving, light: DirectLight) -> None:
        mi, self._leaving = leaving.mi, leaving
        self._towards, self._scale = mi.Vector3f(-light.place), dr.opaque(mi.Float, 1 / light.geometry)
        dr.make_opaque(self._towards)

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """See `RectangleLamp.seen_from`."""
        level = dr.maximum(dr.dot(self._towards, normal), 0.0) * self._scale
        return level, level, self._leaving.along(point, self._towards)


class Sky:
    """Uniform light from all directions; its strength is its radiance, and e_k is 1."""

    def __init__(self, leaving: Leaving, light: DirectLight) -> None:
        self._leaving = leaving

    def seen_from(self, point: Interaction, normal: Vector3, sampler: MitsubaObject) -> tuple[Float, Float, Ray]:
        """See `RectangleLamp.seen_from`. Directions have a cosine distribution, so r is 1 as well."""
        mi = self._leaving.mi
        local = mi.warp.square_to_cosine_hemisphere(sampler.surface_2d())
        return mi.Float(1.0), mi.Float(1.0), self._leaving.along(point, mi.Frame3f(normal).to_world(local))


_KINDS: dict[str, Callable[[Leaving, DirectLight], LightSource]]
_KINDS = {"rectangle": RectangleLamp, "ball": BallLamp, "point": PointLight, "beam": Beam, "sky": Sky}


def light_source(leaving: Leaving, light: DirectLight) -> LightSource:
    """The source of a light.

    Parameters
    ----------
    leaving : begins of shadow rays.
    light : its description.
    """
    return _KINDS[light.kind](leaving, light)
