"""Noise model of a sensor's frame pixels: its parameters over a region, mean and variance, and a call to sample it.

The formulas are in `hesim_render.pixels.aps.formulas`, the sampler is in `hesim_render.pixels.aps.sampler`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import NUMPY, Float, Namespace, UInt32, Values
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.plain import PlainState
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps import formulas
from hesim_render.pixels.aps.fixed_pattern import FixedPattern
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, BETA_TERMS, PixelProperties, PixelValue
from hesim_render.pixels.aps.sampler import DeviceMaps, draw_dn
from hesim_render.pixels.aps.telegraph import TelegraphPixels, telegraph_pixels
from hesim_render.pixels.arrays import switched_off
from hesim_render.specs.frame_pixels import ApsSpec, InterferenceSpec

APS_TERMS = (
    "shot", "dark_current", "read", "prnu", "dsnu", "row", "row_noise", "residual", "crosstalk", "telegraph", "column",
    "column_noise", "interference",
)  # fmt: skip


@dataclass(frozen=True, repr=False)
class ApsNoise(PlainState):
    """Noise model of a sensor's frame pixels over one read-out region.

    Parameters
    ----------
    spec : the ``aps`` section of the sensor file.
    layout : region read out; maps and random numbers are keyed by the full sensor's pixels.
    device_seed : which device of this kind. It alone determines all fixed-pattern maps.
    off : terms that are switched off, see `without`.

    Raises
    ------
    SpecError
        If the noise polynomial is negative between 0 and full scale at the file's exposure.
    """

    spec: ApsSpec
    layout: Layout
    device_seed: int
    off: frozenset[str] = field(default=frozenset())

    def __post_init__(self) -> None:
        bad = self._refused(self.spec.exposure_us)
        if bad:
            raise SpecError(bad, key="aps.beta")

    def __repr__(self) -> str:
        off = f"; off: {', '.join(sorted(self.off))}" if self.off else ""
        return f"<ApsNoise of the frame pixels of {self.layout!r}{off}>"

    def without(self, *terms: str) -> "ApsNoise":
        """The same model with terms of `APS_TERMS` switched off.

        ``shot`` is the noise of the light (β1, β3, β4), ``dark_current`` its mean and its noise (β2, β5),
        ``read`` is σ_r (β0), ``prnu``, ``dsnu``, ``row`` and ``column`` are the fixed maps, ``row_noise`` is N_tr,
        ``column_noise`` is N_tc, ``interference`` are the periodic patterns, ``residual`` is N_res, ``crosstalk`` is
        the light that these pixels get from their neighbours, ``telegraph`` is the random telegraph noise.

        Raises
        ------
        RangeError
            If a name is unknown.
        """
        return replace(self, off=switched_off(self.off, terms, APS_TERMS))

    def clean(self) -> "ApsNoise":
        """Without any noise: black level, gain, full well, rounding and clipping remain."""
        return self.without(*APS_TERMS)

    @property
    def crosstalk(self) -> float:
        """Fraction of the electrons that comes from the four neighbours and not from the pixel itself."""
        return 0.0 if "crosstalk" in self.off else self.layout.spec.geometry.crosstalk

    @property
    def row_noise_dn(self) -> float:
        """Standard deviation of N_tr, DN."""
        return 0.0 if "row_noise" in self.off else self.spec.row_noise_dn

    @property
    def column_noise_dn(self) -> float:
        """Standard deviation of N_tc, DN."""
        return 0.0 if "column_noise" in self.off else self.spec.column_noise_dn

    @property
    def read_noise_correlation(self) -> float:
        """Correlation of a pixel's read noise with that of the next pixel in its row."""
        return 0.0 if "read" in self.off else self.spec.read_noise_correlation

    @property
    def interference(self) -> list[InterferenceSpec]:
        """Periodic patterns of the read-out."""
        return [] if "interference" in self.off else self.spec.interference

    @property
    def _shared_dn2(self) -> float:
        """Variance of what rows, columns and interference add, DN²."""
        lines = sum(line.rms_dn**2 for line in self.interference)
        return self.row_noise_dn**2 + self.column_noise_dn**2 + lines

    @cached_property
    def telegraph(self) -> TelegraphPixels | None:
        """Pixels of this device with random telegraph noise."""
        return None if "telegraph" in self.off else telegraph_pixels(self.spec, self.layout, self.device_seed)

    @property
    def full_scale_dn(self) -> int:
        return 2**self.spec.bit_depth - 1

    @cached_property
    def fixed_pattern(self) -> FixedPattern:
        """Maps of PRNU, offset and dark current of this device."""
        return FixedPattern(self.spec, self.layout, self.device_seed, self.off)

    @cached_property
    def beta(self) -> NDArray[np.float64] | None:
        """[tile_row, tile_col, 6] of the polynomial form, 0 where a term is switched off; None in the physical form."""
        if self.spec.beta is None:
            return None
        return np.array(self.spec.beta, dtype=np.float64) * [term not in self.off for term in BETA_TERMS]

    @property
    def pixels(self) -> PixelProperties:
        """Properties of each pixel that the formulas need: maps [row, col] of the region, or numbers where all are
        equal.
        """
        beta = None if self.beta is None else tuple(np.moveaxis(self.layout.tiled(self.beta), -1, 0))
        maps = self.fixed_pattern
        return PixelProperties(maps.response, maps.dark_e_per_s, maps.offset_dn, beta)

    def _nominal_pixel(self, position: tuple[int, int] | None) -> PixelProperties:
        """A pixel at a tile position, without any fixed pattern."""
        known = self.layout.spec.positions("aps")
        chosen = known[0] if position is None else tuple(position)
        if chosen not in known:
            raise RangeError("position", position, "(tile_row, tile_col) of a frame pixel of the tile")
        dark = 0.0 if "dark_current" in self.off else self.spec.dark_current_now_e_per_s
        beta = None if self.beta is None else tuple(self.beta[chosen])
        return PixelProperties(1.0, dark, self.spec.black_level_dn, beta)

    def _refused(self, exposure_us: float) -> str:
        """The reason why the polynomial cannot be a variance at this exposure, µs; empty where it can."""
        if self.beta is None:
            return ""
        t = exposure_us * S_PER_US
        for position in self.layout.spec.positions("aps"):
            beta = self.beta[position]
            # linear in the light: the least value is at one of the ends
            gain = np.min(formulas.light_gain_dn(beta, np.array([0.0, self.full_scale_dn]), t))
            remainder = formulas.dark_variance_dn2(beta, t)
            for name, value in (("β1 + β3 I + β4 t", gain), ("β0 + β2 t + β5 t²", remainder)):
                if value < 0:
                    return (
                        f"position {position}: {name} is {value:.4g}, negative between 0 and {self.full_scale_dn} DN "
                        f"at {exposure_us:g} µs; it is a noise variance"
                    )
        return ""

    def value(self, electrons: Values, exposure_s: Values, pixels: PixelProperties, xp: Namespace) -> PixelValue:
        """Law of the pixels' values, DN, without N_FP and row noise.

        Parameters
        ----------
        electrons : mean photo-electrons I_e of the exposure, numbers or arrays like those of `pixels`.
        exposure_s : exposure, s.
        pixels : properties of the pixels.
        xp : functions of the arrays' library.
        """
        gain, full_scale = self.spec.system_gain_dn_per_e, float(self.full_scale_dn)
        curve = formulas.Curve.of(self.spec.nonlinearity, full_scale)
        if pixels.beta is None:
            read_noise_e = 0.0 if "read" in self.off else self.spec.read_noise_e
            shot = "shot" not in self.off
            value = formulas.physical_value(electrons, exposure_s, pixels, gain, read_noise_e, shot)
            if curve is not None:
                value = formulas.bent_value(value, gain, curve, xp)
        else:
            value = formulas.calibrated_value(electrons, exposure_s, pixels, gain, full_scale, xp, curve)
        residual_dn2 = 0.0 if "residual" in self.off else self.spec.residual_noise_dn**2
        return replace(value, gaussian_dn2=value.gaussian_dn2 + residual_dn2)

    def _on_host(
        self, electrons: NDArray[np.float64], exposure_us: float, position: tuple[int, int] | None
    ) -> tuple[PixelValue, PixelProperties]:
        """Law of the values of an image, or of a number at one position; and the properties of the pixels.

        Parameters
        ----------
        electrons : mean photo-electrons, an image [row, col] or a number.
        exposure_us : exposure, µs.
        position : (tile_row, tile_col) of a number, None for the first frame position.
        """
        if electrons.ndim and position is not None:
            raise RangeError("position", position, "none, as an image has the position of each pixel")
        pixels = self.pixels if electrons.ndim else self._nominal_pixel(position)
        return self.value(electrons, exposure_us * S_PER_US, pixels, NUMPY), pixels

    def _checked(self, electrons: ArrayLike, exposure_us: float) -> NDArray[np.float64]:
        values = np.asarray(electrons, dtype=np.float64)
        if values.ndim and values.shape != self.layout.shape:
            raise RangeError("shape of electrons", values.shape, f"{self.layout.shape} or a number")
        if not (np.all(np.isfinite(values)) and np.all(values >= 0)):
            raise RangeError("electrons", float(values.min()), "finite values of 0 or more")
        self._check_exposure(exposure_us)
        return values

    def _check_exposure(self, exposure_us: float) -> None:
        if not (np.isfinite(exposure_us) and exposure_us >= 0):
            raise RangeError("exposure_us", exposure_us, "a finite time of 0 µs or more")
        if self._refused(exposure_us):
            raise RangeError(
                "exposure_us", exposure_us, f"a time the noise model holds for: {self._refused(exposure_us)}"
            )

    def mean_dn(
        self, electrons: ArrayLike, exposure_us: float, position: tuple[int, int] | None = None
    ) -> NDArray[np.float64]:
        """Expected DN before full well, rounding and clipping.

        Parameters
        ----------
        electrons : mean photo-electrons I_e of the exposure; a number, or an image [row, col].
        exposure_us : exposure in µs.
        position : (tile_row, tile_col) of a number, default the first frame position. The number then has
            the nominal dark current and black level. An image uses each pixel's own maps.

        Returns
        -------
        DN, in the shape of `electrons`. Full well and the ADC's range are not included: near them the mean
        of samples is lower.
        """
        values = self._checked(electrons, exposure_us)
        value, pixels = self._on_host(values, exposure_us, position)
        return np.asarray(value.mean_dn + pixels.offset_dn, dtype=np.float64)

    def variance_dn2(
        self, electrons: ArrayLike, exposure_us: float, position: tuple[int, int] | None = None, adc: bool = False
    ) -> NDArray[np.float64]:
        """Temporal variance in DN² before the ADC, of the unclipped signal; parameters as in `mean_dn`.

        In the physical form it is K²((1 + PRNU)·I_e + D·t + σ_r²) + N_res² + N_tr² + N_tc², and that of the
        interference. An image also has telegraph noise. Near full well and full scale the variance of samples is lower.
        `adc` adds the q²/12 of rounding, which is accurate where the variance itself is above 0.24 DN².
        """
        values = self._checked(electrons, exposure_us)
        value, _ = self._on_host(values, exposure_us, position)
        shared = self._shared_dn2 + (ADC_VARIANCE_DN2 if adc else 0.0)
        variance = np.asarray(value.variance_dn2 + shared, dtype=np.float64)
        if values.ndim and self.telegraph is not None:
            variance = np.broadcast_to(variance, values.shape).copy()
            variance.ravel()[self.telegraph.place] += self.telegraph.variance_dn2
        return variance

    def noise_equivalent_e(self, electrons: NDArray, exposure_us: float) -> NDArray[np.float64]:
        """Standard deviation of a frame pixel in electrons at its input, PRNU included.

        An error of the clean signal is compared with it. The error of a render is a fixed pattern, as is PRNU. The
        values are those of the first frame position without fixed pattern; rounding adds 1/12 DN².

        Parameters
        ----------
        electrons : [n], noise-free electrons of the exposure.

        Returns
        -------
        [n], electrons.
        """
        signal = np.maximum(np.asarray(electrons, dtype=np.float64), 0.0)
        value = self.value(signal, exposure_us * S_PER_US, self._nominal_pixel(None), NUMPY)
        variance = value.variance_dn2 + self._shared_dn2 + ADC_VARIANCE_DN2
        spec = self.spec
        return formulas.noise_equivalent_e(variance, spec.system_gain_dn_per_e, spec.prnu_rel, signal, NUMPY)

    def to_polynomial(self) -> list[list[list[float]]]:
        """The variance as [tile_row][tile_col][β0 … β5] in DN and s; exact for the physical form.

        β0 = K²σ_r², β1 = K, β2 = K²D, the others are 0: PRNU is spatial and does not contribute to β3. N_res, N_tr and
        N_tc are not included.
        """
        if self.beta is not None:
            return self.beta.tolist()
        spec = self.spec
        physical = formulas.physical_beta(spec.system_gain_dn_per_e, spec.read_noise_e, spec.dark_current_now_e_per_s)
        cell = [0.0 if term in self.off else b for term, b in zip(BETA_TERMS, physical, strict=True)]
        tile_rows, tile_cols = self.layout.tile_shape
        return [[list(cell) for _ in range(tile_cols)] for _ in range(tile_rows)]

    def sample(self, electrons: ArrayLike | Float, exposure_us: float, seed: int, frame: int = 0) -> NDArray[np.uint16]:
        """One noisy frame.

        Parameters
        ----------
        electrons : mean photo-electrons: a number, an image [row, col], or a flat Dr.Jit array.
        exposure_us : exposure in µs.
        seed, frame : the result is a pure function of `seed`, `frame`, the device seed and `electrons`.

        Returns
        -------
        DN, uint16 [row, col]. Pixels without the frame role get a value too; `layout.aps_mask` is False there.

        Raises
        ------
        RangeError
            For a wrong shape, a negative or non-finite number of electrons or exposure.
        """
        types = jit()
        if not isinstance(electrons, types.Float):
            image = np.broadcast_to(self._checked(electrons, exposure_us), self.layout.shape)
            electrons = from_host(types.Float, image)
        dn = self.sample_dn(electrons, exposure_us, seed, frame)
        return dn.numpy().astype(np.uint16).reshape(self.layout.shape)

    def sample_dn(
        self, electrons: Float, exposure_us: float, seed: int, frame: int = 0, first_pixel: int = 0
    ) -> UInt32:
        """As `sample`, for a flat Dr.Jit array and without a copy to the host.

        Parameters
        ----------
        electrons : Float [n], mean photo-electrons of the region's pixels `first_pixel` … in row-major
            order. Whole regions and pieces of them give the same bits.

        Returns
        -------
        UInt32 [n], DN; not yet evaluated.
        """
        self._check_exposure(exposure_us)
        return draw_dn(self, self._device_maps, electrons, exposure_us, seed, frame, first_pixel)

    @cached_property
    def _device_maps(self) -> DeviceMaps:
        return DeviceMaps(self.layout, self.fixed_pattern, self.beta)
