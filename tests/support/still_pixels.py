"""Event pixels written in NumPy alone: still light, a target that moves by, pixels that fire at random.

Nothing of the package's simulator is used: a comparator with two thresholds of its own in each pixel, noise through two
equal poles, a drift of the reference, light whose logarithm rises and falls in straight lines.
"""

import numpy as np
from scipy.linalg import expm

from hesim_render.pixels.evs.events import EVENT_DTYPE


def _events(found, cols):
    t_us, pixel, polarity = (np.concatenate(values) for values in zip(*found, strict=True))
    order = np.argsort(t_us, kind="stable")
    events = np.empty(t_us.size, EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us[order], polarity[order]
    events["y"], events["x"] = np.divmod(pixel[order], cols)
    return events


def still_events(rng, theta_on, theta_off, sigma, drift, *, cutoff_hz, seconds, shape, nodes=16):
    """Events of pixels with own thresholds [pixel], noise of ln x, and drift [pixel] in ln units a second.

    The pixels have run for a while before the first µs that counts. The corner of the noise may be one for each;
    the fastest pixel has so many `nodes` in a period.
    """
    cutoff_hz = np.asarray(cutoff_hz, float)
    pole = 2 * np.pi * cutoff_hz / np.sqrt(np.sqrt(2) - 1)
    dt = 1 / (nodes * cutoff_hz.max())
    h = pole * dt
    # what is left of both poles after a step, and the triangle of the new noise
    keep = np.exp(-h) * np.array([1 + h, h, -h, 1 - h])
    first = np.sqrt(1 - keep[0] ** 2 - keep[1] ** 2)
    mixed = -(keep[0] * keep[2] + keep[1] * keep[3]) / first
    second = np.sqrt(1 - keep[2] ** 2 - keep[3] ** 2 - mixed**2)
    size = theta_on.size
    state = rng.standard_normal((2, size))
    level = sigma * state[0]
    reference = level - theta_on * rng.random(size)
    found = [(np.empty(0, int), np.empty(0, int), np.empty(0, int))]
    warm = round(30 / cutoff_hz.min() / dt)
    for k in range(-warm, round(seconds / dt)):
        z = rng.standard_normal(state.shape)
        state = np.stack([
            keep[0] * state[0] + keep[1] * state[1] + first * z[0],
            keep[2] * state[0] + keep[3] * state[1] + mixed * z[0] + second * z[1],
        ])  # fmt: skip
        before, level = level, sigma * state[0]
        reference -= drift * dt
        on, off = level - reference >= theta_on, level - reference <= -theta_off
        some = np.flatnonzero(on | off)
        goal = np.where(on[some], reference[some] + theta_on[some], reference[some] - theta_off[some])
        way = level[some] - before[some]
        part = np.clip((goal - before[some]) / np.where(way == 0, np.inf, way), 0, 1)
        reference[some] = goal
        if k >= 0:
            found.append((np.ceil((k + part) * dt * 1e6).astype(int) + 1, some, np.where(on[some], 1, -1)))
    return _events(found, shape[1])


def reset_events(rng, theta, *, cutoff_hz, dead_us, seconds, shape, nodes=24):
    """Events of pixels in still light that start anew after their dead time; thresholds in units of their noise.

    A pixel compares with the level that it had at the end of its dead time, so that noise comes to a threshold late.
    """
    pole = 2 * np.pi * cutoff_hz / np.sqrt(np.sqrt(2) - 1)
    dt, dead_s, size = 1 / (nodes * cutoff_hz), 1e-6 * dead_us, shape[0] * shape[1]
    h = pole * dt
    move = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    fresh = np.linalg.cholesky(np.eye(2) - move @ move.T)
    state = rng.standard_normal((2, size))
    reference, free_s, found = state[0].copy(), np.zeros(size), []
    for k in range(1, round(seconds / dt)):
        before, state = state[0], move @ state + fresh @ rng.standard_normal(state.shape)
        from_s, to_s = (k - 1) * dt, k * dt
        begins = (free_s > from_s) & (free_s <= to_s)
        place = np.where(begins, (free_s - from_s) / dt, 0.0)
        reference = np.where(begins, before + place * (state[0] - before), reference)
        some = np.flatnonzero((np.abs(state[0] - reference) >= theta) & (free_s <= to_s))
        sign = np.sign(state[0] - reference)[some].astype(int)
        goal = reference[some] + sign * theta
        part = np.clip((goal - before[some]) / (state[0] - before)[some], place[some], 1)
        free_s[some] = from_s + part * dt + dead_s
        found.append((np.ceil((from_s + part * dt) * 1e6).astype(int), some, sign))
    return _events(found, shape[1])


def target_events(rng, theta_on, theta_off, rise, *, hz, cycles, shape, sigma=0.0, drift=0.0):
    """Events of pixels that see the light rise and fall by `rise` (ln) `hz` times a second, each with its own phase."""
    steps, size = 1000, theta_on.size
    phase = rng.integers(0, steps, size) / steps  # so that the turns are among the steps
    reference = rng.random(size) * rise
    found = [(np.empty(0, int), np.empty(0, int), np.empty(0, int))]
    for k in range(-2 * steps, cycles * steps):
        at = (k / steps + phase) % 1
        level = rise * (1 - np.abs(2 * at - 1)) + sigma * rng.standard_normal(size)
        reference -= drift / steps / hz
        for sign, theta in ((1, theta_on), (-1, theta_off)):
            count = np.maximum(np.floor(sign * (level - reference) / theta), 0).astype(int)
            reference += sign * count * theta
            some = np.flatnonzero(count)
            if k >= 0 and some.size:
                pixel = np.repeat(some, count[some])
                found.append((np.full(pixel.size, round((k + 1) / steps / hz * 1e6)), pixel, np.full(pixel.size, sign)))
    return _events(found, shape[1])


def two_poles(cutoff_hz, apart):
    """Two poles, the second so many times the first, together −3 dB at a corner: their geometric mean and sum, 1/s."""
    both = 1 + apart**-2
    first = 2 * np.pi * cutoff_hz * np.sqrt(0.5 * both + np.sqrt(0.25 * both**2 + apart**-2))
    return first * np.sqrt(apart), first * (1 + apart)


def noisy_target_events(
    rng, theta_on, theta_off, rise, *, hz, rests, cycles, shape, sigma, cutoff_hz, drift=0.0, light=None, apart=1.0
):
    """Events of pixels that see bars pass by: the logarithm of the light rises, rests, falls and rests.

    Parameters
    ----------
    rests : parts of a cycle for which the light rests at its top and at its bottom; it rises and falls equally long.
    sigma : of the noise in the dark and in the bright light; it has two poles of corner `cutoff_hz`.
    drift : of the reference in ln units a second; a pair grows with the light from that of the dark to the bright one.
    light : part of the rise [pixel] at a place of the cycle, in place of that of `rests` at random phases.
    apart : the second pole of the noise over the first.
    """
    mean, both = two_poles(cutoff_hz, apart)
    steps, size = max(round(16 * mean * np.sqrt(np.sqrt(2) - 1) / (2 * np.pi * hz)), 200), theta_on.size
    dt = 1 / (hz * steps)
    # level and velocity over `mean`, each of variance 1
    move = expm(np.array([[0, mean], [-mean, -both]]) * dt)
    fresh = np.linalg.cholesky(np.eye(2) - move @ move.T)
    in_dark, in_bright = np.broadcast_to(drift, 2)
    ramp = (1 - sum(rests)) / 2
    turns = np.cumsum([0.0, ramp, rests[0], ramp, rests[1]])
    phase, state = rng.random(size), rng.standard_normal((2, size))
    # any place of the thresholds' ladder is as likely
    reference, before = rise / 2 + theta_on * rng.random(size), np.full(size, rise / 2)
    found = [(np.empty(0, int), np.empty(0, int), np.empty(0, int))]
    for k in range(-2 * steps, cycles * steps):
        state = move @ state + fresh @ rng.standard_normal(state.shape)
        place = (k / steps + phase) % 1 if light is None else k / steps
        part = np.interp(place, turns, [0.0, 1.0, 1.0, 0.0, 0.0]) if light is None else light(place)
        level = rise * part + (sigma[0] + (sigma[1] - sigma[0]) * part) * state[0]
        reference = reference - (in_dark + (in_bright - in_dark) * np.expm1(rise * part) / np.expm1(rise)) * dt
        for sign, theta in ((1, theta_on), (-1, theta_off)):
            count = np.maximum(np.floor(sign * (level - reference) / theta), 0).astype(int)
            some = np.flatnonzero(count)
            if k >= 0 and some.size:
                pixel = np.repeat(some, count[some])
                number = np.arange(1, pixel.size + 1) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
                goal = reference[pixel] + sign * number * theta[pixel]
                way = level[pixel] - before[pixel]
                place = np.clip((goal - before[pixel]) / np.where(way == 0, np.inf, way), 0, 1)
                found.append((np.ceil((k + place) * dt * 1e6).astype(int) + 1, pixel, np.full(pixel.size, sign)))
            reference = reference + sign * count * theta
        before = level
    return _events(found, shape[1])


def random_events(rng, rate_hz, dead_us, *, seconds, shape):
    """Events of pixels [pixel] that fire at random after a dead time of any real number of µs."""
    found = [(np.empty(0, int), np.empty(0, int), np.empty(0, int))]
    t_us, pixel = rng.exponential(1e6 / rate_hz), np.arange(rate_hz.size)
    while pixel.size:
        keep = t_us < seconds * 1e6
        t_us, pixel = t_us[keep], pixel[keep]
        found.append((np.ceil(t_us).astype(int), pixel, rng.choice([-1, 1], pixel.size)))
        t_us = t_us + dead_us + rng.exponential(1e6 / rate_hz[pixel])
    return _events(found, shape[1])


def even_events(rng, rate_hz, gamma, *, seconds, shape):
    """ON events of pixels [pixel] with intervals of a gamma law of that shape: even ones, or random ones with 1."""
    count = round(1.6 * rate_hz.max() * seconds) + 60
    t = np.cumsum(rng.gamma(gamma, 1 / gamma, (count, rate_hz.size)), axis=0) / rate_hz - 20 / rate_hz
    kept = (t > 0) & (t < seconds)
    pixel = np.broadcast_to(np.arange(rate_hz.size), t.shape)[kept]
    return _events([(np.ceil(t[kept] * 1e6).astype(int), pixel, np.ones(pixel.size, int))], shape[1])
