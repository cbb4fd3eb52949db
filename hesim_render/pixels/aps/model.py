"""Noise of frame pixels: electrons in, DN out; the formulas and the sampler in one place.

Physical form, per pixel, I_e light electrons, D dark current in e⁻/s, t exposure in s, K gain in DN/e⁻::

    N_e = min( Poisson( (1 + PRNU)·I_e + D·t ), full well ) + N(0, σ_r²)
    DN  = clip( round( K·N_e + N_FP + N_tr + N_res ), 0, 2^bits − 1 )

Polynomial form (``aps.beta`` given), I = K·(1 + PRNU)·I_e in DN, per tile position::

    mean = I + t·N_DP + N_FP
    Var  = β0 + β1 I + β2 t + β3 I² + β4 I·t + β5 t²        before the ADC, without N_tr

Both are one model: a count of mean m, Poisson or Gaussian with variance m, is worth `gain` DN each and
sits on `fixed` DN; a Gaussian is added to the sum. N_FP = black + N_row + N_BLC. N_tr is one Gaussian
number of every row of a frame, shared by its pixels (temporal row noise). The ADC rounds once:
no uniform noise is added, and every variance here leaves out its q²/12.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.rng import Stream, philox
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.fixed_pattern import FixedPattern, Pixels, gathered
from hesim_render.pixels.aps.poisson import poisson
from hesim_render.pixels.arrays import to_device
from hesim_render.pixels.normal import normal_pair
from hesim_render.pixels.terms import switched_off
from hesim_render.specs.sensor import ApsSpec

APS_TERMS = ("shot", "dark_current", "read", "prnu", "dsnu", "row", "row_noise", "residual", "crosstalk")

ADC_VARIANCE_DN2 = 1.0 / 12.0


@dataclass(frozen=True)
class ApsNoise:
    """Noise model of a sensor's frame pixels over one read-out region.

    Parameters
    ----------
    spec : the ``aps`` section of the sensor file.
    layout : region read out; maps and random numbers are keyed by the full sensor's pixels.
    device_seed : which device of this kind: all fixed-pattern maps follow from it alone.
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

    def without(self, *terms: str) -> ApsNoise:
        """The same model with terms of `APS_TERMS` switched off.

        ``shot`` is the noise of the light (β1, β3, β4), ``dark_current`` its mean and its noise (β2, β5),
        ``read`` is σ_r (β0), ``prnu``, ``dsnu`` and ``row`` are the fixed maps, ``row_noise`` is N_tr, ``residual``
        N_res, ``crosstalk`` is what these pixels get of their neighbours' light.

        Raises
        ------
        RangeError
            If a name is unknown.
        """
        return replace(self, off=switched_off(self.off, terms, APS_TERMS))

    def clean(self) -> ApsNoise:
        """Without any noise: black level, gain, full well, rounding and clipping remain."""
        return self.without(*APS_TERMS)

    @property
    def crosstalk(self) -> float:
        """Part of the electrons that comes from the four neighbours, not from the pixel itself."""
        return 0.0 if "crosstalk" in self.off else self.layout.spec.geometry.crosstalk

    @property
    def row_noise_dn(self) -> float:
        """Standard deviation of N_tr, DN."""
        return 0.0 if "row_noise" in self.off else self.spec.row_noise_dn

    @property
    def full_scale_dn(self) -> int:
        return 2**self.spec.bit_depth - 1

    @cached_property
    def fixed_pattern(self) -> FixedPattern:
        """Maps of PRNU, offset and dark current of this device."""
        return FixedPattern(self.spec, self.layout, self.device_seed, self.off)

    @cached_property
    def _device_pixels(self) -> Pixels:
        """The maps as Dr.Jit arrays (or opaque numbers), flat."""
        beta = None
        if self.spec.beta is not None:
            table = np.array(self.spec.beta)
            uniform = np.all(table == table[:1, :1], axis=(0, 1))
            tiled = self.layout.tiled(table)
            beta = tuple(to_device(table[0, 0, k] if uniform[k] else tiled[..., k]) for k in range(6))
        maps = self.fixed_pattern
        return Pixels(to_device(maps.response), to_device(maps.dark_e_per_s), to_device(maps.offset_dn), beta)

    def _host_pixels(self, position: tuple[int, int] | None, image: bool) -> Pixels:
        """The same for the formulas on the host: one position's nominal values, or the maps."""
        spec = self.spec
        table = None if spec.beta is None else np.array(spec.beta, dtype=np.float64)
        if image:
            if position is not None:
                raise RangeError("position", position, "none, as an image has the position of each pixel")
            beta = None if table is None else tuple(np.moveaxis(self.layout.tiled(table), -1, 0))
            maps = self.fixed_pattern
            return Pixels(maps.response, maps.dark_e_per_s, maps.offset_dn, beta)
        known = self.layout.spec.positions("aps")
        chosen = known[0] if position is None else tuple(position)
        if chosen not in known:
            raise RangeError("position", position, "(tile_row, tile_col) of a frame pixel of the tile")
        dark = 0.0 if "dark_current" in self.off else spec.dark_current_now_e_per_s
        return Pixels(1.0, dark, spec.black_level_dn, None if table is None else tuple(table[chosen]))

    # ---- the model --------------------------------------------------------------------------------

    def _gain_and_remainder(self, signal_dn: Any, t: Any, beta: Any, xp: ModuleType) -> tuple[Any, Any]:
        """g = β1 + β3 I + β4 t in DN, and β0 + β2 t + β5 t² in DN²; I is taken up to full scale."""
        light = 0.0 if "shot" in self.off else 1.0
        dark = 0.0 if "dark_current" in self.off else 1.0
        read = 0.0 if "read" in self.off else 1.0
        gain = light * (beta[1] + beta[3] * xp.minimum(signal_dn, float(self.full_scale_dn)) + beta[4] * t)
        return gain, read * beta[0] + dark * (beta[2] * t + beta[5] * t * t)

    def _refused(self, exposure_us: float) -> str:
        """Why the polynomial cannot be a variance at this exposure, or nothing."""
        if self.spec.beta is None:
            return ""
        for position in self.layout.spec.positions("aps"):
            beta = np.array(self.spec.beta, dtype=np.float64)[position]
            ends = np.array([0.0, self.full_scale_dn])
            gain, remainder = self._gain_and_remainder(ends, exposure_us * S_PER_US, beta, np)
            for name, value in (("β1 + β3 I + β4 t", np.min(gain)), ("β0 + β2 t + β5 t²", remainder)):
                if value < 0:
                    return (
                        f"position {position}: {name} is {value:.4g}, negative between 0 and {self.full_scale_dn} DN "
                        f"at {exposure_us:g} µs; it is a noise variance"
                    )
        return ""

    def _parts(self, electrons: Any, t: Any, pixels: Pixels, xp: ModuleType) -> tuple[Any, Any, Any, Any]:
        """(fixed DN, gain in DN per count, mean count, Gaussian variance in DN²) of the signal."""
        gain_dn_per_e = self.spec.system_gain_dn_per_e
        light = pixels.response * electrons
        dark = pixels.dark_e_per_s * t
        residual = 0.0 if "residual" in self.off else self.spec.residual_noise_dn**2
        if pixels.beta is None:
            read = 0.0 if "read" in self.off else (gain_dn_per_e * self.spec.read_noise_e) ** 2
            # without shot noise of the light, that of the dark current remains
            fixed, mean = (light * gain_dn_per_e, 0.0 * light + dark) if "shot" in self.off else (0.0, light + dark)
            return fixed, gain_dn_per_e, mean, read + residual
        choose = np.where if xp is np else xp.select
        signal = gain_dn_per_e * light
        gain, remainder = self._gain_and_remainder(signal, t, pixels.beta, xp)
        noisy = gain > 0.0
        mean = choose(noisy, signal / choose(noisy, gain, 1.0), 0.0)
        fixed = gain_dn_per_e * dark + choose(noisy, 0.0, signal)
        return fixed, gain, mean, xp.maximum(remainder, 0.0) + residual

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
        position : (tile_row, tile_col) a number belongs to, default the first frame position; it then has
            the nominal dark current and black level. An image uses each pixel's own maps.

        Returns
        -------
        DN, of the shape of `electrons`. Full well and the ADC's range are left out: near them the mean
        of samples is lower.
        """
        values = self._checked(electrons, exposure_us)
        pixels = self._host_pixels(position, values.ndim > 0)
        fixed, gain, mean, _ = self._parts(values, exposure_us * S_PER_US, pixels, np)
        return np.asarray(fixed + gain * mean + pixels.offset_dn, dtype=np.float64)

    def variance_dn2(
        self, electrons: ArrayLike, exposure_us: float, position: tuple[int, int] | None = None, adc: bool = False
    ) -> NDArray[np.float64]:
        """Temporal variance in DN² before the ADC, of the unclipped signal; parameters as in `mean_dn`.

        In the physical form K²((1 + PRNU)·I_e + D·t + σ_r²) + N_res² + N_tr². Near full well and full scale
        the variance of samples is lower. `adc` adds the q²/12 of rounding, good where the variance
        itself is above 0.24 DN².
        """
        values = self._checked(electrons, exposure_us)
        pixels = self._host_pixels(position, values.ndim > 0)
        _, gain, mean, gaussian = self._parts(values, exposure_us * S_PER_US, pixels, np)
        shared = self.row_noise_dn**2 + (ADC_VARIANCE_DN2 if adc else 0.0)
        return np.asarray(gain * gain * mean + gaussian + shared, dtype=np.float64)

    def noise_equivalent_e(self, electrons: NDArray, exposure_us: float) -> NDArray[np.float64]:
        """Standard deviation of a frame pixel in electrons at its input, PRNU included.

        What an error of the clean signal is measured against; a render's error is a fixed pattern, as
        PRNU is. Nominal values of the first frame position; rounding counts with 1/12 DN².

        Parameters
        ----------
        electrons : [n], noise-free electrons of the exposure.

        Returns
        -------
        [n], electrons.
        """
        signal = np.maximum(np.asarray(electrons, dtype=np.float64), 0.0)
        _, gain, mean, gaussian = self._parts(signal, exposure_us * S_PER_US, self._host_pixels(None, False), np)
        temporal_dn2 = gain * gain * mean + gaussian + self.row_noise_dn**2 + ADC_VARIANCE_DN2
        fixed_e = self.spec.prnu_rel * signal
        return np.sqrt(temporal_dn2 / self.spec.system_gain_dn_per_e**2 + fixed_e**2)

    def to_polynomial(self) -> list[list[list[float]]]:
        """The variance as [tile_row][tile_col][β0 … β5] in DN and s; exact for the physical form.

        β0 = K²σ_r², β1 = K, β2 = K²D, the others 0: PRNU is spatial and never enters β3. N_res and N_tr are not in it.
        """
        gain, spec = self.spec.system_gain_dn_per_e, self.spec
        physical = [gain**2 * spec.read_noise_e**2, gain, gain**2 * spec.dark_current_now_e_per_s, 0.0, 0.0, 0.0]
        term = ("read", "shot", "dark_current", "shot", "shot", "dark_current")
        tile_rows, tile_cols = self.layout.tile_shape
        table = spec.beta or [[physical] * tile_cols] * tile_rows
        return [
            [[0.0 if t in self.off else b for t, b in zip(term, cell, strict=True)] for cell in row] for row in table
        ]

    # ---- the sampler ------------------------------------------------------------------------------

    def sample(self, electrons: Any, exposure_us: float, seed: int, frame: int = 0) -> NDArray[np.uint16]:
        """One noisy frame.

        Parameters
        ----------
        electrons : mean photo-electrons: a number, an image [row, col], or a flat Dr.Jit array.
        exposure_us : exposure in µs.
        seed, frame : the result is a pure function of them, the device seed and `electrons`.

        Returns
        -------
        DN, uint16 [row, col]. Pixels without the frame role get a value too; `layout.aps_mask` tells them.

        Raises
        ------
        RangeError
            For a wrong shape, a negative or non-finite number of electrons or exposure.
        """
        types = jit()
        if not isinstance(electrons, types.Float):
            image = np.broadcast_to(self._checked(electrons, exposure_us), self.layout.shape)
            electrons = types.Float(image.astype(np.float32).ravel())
        dn = self.sample_dn(electrons, exposure_us, seed, frame)
        return dn.numpy().astype(np.uint16).reshape(self.layout.shape)

    def sample_dn(self, electrons: Any, exposure_us: float, seed: int, frame: int = 0, first_pixel: int = 0) -> Any:
        """As `sample`, for a flat Dr.Jit array and without a copy to the host.

        Parameters
        ----------
        electrons : Float [n], mean photo-electrons of the region's pixels `first_pixel` … in row-major
            order. Whole regions and pieces of them give the same bits.

        Returns
        -------
        UInt32 [n], DN; not yet evaluated.
        """
        import drjit as dr

        types = jit()
        self._check_exposure(exposure_us)
        count = dr.width(electrons)
        index = dr.arange(types.UInt32, count) + dr.opaque(types.UInt32, first_pixel)
        pixels = self._device_pixels
        if count != self.layout.rows * self.layout.cols:
            pixels = gathered(pixels, index)
        t = dr.opaque(types.Float, exposure_us * S_PER_US)
        fixed, gain, mean, gaussian = self._parts(electrons, t, pixels, dr)

        key = self._pixel_key(index)
        generator = philox(seed, Stream.APS, key, frame)
        word = generator.next_uint32x4()
        if self.spec.law == "poisson":
            counts = poisson(mean, generator, (word[0], word[1]))
            deviate = normal_pair(word[2], word[3])[0]
        else:
            shot, deviate = normal_pair(word[0], word[1])
            counts = dr.fma(dr.sqrt(mean), shot, mean)
        full_well_dn = self.spec.full_well_e * self.spec.system_gain_dn_per_e
        level = dr.minimum(dr.fma(gain, counts, fixed), full_well_dn) + pixels.offset_dn
        level = dr.fma(dr.sqrt(types.Float(gaussian)), deviate, level)
        if self.row_noise_dn > 0:
            # of the row on the full sensor: every pixel of it draws the same number
            row = key // dr.opaque(types.UInt32, self.layout.spec.geometry.cols)
            word = philox(seed, Stream.ROW_NOISE, row, frame).next_uint32x4()
            level = dr.fma(dr.opaque(types.Float, self.row_noise_dn), normal_pair(word[0], word[1])[0], level)
        # not clip: of a level that is no number it makes the largest integer, which no ADC of fewer bits gives
        return types.UInt32(dr.select(level >= 0.0, dr.minimum(dr.round(level), float(self.full_scale_dn)), 0.0))

    @cached_property
    def _keys(self) -> Any:
        return jit().UInt32(self.layout.full_index.ravel())

    def _pixel_key(self, index: Any) -> Any:
        """Full-sensor index of the region's pixels: rows as wide as the sensor's need no table."""
        import drjit as dr

        types = jit()
        sensor_cols = self.layout.spec.geometry.cols
        if self.layout.cols == sensor_cols:
            return index + dr.opaque(types.UInt32, self.layout.row0 * sensor_cols)
        return dr.gather(types.UInt32, self._keys, index)
