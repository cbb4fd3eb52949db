"""Event pixels with a tick: each compares its level with that of the previous sample."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.rng import Stream, normal_pair, philox
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs.defects import DefectEvents
from hesim_render.pixels.evs.events import Origin, events_at, no_events
from hesim_render.pixels.evs.formulas import leak_probability
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.photoreceptor import Photoreceptor


class PreviousSample:
    """Compares successive samples."""

    STATE = ("_t_us", "_level", "_variance", "_photoreceptor")

    def __init__(self, noise: EvsNoise, seed: int, defects: DefectEvents | None) -> None:
        self._noise, self._seed, self._defects = noise, seed, defects
        self._cols = noise.layout.evs_shape[1]
        self._independent = noise.spec.noise_mode == "independent"
        self._photoreceptor = Photoreceptor(noise) if noise.photoreceptor else None
        self._t_us = 0
        self._level: Float = None  # ln x, with the noise of its instant where that is shared
        self._variance: Float = None  # s²/x² of the last sample, where noise is independent

    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        types = jit()
        level, variance = self._noise.log_level(electrons)
        if self._photoreceptor:
            level = self._photoreceptor.follow(level, t_us)
        # four random words for each pixel and sample: two for the noise, one for a leak event, one for the comparators'
        # own noise
        word = philox(self._seed, Stream.EVS, self._noise.on_device.key, t_us).next_uint32x4()
        deviate = normal_pair(word[0], word[1])[0]
        if not self._independent:
            # shared noise: the noise of a sample is in both of its comparisons
            level = dr.fma(dr.sqrt(variance), deviate, level)
        if self._level is None:
            self._keep(level, variance, t_us)
            return no_events()
        change = level - self._level
        if self._independent:
            # independent noise: each comparison draws that of both samples anew
            change = dr.fma(dr.sqrt(variance + self._variance), deviate, change)
        theta_on, theta_off = self._noise.on_device.thresholds
        on, off = change > theta_on, change < -theta_off
        polarity = dr.select(on, types.Int8(1), dr.select(off, types.Int8(-1), types.Int8(0)))
        if self._noise.leak_rate_hz > 0:
            probability = leak_probability(self._noise.leak_rate_hz, (t_us - self._t_us) * S_PER_US)
            # a whole number of 2³² as the bound, opaque so that no rate is written into the kernel
            leaks = word[2] < dr.opaque(types.UInt32, min(round(probability * 2**32), 2**32 - 1))
            polarity = dr.select(~on & ~off & leaks, types.Int8(Origin.LEAK), polarity)
        if self._noise.resets_hz > self._noise.leak_rate_hz:
            # ON events of the comparators' noise take the lowest numbers of a random word, OFF events the highest
            chances = [leak_probability(hz, (t_us - self._t_us) * S_PER_US) for hz in self._noise.comparator_noise_hz]
            below, above = (dr.opaque(types.UInt32, min(round(p * 2**32), 2**32 - 1)) for p in chances)
            own = dr.select(word[3] < below, types.Int8(1), dr.select(~word[3] < above, types.Int8(-1), types.Int8(0)))
            polarity = dr.select(polarity == 0, own * types.Int8(Origin.COMPARATOR_NOISE), polarity)
        begin_us = self._t_us
        dr.schedule(polarity)
        self._keep(level, variance, t_us)
        result = polarity.numpy()
        if self._defects is not None:
            result = self._defects.at_tick(result, begin_us, t_us)
        pixel = np.flatnonzero(result != 0)  # in row-major order
        return events_at(t_us, pixel, result[pixel], self._cols)

    def _keep(self, level: Float, variance: Float, t_us: int) -> None:
        self._t_us, self._level = t_us, level
        if self._independent:
            self._variance = variance
            dr.schedule(variance)
        dr.eval(self._level)
