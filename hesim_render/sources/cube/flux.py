"""A hyperspectral cube as a source of flux: each pixel sees it through its own filter, lit and moved as asked."""

from collections.abc import Mapping
from math import ceil, hypot, log
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError, model_validator

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Halves, UInt32
from hesim_render.core.errors import ConflictError, RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import LUMINOUS_EFFICACY_LM_PER_W, US_PER_S
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.cube.planes import integrated, integration_weights
from hesim_render.sources.still import WindowByWindow, checked_windows
from hesim_render.specs.files import Strict
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.spectrum import photopic, product, scale_to_lux
from hesim_render.targets.cube_file import CubeFile, open_cube

#: Largest motion of the image between two instants of an average, px.
_STEP_PX = 0.5
#: Most instants of an average: faster motion blurs over this many.
_MOST_INSTANTS = 4096
#: Reflectance above 1, or below 0, by rounding.
_ROUNDING = 1e-4


class CubeFlux(WindowByWindow):
    """Φ = V(x) · ∫ R_f(λ) L(x, λ) dλ with the cube's radiance at the place that a pixel sees; implements `FluxSource`.

    The cube is integrated with the response of each filter once. Values between texels are bilinear; where a pixel
    covers several texels they are averaged first, over whole texels. A moving image is the mean over instants between
    which it moves by half a pixel or less. Beyond its edges the image is mirrored.

    Parameters
    ----------
    source : path of a cube, or an open one.
    sensor : the sensor, with region and lens.
    options : light, framing and motion.

    Raises
    ------
    SpecError
        If the cube cannot be read, does not cover a response, or holds reflectances outside 0 to 1.
    """

    def __init__(self, source: str | Path | CubeFile, sensor: Sensor, options: "CubeOptions") -> None:
        self.sensor, self.options = sensor, options
        self.cube = source if isinstance(source, CubeFile) else open_cube(Path(source), options.wavelength_nm)
        self.is_static = not options.is_moving
        rows, cols = self.cube.shape[:2]
        scale = np.array([rows / sensor.rows, cols / sensor.cols])  # texels per pixel
        if options.fit == "cover":
            scale[:] = scale.min()
        elif options.fit == "pixel":
            scale[:] = 1.0
        # averaging keeps whole squares; what they do not divide is interpolated
        self._shrink = max(1, int(scale.min() + 1e-9))
        self._scale = scale / self._shrink
        planes = self._planes()
        self._plane_shape = planes.shape[1:]
        types = jit()
        self._values = from_host(types.Float, planes)
        self._filter = from_host(types.UInt32, sensor.layout.filter_index)
        self._shading = from_host(types.Float, sensor.relative_illumination)

    def _planes(self) -> NDArray[np.float32]:
        options, sensor = self.options, self.sensor
        responses = [sensor.responses[name] for name in sensor.layout.filters]
        hold = options.beyond == "hold"
        factor = 1.0 if options.scale is None else options.scale
        if options.quantity == "reflectance":
            self.cube.require_reflectance()
            assert options.illuminance_lux is not None
            irradiance = scale_to_lux(options.illuminant.load(), options.illuminance_lux)
            responses = [product(each, irradiance).scaled(1 / np.pi) for each in responses]
        elif options.mean_luminance_cd_m2 is not None:
            weights = integration_weights([photopic()], self.cube, hold)
            mean = float(integrated(self.cube, weights, self._shrink).mean(dtype=np.float64))
            if not mean > 0:
                raise SpecError("holds no light", file=self.cube.file)
            factor = options.mean_luminance_cd_m2 / (LUMINOUS_EFFICACY_LM_PER_W * mean)
        elif options.scale is None and not self.cube.is_absolute:
            raise SpecError(
                "does not say the unit of its radiance: give scale (to W m^-2 sr^-1 nm^-1) or mean_luminance_cd_m2",
                file=self.cube.file,
            )
        planes = integrated(self.cube, integration_weights(responses, self.cube, hold) * factor, self._shrink)
        if options.quantity == "reflectance":
            # a reflectance of 1 everywhere gives the most
            most = np.array([each.integral() for each in responses])[:, None, None]
            if (planes > most * (1 + _ROUNDING)).any():
                raise SpecError(
                    "reflectances must lie in [0, 1] (see scale, or quantity: radiance)", file=self.cube.file
                )
        if (planes < -_ROUNDING * max(float(planes.max()), 0.0)).any():
            raise SpecError("holds light below 0", file=self.cube.file)
        return np.maximum(planes, 0)

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No edges: intervals may have any length."""
        return np.empty(0)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times between which the image moves by half a pixel or less."""
        if self.is_static:
            return np.empty(0)
        count = self._instants(begin_us, end_us)
        return np.linspace(begin_us, end_us, count + 1)[1:-1]

    def _instants(self, begin_us: float, end_us: float) -> int:
        """Number of parts of an interval in which the image moves by half a pixel or less in its corners."""
        seconds = (end_us - begin_us) / US_PER_S
        options = self.options
        far = hypot(self.sensor.rows, self.sensor.cols) / 2
        speed = hypot(*options.pan_px_per_s) + far * (
            abs(log(options.zoom_per_s)) + abs(np.radians(options.rotation_deg_per_s))
        )
        return min(_MOST_INSTANTS, max(1, ceil(seconds * speed / _STEP_PX)))

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`; both halves are the same, as a cube has no Monte-Carlo error."""
        types = jit()
        pixels, begin, end = checked_windows(pixel, begin_us, end_us, self.sensor.rows * self.sensor.cols)
        if pixels.size == 0:
            nothing = dr.zeros(types.Float, 0)
            return nothing, nothing
        index = from_host(types.UInt32, pixels)
        if self.is_static:
            total = self._at(index, dr.zeros(types.Float, 1))
        else:
            number = self._instants(0.0, float(np.max(end - begin)))
            total = dr.zeros(types.Float, pixels.size)
            for k in range(number):
                middle = begin + (end - begin) * ((k + 0.5) / number)
                seconds = np.atleast_1d(middle / US_PER_S).astype(np.float32)
                one = seconds.size == 1
                time_s = dr.opaque(types.Float, float(seconds[0])) if one else from_host(types.Float, seconds)
                total += self._at(index, time_s) / number
                dr.eval(total)
        dr.eval(total)
        return total, total

    def _at(self, index: UInt32, time_s: Float) -> Float:
        """Φ at an instant."""
        types, options = jit(), self.options
        cols = self.sensor.cols
        row = index // cols
        x = types.Float(index - row * cols) + 0.5 - self.sensor.cols / 2
        y = types.Float(row) + 0.5 - self.sensor.rows / 2
        if options.is_moving:
            # the pixel sees the point of the image that has come there
            x, y = x - options.pan_px_per_s[0] * time_s, y - options.pan_px_per_s[1] * time_s
            angle = float(np.radians(options.rotation_deg_per_s)) * time_s
            grown = dr.exp(-log(options.zoom_per_s) * time_s)
            sine, cosine = dr.sin(angle), dr.cos(angle)
            x, y = grown * (cosine * x + sine * y), grown * (cosine * y - sine * x)
        rows, columns = self._plane_shape
        v = y * float(self._scale[0]) + rows / 2 - 0.5
        u = x * float(self._scale[1]) + columns / 2 - 0.5
        top, left = dr.floor(v), dr.floor(u)
        down, right = v - top, u - left
        plane = dr.gather(types.UInt32, self._filter, index) * (rows * columns)
        value: Float = 0.0
        for i, weight_v in ((0, 1 - down), (1, down)):
            line = plane + _mirrored(top + i, rows) * columns
            for j, weight_u in ((0, 1 - right), (1, right)):
                value += weight_v * weight_u * dr.gather(types.Float, self._values, line + _mirrored(left + j, columns))
        return value * dr.gather(types.Float, self._shading, index)

    def describe(self) -> dict[str, Any]:
        """The manifest's entry: file, layout, size, light, framing and motion."""
        bands = self.cube.wavelength_nm
        assert bands is not None
        return {
            "file": self.cube.file.name,
            "layout": self.cube.layout,
            "rows_cols_bands": list(self.cube.shape),
            "wavelength_nm": [float(bands[0]), float(bands[-1])],
            "texels_per_pixel": (self._scale * self._shrink).tolist(),
            "texels_averaged": self._shrink,
            **self.options.model_dump(mode="json", exclude={"wavelength_nm"}),
        }


def _mirrored(place: Float, count: int) -> UInt32:
    """Index of a texel of an endless row of mirror images, for whole numbers of either sign."""
    types = jit()
    period = 2.0 * count
    inside = place - period * dr.floor(place / period)
    return types.UInt32(dr.clip(dr.select(inside < count, inside, period - 1 - inside), 0.0, count - 1.0))


class CubeOptions(Strict):
    """Light, framing and motion of a cube in front of a sensor.

    Parameters
    ----------
    quantity : ``reflectance`` (0 to 1, lit by `illuminant`) or ``radiance``.
    wavelength_nm : of the bands, where the file does not say.
    beyond : outside the wavelengths of the cube: ``refuse``, or ``hold`` its first and last plane.
    scale : multiplies the values; makes radiance W m⁻² sr⁻¹ nm⁻¹. A radiance whose file does not say its unit needs
        it, or `mean_luminance_cd_m2`.
    illuminant : light on reflectances, and the white of colour views.
    illuminance_lux : of reflectances, lx.
    mean_luminance_cd_m2 : of a cube of radiance in unknown units, in place of `scale`.
    fit : ``cover`` (the cube fills the read-out region), ``stretch`` or ``pixel`` (a texel is a pixel).
    pan_px_per_s : velocity of the image to the right and downwards, px/s.
    zoom_per_s : factor by which the image grows in a second; 1 for none.
    rotation_deg_per_s : of the image about the centre of the region, clockwise as seen, degrees per second.
    """

    quantity: Literal["reflectance", "radiance"] = "reflectance"
    wavelength_nm: list[float] | None = Field(None, min_length=2)
    beyond: Literal["refuse", "hold"] = "refuse"
    scale: float | None = Field(None, gt=0, le=1e12)
    illuminant: SpectrumSpec = SpectrumSpec(illuminant="D65")
    illuminance_lux: float | None = Field(None, gt=0, le=1e9)
    mean_luminance_cd_m2: float | None = Field(None, gt=0, le=1e9)
    fit: Literal["cover", "stretch", "pixel"] = "cover"
    pan_px_per_s: tuple[float, float] = (0.0, 0.0)
    zoom_per_s: float = Field(1.0, ge=0.01, le=100)
    rotation_deg_per_s: float = Field(0.0, ge=-1e5, le=1e5)

    @model_validator(mode="after")
    def _check(self) -> "CubeOptions":
        if self.quantity == "reflectance":
            if self.mean_luminance_cd_m2 is not None:
                raise ValueError("mean_luminance_cd_m2 is for radiance; give reflectances illuminance_lux")
            if self.illuminance_lux is None:
                raise ValueError("reflectances need illuminance_lux")
        elif self.illuminance_lux is not None:
            raise ValueError("illuminance_lux is for reflectances; a radiance has its own light")
        if any(abs(speed) > 1e7 for speed in self.pan_px_per_s):
            raise ValueError("pan_px_per_s: expected at most 1e7 px/s")
        return self

    @classmethod
    def of(cls, given: Mapping[str, object]) -> "CubeOptions":
        """Options from keywords.

        Raises
        ------
        RangeError
            For an unknown name or a value out of range; the message has the name.
        """
        try:
            return cls.model_validate(given)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            name, text = ".".join(map(str, problem["loc"])), problem["msg"].removeprefix("Value error, ")
            if not name:  # of several options together
                raise ConflictError("options", None, text) from None
            raise RangeError(name, problem.get("input"), text) from None

    @property
    def is_moving(self) -> bool:
        """True if the image changes with time."""
        return self.pan_px_per_s != (0.0, 0.0) or self.zoom_per_s != 1 or self.rotation_deg_per_s != 0
