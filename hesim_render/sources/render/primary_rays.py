"""Primary rays: one ray per sample of each mosaic pixel, and the place at which a point is seen.

Camera space and positions on the chip are those of `camera`.
"""

from __future__ import annotations

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, Point2, Point3, Vector3
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.projection import DeviceProjection

_FWHM_PER_SIGMA = 2.3548200450309493  # 2 √(2 ln 2)
#: Part of the PSF in which `RayFactory.density` is not zero, standard deviations: all but 2e-7 of the rays.
_MOST_SIGMAS = 5.2


class RayFactory:
    """Primary rays of mosaic pixels on the device: box aperture, Gaussian PSF, pinhole at the entrance pupil.

    Rows and columns are those of the full sensor, so a crop's rays equal those of the full sensor to the bit.
    """

    def __init__(self, view: View) -> None:
        import drjit as dr

        types = jit()
        geometry = view.sensor.spec.geometry
        self._projection = DeviceProjection(view.projection)
        psf_um = view.sensor.spec.lens.psf_fwhm_um
        self.has_psf = psf_um > 0
        self._sigma_px = dr.opaque(types.Float, float(psf_um / _FWHM_PER_SIGMA / geometry.pitch_um))
        self._rotation = [[dr.opaque(types.Float, float(v)) for v in row] for row in view.camera_to_world[:3, :3]]
        self._origin = [dr.opaque(types.Float, float(v)) for v in view.camera_to_world[:3, 3]]
        self._near = dr.opaque(types.Float, view.near_m) if view.near_m > 0 else None

    def rays(self, row: Float, col: Float, aperture: Point2, blur: Point2 | None) -> tuple[Point3, Vector3]:
        """Origin and unit direction of one ray per lane in world space, with the camera at rest.

        Parameters
        ----------
        row, col : Dr.Jit Float, position on the full sensor.
        aperture : pair of Float in [0, 1), place inside the pixel.
        blur : pair of Float in [0, 1) for the PSF, or None.
        """
        return self.towards(row, col, *self.offset(aperture, blur))

    def offset(self, aperture: Point2, blur: Point2 | None) -> tuple[Float, Float]:
        """Place of a ray relative to the centre of its pixel, pixels; see `rays`."""
        import drjit as dr

        x, y = aperture[0] - 0.5, aperture[1] - 0.5
        if blur is not None:  # Box-Muller
            radius = self._sigma_px * dr.sqrt(-2 * dr.log(1 - blur[0]))
            sine, cosine = dr.sincos(2 * dr.pi * blur[1])
            x, y = x + radius * cosine, y + radius * sine
        return x, y

    def towards(self, row: Float, col: Float, offset_x: Float, offset_y: Float) -> tuple[Point3, Vector3]:
        """As `rays`, from the places that `offset` gives."""
        import drjit as dr

        types = jit()
        x, y = self._projection.tangents(row, col, offset_x, offset_y)
        local = dr.normalize(types.Array3f(x, -y, -1.0))
        direction = types.Array3f(*(r[0] * local.x + r[1] * local.y + r[2] * local.z for r in self._rotation))
        origin = types.Array3f(*self._origin)
        if self._near is not None:  # the ray starts at that depth
            origin = dr.fma(direction, self._near / -local.z, origin)
        return origin, direction

    @property
    def reach_px(self) -> Float:
        """Half the width of the square around the centre of a pixel in which nearly all of its rays lie, pixels."""
        return 0.5 + _MOST_SIGMAS * self._sigma_px

    def density(self, x: Float, y: Float) -> Float:
        """Density of the places that `offset` gives, 1/pixel²; cut off beyond `reach_px`."""
        import drjit as dr

        reach = self.reach_px
        inside = (abs(x) <= reach) & (abs(y) <= reach)
        if not self.has_psf:
            return dr.select(inside, jit().Float(1), 0)
        scale = dr.rcp(self._sigma_px * 2**0.5)
        found = jit().Float(0.25)
        for place in (x, y):
            found = found * (dr.erf((0.5 - place) * scale) + dr.erf((0.5 + place) * scale))
        return dr.select(inside, found, 0)

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
        import drjit as dr

        types = jit()
        away = types.Array3f(point) - types.Array3f(*self._origin)
        x, y, z = (sum(self._rotation[row][axis] * away[row] for row in range(3)) for axis in range(3))
        ahead, nearness = z < 0, dr.rcp(-z)
        col, row, scale = self._projection.places(x * nearness, -y * nearness)
        return col, row, dr.select(ahead, dr.norm(away) * dr.square(nearness) * scale, 0)
