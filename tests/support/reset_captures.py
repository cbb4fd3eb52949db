"""Captures of an asynchronous sensor, in NumPy alone: trials after a reset of pixels written out here once more."""

from dataclasses import dataclass

import numpy as np

NODES = 16
_FORM = "bit_depth: 10\ntile_rows: 1\ntile_cols: 1\nsignal_reference: {k: 0.036, t_ref_us: 10000}\n"


@dataclass
class Pixels:
    """What the pixels are like; r, shot and dark are β1/β2, β3/β2 and β4/β2."""

    theta_on: float = 0.2
    theta_off: float = 0.22
    mismatch: float = 0.15
    r: float = 0.2
    shot: float = 0.03
    dark: float = 0.04
    cutoff_hz: float = 300.0
    leak_hz: float = 0.05
    law: str = "sqrt"

    def sigma(self, light):
        power = light if self.law == "sqrt" else light**2
        return np.sqrt(self.shot**2 * power + self.dark**2) / (1 + self.r * light)

    def step(self, light, contrast):
        return np.log((1 + self.r * light * np.exp(contrast)) / (1 + self.r * light))


def unit_noise(count, length_s, cutoff_hz, rng, nodes=NODES):
    """Node values [node, path] of two-pole noise, exact at nodes, and the part of a segment at which time is 0.

    Straight lines between nodes have a variance of 1 on the average.
    """
    h = 2 * np.pi / np.sqrt(np.sqrt(2.0) - 1) / nodes
    step = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    fresh = np.linalg.cholesky(np.eye(2) - step @ step.T)
    state = rng.standard_normal((2, count))
    values = [state[0]]
    for _ in range(int(np.ceil(length_s * cutoff_hz * nodes)) + 1):
        state = step @ state + fresh @ rng.standard_normal((2, count))
        values.append(state[0])
    amplitude = np.sqrt(3 / (2 + (1 + h) * np.exp(-h)))
    return amplitude * np.array(values), rng.random(count)


def trials(pixels, on, off, light, contrast, settle_s, edges_s, count, rng, noise=unit_noise):
    """calm [pixel], on and off [bin, pixel] of `count` trials of pixels with thresholds `on` and `off`."""
    on, off = np.repeat(on, count), np.repeat(off, count)
    edges = np.asarray(edges_s)
    values, phase = noise(on.size, settle_s + edges[-1], pixels.cutoff_hz, rng)
    period = 1 / (NODES * pixels.cutoff_hz)
    before, after = pixels.sigma(light), pixels.sigma(light * np.exp(contrast))
    step = pixels.step(light, contrast)

    def at(t_s):
        place = phase + t_s / period
        k = np.minimum(place.astype(int), len(values) - 2)
        some = np.arange(on.size)
        return values[k, some] + (values[k + 1, some] - values[k, some]) * (place - k)

    reset = before * at(0.0)
    first_on, first_off = np.full((2, on.size), np.inf)

    def look(t_s, level):
        nonlocal first_on, first_off
        first_on = np.where((level >= on) & (t_s < first_on), t_s, first_on)
        first_off = np.where((level <= -off) & (t_s < first_off), t_s, first_off)

    for k in range(1, len(values)):
        t_s = (k - phase) * period
        stepped = t_s > settle_s
        level = np.where(stepped, step + after * values[k], before * values[k]) - reset
        look(np.where((t_s > 0) & (t_s <= settle_s + edges[-1]), t_s, np.inf), level)
    look(np.full(on.size, settle_s), before * at(settle_s) - reset)
    if contrast:
        look(np.full(on.size, settle_s + 1e-9), step + after * at(settle_s) - reset)
    for edge in edges[1:]:
        look(np.full(on.size, settle_s + edge), step + after * at(settle_s + edge) - reset)
    if pixels.leak_hz:
        first_on = np.minimum(first_on, rng.exponential(1 / pixels.leak_hz, on.size))
    first = np.minimum(first_on, first_off)
    calm = first > settle_s
    place = np.where(
        calm & (first <= settle_s + edges[-1] + 1e-12), np.searchsorted(edges, first - settle_s - 1e-12) - 1, -1
    )
    found = [
        [np.sum(((place == j) & which).reshape(-1, count), axis=1) for j in range(edges.size - 1)]
        for which in (first_on < first_off, first_off <= first_on)
    ]
    return np.sum(calm.reshape(-1, count), axis=1), *np.array(found)


def write(folder, pixels, rng, shape=(32, 32), count=12, steps=8, change=None, noise=unit_noise, contrast_scale=1.0):
    """A capture set; returns the thresholds of the pixels. `change(name, calm, on, off)` spoils counts in place."""
    number = shape[0] * shape[1]
    on, off = (
        theta * (1 + pixels.mismatch * rng.standard_normal(number)) for theta in (pixels.theta_on, pixels.theta_off)
    )
    dn, period = 1 / pixels.r, 1 / pixels.cutoff_hz
    kinds = []
    for light in (80 * dn, 3 * dn):
        for sign, theta in ((1, pixels.theta_on), (-1, pixels.theta_off)):
            wanted = sign * theta * np.linspace(0.3, 1.8, steps)
            kinds += [(light, np.log(((1 + pixels.r * light) * np.exp(s) - 1) / (pixels.r * light))) for s in wanted]
    sets = {
        "evs_s_curve": (kinds, np.array([0, 0.03, 1.25]) * period),
        "evs_noise_rate": ([(0.0, 0.0), (2 * dn, 0.0), (200 * dn, 0.0)], np.array([0, 20.0]) * period),
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "capture.yaml").write_text(_FORM)
    for name, (plan, edges) in sets.items():
        found = [trials(pixels, on, off, i, c, 0.75 * period, edges, count, rng, noise) for i, c in plan]
        calm, on_, off_ = (np.array(v) for v in zip(*found, strict=True))
        if change is not None:
            change(name, calm, on_, off_)
        np.savez(
            folder / f"{name}.npz",
            signal_dn=np.array([i for i, _ in plan]),
            contrast=contrast_scale * np.array([c for _, c in plan]),
            settle_us=np.array(0.75e6 * period),
            edges_us=edges * 1e6,
            n_calm=calm.reshape(-1, *shape).astype(np.uint16),
            n_on=on_.reshape(*on_.shape[:2], *shape).astype(np.uint16),
            n_off=off_.reshape(*off_.shape[:2], *shape).astype(np.uint16),
        )
    return on, off


def parts_of(data, parts, trials, trial_s):
    """Arrays as if the last light had had `parts` times `trials` trials, with events evenly over the parts."""
    calm, on, off = (data[name][-1].astype(int) for name in ("n_calm", "n_on", "n_off"))
    silent = calm - on.sum(axis=0) - off.sum(axis=0)
    disturbed = parts * trials - silent
    each = np.stack([(disturbed + k) // parts for k in range(parts)])
    return {"bright_parts": each, "part_trials": np.array(trials), "part_us": np.array(trials * trial_s * 1e6)}
