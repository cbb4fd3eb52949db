"""Primary rays: one ray per sample of each mosaic pixel, and the place at which a point is seen.

Camera space and positions on the chip are those of `camera`.
"""

from typing import Any

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, MitsubaObject, Point2, Point3, Vector3
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import MM_PER_M
from hesim_render.sources.render.blur import AiryBlur, GaussianBlur, KernelBlur
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.projection import DeviceProjection
from hesim_render.sources.render.scene.builder import NeedsExactMode
from hesim_render.specs.lens import MeasuredPsf
from hesim_render.spectral.spectrum import RENDERABLE_NM

#: Part of the PSF in which `RayFactory.density` is not zero, standard deviations: all but 2e-7 of the rays.
_MOST_SIGMAS = 5.2


class RayFactory:
    """Primary rays of mosaic pixels on the device: box aperture, PSF, and a pinhole or the pupil of a thin lens.

    Rows and columns are those of the full sensor, so a crop's rays equal those of the full sensor to the bit.

    Attributes
    ----------
    has_psf : True if there is a PSF that is the same at all wavelengths.
    is_dispersive : True if a ray's path depends on its wavelength: it then carries a single one.
    has_pupil : True if rays start on the pupil of a thin lens, not at its centre.
    """

    def __init__(self, view: View) -> None:
        types = jit()
        sensor, optics, lens = view.sensor, view.sensor.optics, view.sensor.lens
        self._projection, self._optics = DeviceProjection(view.projection), optics
        self._blur: GaussianBlur | KernelBlur | None = None
        if isinstance(optics.psf, MeasuredPsf):
            self._blur = KernelBlur(sensor)
        elif optics.psf is not None or optics.psf_fwhm_um > 0:
            self._blur = GaussianBlur(sensor)
        self.has_psf = self._blur is not None
        self._airy = AiryBlur(sensor) if optics.diffraction else None
        self._shrink = None
        if optics.lateral_chromatic is not None:
            chromatic, grid = optics.lateral_chromatic, np.arange(RENDERABLE_NM[0], RENDERABLE_NM[1] + 1)
            larger = np.interp(grid, chromatic.wavelength_nm, chromatic.magnification_rel)
            self._shrink = from_host(types.Float, (1 / (1 + larger)).astype(np.float32))
            dr.make_opaque(self._shrink)
        self.is_dispersive = self._airy is not None or self._shrink is not None
        self.has_pupil = optics.depth_of_field
        self._cosine_law = optics.relative_illumination == "cos4"
        if self.has_pupil:
            image_m = lens.image_distance_mm / MM_PER_M
            tangent2 = (lens.pupil_radius_m / image_m) ** 2
            self._image_m = dr.opaque(types.Float, image_m)
            self._sine2 = dr.opaque(types.Float, tangent2 / (1 + tangent2))
            self._per_focus = dr.opaque(types.Float, 1 / lens.focus_distance_m)
        self._rotation = [[dr.opaque(types.Float, float(v)) for v in row] for row in view.camera_to_world[:3, :3]]
        self._origin = [dr.opaque(types.Float, float(v)) for v in view.camera_to_world[:3, 3]]
        self._near = dr.opaque(types.Float, view.near_m) if view.near_m > 0 else None

    def require_one_path(self) -> None:
        """Refuse lenses whose rays of different wavelengths differ, or whose pixels see the whole picture.

        Raises
        ------
        NeedsExactMode
            Names the keys.
        """
        if self.is_dispersive:
            raise NeedsExactMode("the lens images each wavelength elsewhere (lens.diffraction, lens.lateral_chromatic)")
        if self._optics.veiling_glare > 0:
            raise NeedsExactMode("light of the whole picture reaches each pixel (lens.veiling_glare)")

    @property
    def can_aim(self) -> bool:
        """True if `density` is known, and a place in the picture decides which points a ray may meet."""
        return not (isinstance(self._blur, KernelBlur) or self.is_dispersive or self.has_pupil)

    @property
    def is_box(self) -> bool:
        """True if rays of a pixel start uniformly in its square, and their place decides which points they may meet."""
        return self._blur is None and self.can_aim

    @property
    def spreads(self) -> bool:
        """True if few rays of a pixel may meet what changes it: out of focus, or in the skirts of a measured PSF."""
        return self.has_pupil or isinstance(self._blur, KernelBlur)

    @property
    def blur_px(self) -> float:
        """Radius of the PSF that holds nearly all of it, px."""
        return 0.0 if self._blur is None else self._blur.reach_px

    def blur_numbers(self, sampler: MitsubaObject) -> Any:
        """Random numbers of the PSF for `offset`; None where there is none."""
        return None if self._blur is None else self._blur.numbers(sampler)

    def rays(self, row: Float, col: Float, aperture: Point2, blur: Point2 | None) -> tuple[Point3, Vector3]:
        """Origin and unit direction of one ray per lane in world space, with the camera at rest.

        Parameters
        ----------
        row, col : Dr.Jit Float, position on the full sensor.
        aperture : pair of Float in [0, 1), place inside the pixel.
        blur : numbers in [0, 1) for the PSF, as of `blur_numbers`, or None.
        """
        return self.towards(row, col, *self.offset(aperture, blur, (col, row)))

    def offset(self, aperture: Point2, blur: Any, place: tuple[Float, Float] | None = None) -> tuple[Float, Float]:
        """Place of a ray relative to the centre of its pixel, pixels; see `rays`. `place` is column and row of the
        pixel on the full sensor, which a PSF that depends on the place needs.
        """
        x, y = aperture[0] - 0.5, aperture[1] - 0.5
        if blur is not None and self._blur is not None:
            more_x, more_y = self._blur.offset(blur, place)
            x, y = x + more_x, y + more_y
        return x, y

    def diffracted(self, sampler: MitsubaObject, x: Float, y: Float, wavelength_nm: Float) -> tuple[Float, Float]:
        """Places after diffraction, from those that `offset` gives, pixels."""
        if self._airy is None:
            return x, y
        more_x, more_y = self._airy.offset(sampler.next_2d(), wavelength_nm)
        return x + more_x, y + more_y

    def through_lens(
        self,
        place: tuple[Float, Float],
        offset: tuple[Float, Float],
        sampler: MitsubaObject,
        wavelength_nm: Float | None = None,
        weight: Float | None = None,
    ) -> tuple[Point3, Vector3, Float | None]:
        """Rays through the lens as it is, with its pupil and its lateral chromatic aberration.

        Points of the pupil are drawn so that each stands for as much light on the axis: uniformly in sin² of the angle
        at which a pixel there sees them. In focus and on the axis, the light of all of them together is the G of
        `Lens.solid_angle_sr`. Off the axis, the law cos⁴ of a ray's own angle replaces that of the chief ray.

        Parameters
        ----------
        place : column and row of pixels on the full sensor.
        offset : places beside the pixels' centres, px.
        sampler : gives the point on the pupil, where there is one.
        wavelength_nm : of each ray, if `is_dispersive`.
        weight : of each ray so far; None for 1.

        Returns
        -------
        Origin and unit direction in world space, with the camera at rest; and the weight of each ray, None for 1.
        """
        col, row = place
        if not self.has_pupil and self._shrink is None:
            return *self.towards(row, col, *offset), weight
        types = jit()
        shrink = None
        if self._shrink is not None and wavelength_nm is not None:
            at = dr.clip(wavelength_nm - RENDERABLE_NM[0], 0, RENDERABLE_NM[1] - RENDERABLE_NM[0])
            cell = dr.minimum(types.UInt32(at), int(RENDERABLE_NM[1] - RENDERABLE_NM[0]) - 1)
            low, high = (dr.gather(types.Float, self._shrink, cell + k) for k in (0, 1))
            shrink = dr.fma(at - types.Float(cell), high - low, low)
        x, y = self._projection.tangents(row, col, *offset, shrink)
        if not self.has_pupil:
            return *self._from_pupil(x, y, None), weight
        u, v = sampler.next_2d()
        sine2 = u * self._sine2
        radius = self._image_m * dr.sqrt(sine2 / (1 - sine2))
        sine, cosine = dr.sincos(2 * dr.pi * v)
        pupil = radius * cosine, radius * sine
        origin, direction = self._from_pupil(
            x - pupil[0] * self._per_focus, y - pupil[1] * self._per_focus, (pupil[0], -pupil[1])
        )
        if not self._cosine_law:
            return origin, direction, weight
        # the picture is upside down: a pixel's own place is opposite to the place that it shows
        image = self._projection.image_place(row, col, dr.zeros(types.Float), dr.zeros(types.Float))
        across = [side + point / self._image_m for side, point in zip(image, pupil, strict=True)]
        chief = 1 + dr.square(image[0]) + dr.square(image[1])
        own = 1 + dr.square(across[0]) + dr.square(across[1])
        share = dr.square(chief / (own * (1 - sine2)))
        return origin, direction, share if weight is None else weight * share

    def towards(self, row: Float, col: Float, offset_x: Float, offset_y: Float) -> tuple[Point3, Vector3]:
        """As `rays`, from the places that `offset` gives."""
        return self._from_pupil(*self._projection.tangents(row, col, offset_x, offset_y), None)

    def _from_pupil(self, x: Float, y: Float, point: tuple[Float, Float] | None) -> tuple[Point3, Vector3]:
        """Rays in world space with tangents to the right and downwards, from a point of the pupil in camera space, m;
        None for its centre.
        """
        types = jit()
        local = dr.normalize(types.Array3f(x, -y, -1.0))
        direction = types.Array3f(*(r[0] * local.x + r[1] * local.y + r[2] * local.z for r in self._rotation))
        origin = types.Array3f(*self._origin)
        if point is not None:
            origin = origin + types.Array3f(*(r[0] * point[0] + r[1] * point[1] for r in self._rotation))
        if self._near is not None:  # the ray starts at that depth
            origin = dr.fma(direction, self._near / -local.z, origin)
        return origin, direction

    @property
    def reach_px(self) -> Float:
        """Half the width of the square around the centre of a pixel in which nearly all of its rays lie, pixels."""
        if not isinstance(self._blur, GaussianBlur):
            return jit().Float(0.5)
        return 0.5 + _MOST_SIGMAS * self._blur.widest_px

    def density(self, x: Float, y: Float, place: tuple[Float, Float] | None = None) -> Float:
        """Density of the places that `offset` gives, 1/pixel²; cut off beyond `reach_px`."""
        reach = self.reach_px
        inside = (abs(x) <= reach) & (abs(y) <= reach)
        if not isinstance(self._blur, GaussianBlur):
            return dr.select(inside, jit().Float(1), 0)
        scale = dr.rcp(self._blur.sigma_px(place) * 2**0.5)
        density = jit().Float(0.25)
        for side in (x, y):
            density = density * (dr.erf((0.5 - side) * scale) + dr.erf((0.5 + side) * scale))
        return dr.select(inside, density, 0)

    def seen(self, point: Vector3) -> tuple[Float, Float, Float]:
        """Column and row on the full sensor at which a point is seen, with the camera at rest, and its scale.

        Parameters
        ----------
        point : in world space, m.

        Returns
        -------
        col, row : fractional; whole numbers at the centres of pixels.
        px_per_m : image of a short length at that place, along the direction in which it is longest; 0 behind the
            pupil.
        """
        types = jit()
        away = types.Array3f(point) - types.Array3f(*self._origin)
        x, y, z = (sum(self._rotation[row][axis] * away[row] for row in range(3)) for axis in range(3))
        ahead, nearness = z < 0, dr.rcp(-z)
        col, row, scale = self._projection.places(x * nearness, -y * nearness)
        return col, row, dr.select(ahead, dr.norm(away) * dr.square(nearness) * scale, 0)
