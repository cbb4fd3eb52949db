"""Noise model of a sensor's event pixels: its parameters over a region, the log voltage and event probabilities.

The formulas are in `hesim_render.pixels.evs.formulas`, the sampler is in `hesim_render.pixels.evs.stage`. With N the
electrons of one window of t_evs that ends at the sample, the signal is I = K·(N/t_evs)·t_ref·r in DN of the signal
reference. r is the response of the reference's filter over that of the pixel's own filter. The thresholds of each
pixel are drawn from the device seed, or measured.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import NUMPY, Float
from hesim_render.core.errors import RangeError
from hesim_render.core.plain import PlainState
from hesim_render.core.rng import Stream, device_normal
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.arrays import switched_off
from hesim_render.pixels.evs import formulas
from hesim_render.pixels.evs.defects import PixelDefects, defects_of
from hesim_render.pixels.evs.formulas import Coefficients
from hesim_render.pixels.evs.noise_rates import LEAST_THRESHOLD_REL
from hesim_render.pixels.evs.on_device import EventPixels, Map
from hesim_render.pixels.measured import relative_threshold
from hesim_render.specs.event_pixels import EvsCoefficients, EvsSpec, LeakSpec, PhotoreceptorSpec

#: Kinds of defects, each a term.
_DEFECTS = ("stuck", "hot", "flickering")
EVS_TERMS = (
    *("shot", "dark_current", "mismatch", "leak", "bandwidth", "refractory", "readout_limit", "crosstalk"),
    *("comparator_noise", *_DEFECTS),
)

#: Least noise with which deviations of the clean signal are compared, in thresholds.
LEAST_NOISE_THETA = 0.05


@dataclass(frozen=True, eq=False, repr=False)
class EvsNoise(PlainState):
    """Noise model of a sensor's event pixels over one read-out region.

    Parameters
    ----------
    spec : the ``evs`` section of the sensor file.
    layout : region read out; thresholds and random numbers are keyed by the full sensor's pixels.
    device_seed : which device of this kind. It alone determines the threshold maps.
    signal_scale : [event positions], response of the signal reference's filter over the position's own.
    off : terms that are switched off, see `without`.
    """

    spec: EvsSpec
    layout: Layout
    device_seed: int
    signal_scale: NDArray[np.float64]
    off: frozenset[str] = field(default=frozenset())

    def __repr__(self) -> str:
        off = f"; off: {', '.join(sorted(self.off))}" if self.off else ""
        return f"<EvsNoise of the event pixels of {self.layout!r}{off}>"

    def without(self, *terms: str) -> "EvsNoise":
        """The same model with terms of `EVS_TERMS` switched off.

        ``shot`` is β3, ``dark_current`` is β4 (its shot noise), ``mismatch`` the spread over pixels,
        ``leak`` the leak, ``bandwidth`` the photoreceptor's low-pass, ``refractory`` the dead time after
        an event, ``readout_limit`` the loss of events in the read-out, ``crosstalk`` the light from neighbouring
        pixels, ``comparator_noise`` the events of the comparators' own noise, ``stuck``, ``hot`` and ``flickering``
        the defects of pixels.

        Raises
        ------
        RangeError
            If a name is unknown.
        """
        return replace(self, off=switched_off(self.off, terms, EVS_TERMS))

    def clean(self) -> "EvsNoise":
        """The same model without any noise or limit: thresholds are nominal, ln x has no noise, every event is read."""
        return self.without(*EVS_TERMS)

    @property
    def leak_rate_hz(self) -> float:
        """Rate of leak events that come as a Poisson process."""
        if "leak" in self.off or self.leak_drift is not None:
            return 0.0
        return self.spec.leak_rate_hz if self.spec.leak is None else self.spec.leak.rate_hz

    @property
    def leak_drift(self) -> LeakSpec | None:
        """The leak where it is a drift of the reference, else None."""
        leak = self.spec.leak
        return leak if leak is not None and leak.process == "drift" and "leak" not in self.off else None

    @property
    def comparator_noise_hz(self) -> tuple[float, float]:
        """Rates of the ON and of the OFF events of the comparators' own noise."""
        own = self.spec.comparator_noise
        return (0.0, 0.0) if own is None or "comparator_noise" in self.off else (own.on_hz, own.off_hz)

    @property
    def resets_hz(self) -> float:
        """Rate of the events that come at random times, whatever the level: each resets a pixel with a dead time."""
        return self.leak_rate_hz + sum(self.comparator_noise_hz)

    @cached_property
    def defects(self) -> PixelDefects:
        """Stuck, hot and flickering pixels of this device."""
        pixel_defects = defects_of(self.spec, self.layout, self.device_seed)
        for term in self.off.intersection(_DEFECTS):
            pixel_defects = pixel_defects.without(term)
        return pixel_defects

    @property
    def crosstalk(self) -> float:
        """Fraction of the electrons that comes from the four neighbours and not from the pixel itself."""
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
        """Events that can wait for a limited read-out: from the file, else what it reads in a tick or in 1 ms."""
        if (spec := self.spec).readout_buffer_events is not None:
            return spec.readout_buffer_events
        assert spec.readout_max_events_per_s is not None
        return max(1, round(spec.readout_max_events_per_s * (spec.tick_us or 1000) * S_PER_US))

    @property
    def is_noiseless(self) -> bool:
        """True where ln x has no temporal noise at any signal."""
        return not (np.any(self.table.light) or np.any(self.table.dark))

    # ---- per-position coefficients and per-pixel thresholds -----------------------------------------

    @property
    def dn_per_electron(self) -> NDArray[np.float64]:
        """DN of the signal reference for one electron of the window, per event position."""
        reference = self.spec.signal_reference
        return reference.k_dn_per_e * reference.t_ref_us / self.spec.window_us * np.asarray(self.signal_scale)

    @cached_property
    def table(self) -> Coefficients:
        """Coefficients of each event position for electrons of the window, float64 [position]."""
        spec = self.spec
        count = len(self.layout.spec.positions("evs"))
        entries = spec.coefficients * (count if len(spec.coefficients) == 1 else 1)
        gone = {"beta3": "shot" in self.off, "beta4": "dark_current" in self.off}
        beta = tuple(
            np.array([0.0 if gone.get(name) else getattr(entry, name) for entry in entries], dtype=np.float64)
            for name in EvsCoefficients.model_fields
        )
        return Coefficients.of(beta, self.dn_per_electron, spec.shot_law, NUMPY)

    def _threshold_map(self, nominal: float, polarity: str, stream: Stream) -> Map:
        spread = self.spec.threshold_mismatch_rel
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
    def on_device(self) -> EventPixels:
        """Parameters of the event pixels on the device, for the event stage."""
        thresholds = self.threshold_on_map, self.threshold_off_map
        return EventPixels(
            self.layout, self.table, self.spec.shot_law, thresholds, self._reference_level,
            self.photoreceptor if self.filters_noise else None, self.spec.noise_cutoff_hz,
        )  # fmt: skip

    @property
    def _reference_level(self) -> NDArray[np.float64] | None:
        """x above its baseline at the photoreceptor's reference signal, β1·signal_dn [position]; None without one."""
        reference = None if self.photoreceptor is None else self.photoreceptor.signal_dn
        return None if reference is None else self.table.slope / self.dn_per_electron * reference

    @property
    def filters_noise(self) -> bool:
        """True where the photoreceptor filters the noise as well as the signal."""
        return self.photoreceptor is not None and self.photoreceptor.filters_noise

    def noise_share(self, electrons: NDArray, position: NDArray[np.integer] | int) -> NDArray | float:
        """Part of the variance of ln x that the photoreceptor leaves, 1 where it does not filter the noise.

        Parameters
        ----------
        electrons : [..., n], noise-free electrons of the window.
        position : [n], event positions, counted in reading order of the tile.
        """
        if not self.filters_noise:
            return 1.0
        bandwidth_hz = self.spec.noise_cutoff_hz
        assert bandwidth_hz is not None
        return np.minimum(self.corner_hz(electrons, position, bandwidth_hz) / bandwidth_hz, 1.0)

    def corner_hz(self, electrons: NDArray, position: NDArray[np.integer] | int, limit_hz: float = 0.0) -> NDArray:
        """Corner of a photoreceptor that follows the light, Hz.

        Parameters
        ----------
        electrons, position : as for `noise_share`.
        limit_hz : limit of a gradual approach; 0: that of the signal, `cutoff_hz`.
        """
        spec, level = self.photoreceptor, self._reference_level
        assert spec is not None and spec.min_cutoff_hz is not None and level is not None
        kind = np.result_type(electrons, np.float32)
        k = self.table.each(lambda values: values.astype(kind)[position])
        log = np.log(formulas.voltage(k, np.maximum(electrons, kind.type(0))))
        limits_hz = spec.min_cutoff_hz, spec.cutoff_hz
        return formulas.corner_hz(k, log, level.astype(kind)[position], *limits_hz, NUMPY, spec.series_hz(limit_hz))

    # ---- the model ----------------------------------------------------------------------------------

    def log_level(self, electrons: Float) -> tuple[Float, Float]:
        """ln x and its noise variance s²/x² of every event pixel, on Dr.Jit.

        Parameters
        ----------
        electrons : Float [event pixels], noise-free electrons of the window that ends at the sample.
        """
        return self.on_device.log_level(electrons)

    def noise_equivalent_e(self, electrons: NDArray, position: NDArray[np.integer]) -> NDArray:
        """The change of a window's electrons that equals one standard deviation of ln x, or θ/20 if that is more.

        Deviations of the clean signal are compared with it. Without the floor, a sensor with (nearly) no
        noise would need an impossible accuracy. θ/20 moves no threshold crossing by more than a twentieth.

        Parameters
        ----------
        electrons : [..., n], noise-free electrons of the window; float32 is kept.
        position : [n], event positions, counted in reading order of the tile.

        Returns
        -------
        [..., n], electrons: the larger of s and θ/20·x, over the slope dx/dN.
        """
        kind = np.result_type(electrons, np.float32)
        # coefficients that all pixels share are not spread over the pixels
        k = self.table.each(lambda values: values.astype(kind)[slice(None) if values.size == 1 else position])
        theta = min(self.spec.contrast_threshold_on, self.spec.contrast_threshold_off)
        counted = np.maximum(electrons, kind.type(0))
        least = kind.type(LEAST_NOISE_THETA * theta)
        share = self.noise_share(electrons, position)
        return formulas.noise_equivalent(k, counted, least, self.spec.shot_law, NUMPY, share)

    def log_signal(self, electrons_per_s: NDArray[np.float64], event_pixel: NDArray[np.integer]) -> NDArray[np.float64]:
        """ln x, noise-free, of a flux.

        Parameters
        ----------
        electrons_per_s : [..., n], e⁻/s.
        event_pixel : [n], places on the event grid, row-major.
        """
        where = self.layout.evs_position.ravel()[event_pixel]
        k = self.table.each(lambda values: values[where])
        electrons = np.maximum(electrons_per_s, 0.0) * (self.spec.window_us * S_PER_US)
        return formulas.log_level(k, electrons, self.spec.shot_law, NUMPY)[0]

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
        p_on, p_off : as in `hesim_render.pixels.evs.formulas`. Leak events are a process of their own, not included.

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
            where: NDArray[np.uint8] | int = self.layout.evs_position
            theta_on, theta_off = self.threshold_on_map, self.threshold_off_map
        else:
            where = self._position_number(position)
            theta_on, theta_off = self.spec.contrast_threshold_on, self.spec.contrast_threshold_off
        k = self.table.each(lambda values: values[where])
        (log_0, variance_0), (log_1, variance_1) = (
            formulas.log_level(k, e, self.spec.shot_law, NUMPY) for e in levels
        )  # fmt: skip
        sigma = np.sqrt(variance_0 + variance_1)
        return formulas.event_probabilities(theta_on, theta_off, log_1 - log_0, sigma)
