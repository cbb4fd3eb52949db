"""Reference values of the audit: pairs traced again, with a stream of random numbers of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.error_target import NoiseUnit
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows


def traced_again(
    tracer: PairTracer,
    index: NDArray[np.uint32],
    begin_us: NDArray[np.float64],
    end_us: NDArray[np.float64],
    unit: NoiseUnit,
    quality: float,
    gain: Gain,
    tuning: Tuning,
) -> NDArray[np.float64]:
    """Mean Φ of each listed pixel in its own window, with random numbers that only the audit uses.

    Parameters
    ----------
    tracer : the renderer.
    index : [n], numbers on the full sensor.
    begin_us, end_us : [n], the windows, µs.
    unit : noise unit of these pixels.
    quality : wanted error in noise units.
    gain : error law of stratified rays.
    tuning : constants.

    Returns
    -------
    [n], e⁻/s.
    """
    span, window = np.unique(np.stack([begin_us, end_us]), axis=1, return_inverse=True)
    windows, window = Windows(span[0], span[1]), window.ravel()
    pilot = tracer.pilot(index, window, windows, tuning.audit_pilot_rays, 1.0, Stream.AUDIT_PILOT)
    lit = (pilot.lit_scatter <= pilot.hidden_scatter) & (2 * pilot.lit >= pilot.unshadowed)
    flux = np.where(lit, pilot.lit, pilot.hidden)
    scatter = np.where(lit, pilot.lit_scatter, pilot.hidden_scatter)
    wanted_error = np.float32(quality) * unit(flux)
    wanted = np.maximum(
        gain.rays(scatter / wanted_error), pilot.unshadowed / (np.float32(tuning.audit_ray_weight) * wanted_error)
    )
    rays = 1 << np.ceil(np.log2(np.clip(wanted, tuning.least_audit_rays, tuning.most_rays))).astype(np.int64)
    times = np.clip(np.ceil((gain.error(scatter, rays) / wanted_error) ** 2), 1, tuning.most_audit_times)
    total = np.zeros(index.size)
    for repeat in range(int(times.max())):
        more = np.flatnonzero(times > repeat)
        got = tracer.trace(index[more], window[more], windows, rays[more], lit[more], Stream.AUDIT, repeat=repeat)
        total[more] += got.mean
    return total / times
