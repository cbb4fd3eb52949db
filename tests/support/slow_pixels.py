"""Event pixels that follow modulated light step by step, in NumPy: a low-pass, a memory of the last event, a dead time.

Nothing of the package's simulator is used. Pixels are never reset.
"""

import numpy as np

from hesim_render.pixels.evs.events import EVENT_DTYPE


def events_of(log_light, step_us, own, *, corner_hz=None, dead_us=0.0, noise=0.0, background_hz=0.0, cols, rng):
    """Events of pixels in light that all see.

    Parameters
    ----------
    log_light : [step], logarithm of the light.
    step_us : time of a step, µs, a whole number.
    own : [polarity, pixel], thresholds.
    corner_hz : of a low-pass of ln L.
    noise : standard deviation of the level at which a pixel fires, drawn anew after each event.
    background_hz : ON events of a pixel and second that leave its reference alone.
    """
    pixels = own.shape[1]
    level = log_light[0]
    reference = level + 0.4 * own.min() * rng.uniform(-1, 1, pixels)
    ready_us, waits = np.zeros(pixels), np.zeros(pixels, bool)
    limit = own + noise * rng.standard_normal(own.shape)
    keep = 0.0 if corner_hz is None else np.exp(-2 * np.pi * corner_hz * step_us * 1e-6)
    times, places, signs = [], [], []
    for k, light in enumerate(log_light):
        level = light + (level - light) * keep
        now_us = (k + 1) * step_us
        released = waits & (ready_us <= now_us)
        reference[released], waits[released] = level, False
        for polarity, sign in enumerate((1, -1)):
            hit = np.flatnonzero(~waits & (sign * (level - reference) >= limit[polarity]))
            times.append(np.full(hit.size, now_us))
            places.append(hit)
            signs.append(np.full(hit.size, sign))
            if dead_us:
                ready_us[hit], waits[hit] = now_us + dead_us, True
            else:
                reference[hit] += sign * limit[polarity, hit]
            limit[:, hit] = own[:, hit] + noise * rng.standard_normal((2, hit.size))
    extra = rng.poisson(background_hz * len(log_light) * step_us * 1e-6, pixels)
    times.append(rng.integers(1, len(log_light) * step_us, extra.sum()))
    places.append(np.repeat(np.arange(pixels), extra))
    signs.append(np.ones(extra.sum(), int))
    t_us, pixel, sign = (np.concatenate(each) for each in (times, places, signs))
    order = np.argsort(t_us, kind="stable")
    events = np.zeros(order.size, EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us[order], sign[order]
    events["x"], events["y"] = pixel[order] % cols, pixel[order] // cols
    return events
