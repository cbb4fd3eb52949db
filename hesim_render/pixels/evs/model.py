"""Noise of event pixels: from electrons of a window to the log voltage, its noise and event probabilities.

With N the electrons of one window of t_evs that ends at the sample, per event position::

    I  = K·Φ·t_ref·r, Φ = N/t_evs        DN of the signal reference; r: its filter over the pixel's own
    x  = β1 I + β2                        voltage, the photodiode's baseline included
    s² = (β3 I)² + β4² + 2 β5 β3 β4 I     "linear" shot law
    s² = β3² I + β4² + 2 β5 β3 β4 √I      "sqrt" shot law
    S  = ln x₁/x₀,  σ_n² = s₀²/x₀² + s₁²/x₁²,  ΔV = S + σ_n·z
    P₊ = Q((θ₊ − S)/σ_n),  P₋ = Q((θ₋ + S)/σ_n)

θ are natural-log thresholds; each pixel's own is θ·(1 + mismatch·z), drawn from the device seed or measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError
from hesim_render.core.rng import Stream, device_normal
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.arrays import to_device
from hesim_render.pixels.measured import relative_threshold
from hesim_render.pixels.terms import switched_off
from hesim_render.specs.sensor import EvsCoefficients, EvsSpec, PhotoreceptorSpec

EVS_TERMS = ("shot", "dark_current", "mismatch", "leak", "bandwidth", "refractory", "readout_limit", "crosstalk")

#: A pixel's threshold never falls below this part of the nominal one, as in v2e (0.01 of 0.2 ln units).
LEAST_THRESHOLD_REL = 0.05

#: Least noise that deviations of the clean signal are measured against, in thresholds.
LEAST_NOISE_THETA = 0.05

Map = float | NDArray[np.float32]


@dataclass(frozen=True)
class _Coefficients:
    """x and s² as functions of the window's electrons N; arrays over positions or pixels.

    x = slope·N + base, s² = dark + cross·√N^c + light·N^l, with (c, l) = (2, 2) for the linear shot law
    (√N² = N) and (1, 1) for the sqrt law.
    """

    slope: Any
    base: Any
    light: Any
    cross: Any
    dark: Any


@dataclass(frozen=True, eq=False)
class EvsNoise:
    """Noise model of a sensor's event pixels over one read-out region.

    Parameters
    ----------
    spec : the ``evs`` section of the sensor file.
    layout : region read out; thresholds and random numbers are keyed by the full sensor's pixels.
    device_seed : which device of this kind: the threshold maps follow from it alone.
    signal_scale : [event positions], response of the signal reference's filter over the position's own.
    off : terms that are switched off, see `without`.
    """

    spec: EvsSpec
    layout: Layout
    device_seed: int
    signal_scale: NDArray[np.float64]
    off: frozenset[str] = field(default=frozenset())

    def without(self, *terms: str) -> EvsNoise:
        """The same model with terms of `EVS_TERMS` switched off.

        ``shot`` is β3, ``dark_current`` is β4 (its shot noise), ``mismatch`` the spread of thresholds,
        ``leak`` the leak events, ``bandwidth`` the photoreceptor's low-pass, ``refractory`` the dead time after
        an event, ``readout_limit`` the loss of events in the read-out, ``crosstalk`` what these pixels get of their
        neighbours' light.

        Raises
        ------
        RangeError
            If a name is unknown.
        """
        return replace(self, off=switched_off(self.off, terms, EVS_TERMS))

    def clean(self) -> EvsNoise:
        """Without any noise or limit: nominal thresholds compared with the noise-free change, every event read."""
        return self.without(*EVS_TERMS)

    @property
    def leak_rate_hz(self) -> float:
        return 0.0 if "leak" in self.off else self.spec.leak_rate_hz

    @property
    def crosstalk(self) -> float:
        """Part of the electrons that comes from the four neighbours, not from the pixel itself."""
        return 0.0 if "crosstalk" in self.off else self.layout.spec.geometry.crosstalk

    @property
    def photoreceptor(self) -> PhotoreceptorSpec | None:
        """The low-pass of the signal, None where there is none."""
        return None if "bandwidth" in self.off else self.spec.photoreceptor

    @property
    def refractory_period_us(self) -> int | None:
        return None if "refractory" in self.off else self.spec.refractory_period_us

    @property
    def readout_max_events_per_s(self) -> float | None:
        return None if "readout_limit" in self.off else self.spec.readout_max_events_per_s

    @property
    def readout_buffer_events(self) -> int:
        """Events that can wait for the read-out: as in the file, or those it takes in a tick or in 1 ms."""
        spec = self.spec
        if spec.readout_buffer_events is not None or spec.readout_max_events_per_s is None:
            return spec.readout_buffer_events or 1
        return max(1, round(spec.readout_max_events_per_s * (spec.tick_us or 1000) * S_PER_US))

    @property
    def is_noiseless(self) -> bool:
        """True where ln x has no temporal noise at any signal."""
        table = self._table
        return not (np.any(table.light) or np.any(table.dark))

    # ---- per-position coefficients and per-pixel thresholds -----------------------------------------

    @property
    def _dn_per_electron(self) -> NDArray[np.float64]:
        """DN of the signal reference for one electron of the window, per event position."""
        reference = self.spec.signal_reference
        return reference.k_dn_per_e * reference.t_ref_us / self.spec.window_us * np.asarray(self.signal_scale)

    @cached_property
    def _table(self) -> _Coefficients:
        """Coefficients of each event position, float64 [positions]."""
        spec = self.spec
        count = len(self.layout.spec.positions("evs"))
        entries = spec.coefficients * (count if len(spec.coefficients) == 1 else 1)
        beta1, beta2, beta3, beta4, beta5 = (
            np.array([getattr(entry, name) for entry in entries], dtype=np.float64) for name in _BETA_NAMES
        )
        beta3 = 0.0 * beta3 if "shot" in self.off else beta3
        beta4 = 0.0 * beta4 if "dark_current" in self.off else beta4
        dn_per_electron = self._dn_per_electron
        linear = spec.shot_law == "linear"
        return _Coefficients(
            slope=beta1 * dn_per_electron,
            base=beta2,
            light=beta3**2 * (dn_per_electron**2 if linear else dn_per_electron),
            cross=2 * beta5 * beta3 * beta4 * (dn_per_electron if linear else np.sqrt(dn_per_electron)),
            dark=beta4**2,
        )

    def _threshold_map(self, nominal: float, polarity: str, stream: Stream) -> Map:
        spread = self.spec.threshold_mismatch_std
        if "mismatch" in self.off or spread == 0:
            return nominal
        relative: NDArray[np.floating] | None = relative_threshold(self.layout, polarity, spread)
        if relative is None:
            index = self.layout.full_index.ravel()[self.layout.evs_pixel]
            relative = 1.0 + spread * device_normal(self.device_seed, stream, index)
        return (nominal * np.maximum(relative, LEAST_THRESHOLD_REL)).astype(np.float32)

    @cached_property
    def threshold_on_map(self) -> Map:
        """θ₊ in ln units, [y, x] of the event grid; a number where there is no spread."""
        return self._threshold_map(self.spec.contrast_threshold_on, "on", Stream.THRESHOLD_ON)

    @cached_property
    def threshold_off_map(self) -> Map:
        """θ₋ in ln units, positive, [y, x] of the event grid; a number where there is no spread."""
        return self._threshold_map(self.spec.contrast_threshold_off, "off", Stream.THRESHOLD_OFF)

    @cached_property
    def device_thresholds(self) -> tuple[Any, Any]:
        """θ₊ and θ₋ as Dr.Jit Floats: flat arrays over the event grid, or numbers."""
        return to_device(self.threshold_on_map), to_device(self.threshold_off_map)

    @cached_property
    def device_key(self) -> Any:
        """Full-sensor index of each event pixel, UInt32, flat: what random numbers are keyed by."""
        return jit().UInt32(self.layout.full_index.ravel()[self.layout.evs_pixel.ravel()])

    @cached_property
    def _device_coefficients(self) -> _Coefficients:
        return _Coefficients(**{name: self._by_position(values) for name, values in vars(self._table).items()})

    def _by_position(self, values: NDArray[np.float64]) -> Any:
        """An opaque number where all positions agree; else a table looked up by each pixel's position."""
        import drjit as dr

        if np.all(values == values[0]):
            return to_device(values[0])
        return dr.gather(jit().Float, to_device(values), self._device_position)

    @cached_property
    def _device_position(self) -> Any:
        import drjit as dr

        position = jit().UInt32(self.layout.evs_position.ravel().astype(np.uint32))
        dr.eval(position)
        return position

    @cached_property
    def _device_corner_level(self) -> Any:
        """x above its baseline at the photoreceptor's reference signal: β1·signal_dn."""
        assert self.spec.photoreceptor is not None and self.spec.photoreceptor.signal_dn is not None
        table = self._table
        return self._by_position(table.slope / self._dn_per_electron * self.spec.photoreceptor.signal_dn)

    # ---- the model ----------------------------------------------------------------------------------

    def log_level(self, electrons: Any) -> tuple[Any, Any]:
        """ln x and its noise variance s²/x² of every event pixel, on Dr.Jit.

        Parameters
        ----------
        electrons : Float [event pixels], noise-free electrons of the window that ends at the sample.
        """
        import drjit as dr

        return self._log_level(electrons, self._device_coefficients, dr)

    def corner_hz(self, log: Any) -> Any:
        """Corner of each pixel's photoreceptor at ln x, on Dr.Jit: f_c·I/signal_dn between the file's two limits."""
        import drjit as dr

        spec = self.spec.photoreceptor
        assert spec is not None and spec.min_cutoff_hz is not None
        signal = (dr.exp(log) - self._device_coefficients.base) / self._device_corner_level
        return dr.clip(spec.cutoff_hz * signal, spec.min_cutoff_hz, spec.cutoff_hz)

    def _log_level(self, electrons: Any, k: _Coefficients, xp: ModuleType) -> tuple[Any, Any]:
        x = k.slope * electrons + k.base
        return xp.log(x), self._variance(electrons, k, xp) / (x * x)

    def _variance(self, electrons: Any, k: _Coefficients, xp: ModuleType) -> Any:
        """s²."""
        root = electrons if self.spec.shot_law == "linear" else xp.sqrt(electrons)
        # with full anticorrelation s² is a square that can be 0: rounding must not take it below
        return xp.maximum((k.light * root + k.cross) * root + k.dark, 0.0)

    def noise_equivalent_e(self, electrons: NDArray, position: NDArray[np.integer]) -> NDArray:
        """The change of a window's electrons that equals one standard deviation of ln x, or θ/20 if that is more.

        What a deviation of the clean signal is measured against. The floor keeps a sensor (nearly) without
        noise from asking for the impossible: θ/20 moves no threshold crossing by more than a twentieth.

        Parameters
        ----------
        electrons : [..., n], noise-free electrons of the window; float32 is kept.
        position : [n], event positions, counted in reading order of the tile.

        Returns
        -------
        [..., n], electrons: the larger of s and θ/20·x, over the slope dx/dN.
        """
        kind = np.result_type(electrons, np.float32)
        k = _Coefficients(**{name: values.astype(kind)[position] for name, values in vars(self._table).items()})
        theta = min(self.spec.contrast_threshold_on, self.spec.contrast_threshold_off)
        counted = np.maximum(electrons, kind.type(0))
        floor = kind.type(LEAST_NOISE_THETA * theta) * (k.slope * counted + k.base)
        return np.maximum(np.sqrt(self._variance(counted, k, np)), floor) / k.slope

    def log_signal(self, electrons_per_s: NDArray[np.float64], event_pixel: NDArray[np.integer]) -> NDArray[np.float64]:
        """ln x, noise-free, of a flux.

        Parameters
        ----------
        electrons_per_s : [..., n], e⁻/s.
        event_pixel : [n], places on the event grid, row-major.
        """
        where = self.layout.evs_position.ravel()[event_pixel]
        k = _Coefficients(**{name: values[where] for name, values in vars(self._table).items()})
        return self._log_level(np.maximum(electrons_per_s, 0.0) * (self.spec.window_us * S_PER_US), k, np)[0]

    def _position_number(self, position: int | tuple[int, int] | None) -> int:
        known = self.layout.spec.positions("evs")
        if position is None:
            return 0
        if isinstance(position, tuple):
            if position in known:
                return known.index(position)
        elif 0 <= position < len(known):
            return int(position)
        raise RangeError("position", position, f"an event position: 0 to {len(known) - 1}, or one of {known}")

    def event_probability(
        self,
        electrons_0: ArrayLike,
        electrons_1: ArrayLike,
        position: int | tuple[int, int] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Probability of an ON and of an OFF event when a sample is compared with the one before.

        Parameters
        ----------
        electrons_0, electrons_1 : noise-free electrons of the earlier and the later window; numbers or
            images [y, x] on the event grid.
        position : event position of a number, counted in reading order or as (tile_row, tile_col);
            default the first; thresholds are then nominal. Images use each pixel's own of both.

        Returns
        -------
        p_on, p_off : P₊ and P₋ of the module's head. Leak events are a process of their own, not included.

        Raises
        ------
        RangeError
            In `last_event` mode, where no such probability exists; for negative or non-finite electrons,
            a wrong shape or an unknown position.
        """
        if self.spec.reference == "last_event":
            raise RangeError(
                "evs.reference", "last_event", "'previous_sample': without fixed comparisons there is no probability"
            )
        levels = [np.asarray(e, dtype=np.float64) for e in (electrons_0, electrons_1)]
        for name, values in zip(("electrons_0", "electrons_1"), levels, strict=True):
            if values.ndim and values.shape != self.layout.evs_shape:
                raise RangeError(
                    f"shape of {name}", values.shape, f"{self.layout.evs_shape}, the event grid, or a number"
                )
            if not (np.all(np.isfinite(values)) and np.all(values >= 0)):
                raise RangeError(name, float(values.min()), "finite values of 0 or more")
        theta_on: Map
        theta_off: Map
        if any(values.ndim for values in levels):
            if position is not None:
                raise RangeError("position", position, "none, as an image has the position of each pixel")
            where: Any = self.layout.evs_position
            theta_on, theta_off = self.threshold_on_map, self.threshold_off_map
        else:
            where = self._position_number(position)
            theta_on, theta_off = self.spec.contrast_threshold_on, self.spec.contrast_threshold_off
        table = _Coefficients(**{name: values[where] for name, values in vars(self._table).items()})
        (log_0, variance_0), (log_1, variance_1) = (self._log_level(e, table, np) for e in levels)
        change, sigma = log_1 - log_0, np.sqrt(variance_0 + variance_1)
        return _exceedance(theta_on - change, sigma), _exceedance(theta_off + change, sigma)


_BETA_NAMES = tuple(name for name in EvsCoefficients.model_fields)


def _exceedance(margin: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """P(σ·z > margin) = Q(margin/σ); without noise 1 where the margin is negative, else 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0, special.ndtr(-margin / sigma), np.where(margin < 0, 1.0, 0.0))
