"""Frames and events that break what the noise models suppose, written out in NumPy alone; and unbroken ones."""

import capture_sets
import numpy as np
from scipy import stats

DARK_S = LIT_S = (1e-3, 2e-3, 5e-3, 10e-3, 20e-3)
_GAIN, _READ_DN, _DARK_DN_PER_S, _BLACK = 0.25, 1.5, 40.0, 64.0


def frames(
    folder, *, size=64, count=32, row_noise=0.0, black_drift=0.0, drift_over="session", light_ramp=0.0,
    ramp_over="session", cubic=0.0, flat=False, gain=_GAIN, brightest=40_000.0, seed=5, poisson=False, full_scale=1023,
    down=False, restless=0.0,
):  # fmt: skip
    """A ramp of light through five exposures, Var = σ² + K (I + D t) + cubic I³, in DN.

    Parameters
    ----------
    row_noise : DN, of each row in each frame anew. black_drift : DN from first to last frame of `drift_over`: the
        ``session`` (dark, then lit), or each ``exposure``. light_ramp : relative, likewise. cubic : DN⁻¹.
    brightest : DN/s. down : the ramp goes from row to row, not from column to column.
    restless : part of the pixels with 1.2 times the noise.
    """
    rng = np.random.default_rng(seed)
    place = np.mgrid[0:size, 0:size][0 if down else 1] / (size - 1)
    rate = brightest * (np.ones((size, size)) if flat else 0.02 + 0.98 * place)
    offset = _BLACK + 0.6 * rng.standard_normal((size, size)) + 0.8 * rng.standard_normal(size)[:, None]
    wide = np.where(rng.random((size, size)) < restless, 1.2, 1.0) if restless else 1.0
    total, done = count * (len(DARK_S) + len(LIT_S)), 0
    capture_sets.write_description(folder)
    for name, exposures_s, light in (("aps_dark", DARK_S, 0.0), ("aps_lit", LIT_S, 1.0)):
        stack = np.empty((len(exposures_s), count, size, size), np.uint16)
        for k, t in enumerate(exposures_s):
            for f in range(count):
                black = black_drift * (done / total if drift_over == "session" else f / count)
                part = (done - total / 2) / (total / 2) if ramp_over == "session" else f / count
                signal = light * rate * t * (1 + light_ramp * part)
                clean = signal + _DARK_DN_PER_S * t
                if poisson:
                    value = gain * rng.poisson(clean / gain) + _READ_DN * rng.standard_normal((size, size))
                else:
                    variance = _READ_DN**2 + gain * clean + cubic * signal**3
                    value = clean + wide * np.sqrt(variance) * rng.standard_normal((size, size))
                value += row_noise * rng.standard_normal(size)[:, None] + black
                stack[k, f] = np.clip(np.rint(offset + value), 0, full_scale)
                done += 1
        capture_sets.save_frames(folder, name, stack, exposures_s)


def events(
    folder, *, size=96, trials=20_000, step_trials=200, noise="normal", freedom=5, floor=0.0, ceiling=1.0, leak=0.0,
    rho=0.0, mismatch=0.03, a=29.0, b=6240.0, c=0.03, theta=0.012, theta_v=0.75e-3, brightest=40.0, steps=True,
    steps_at=20.0, dark=True, seed=3, **keys,
):  # fmt: skip
    """Static counts of a ramp and of the dark, and S-curves, of thresholds θ (1 ∓ ρ) that spread by `mismatch`.

    Parameters
    ----------
    noise : law of the noise, ``normal`` or ``t`` of `freedom` and unit variance. floor : chance of an event that
        comes by itself, in either polarity. ceiling : part of the events that arrive. leak : ON events per trial.
    """
    rng = np.random.default_rng(seed)
    if noise == "normal":
        survival = stats.norm.sf
    else:
        wide = np.sqrt(freedom / (freedom - 2))

        def survival(x):
            return stats.t.sf(np.asarray(x) * wide, freedom)

    place = np.mgrid[0:size, 0:size][1] / (size - 1)
    scale = 1 + mismatch * rng.standard_normal((2, size, size))

    def draw(light, step, n):
        u = theta_v * (a * light + b) / np.sqrt(2 * (1 + (c * light) ** 2))  # θ/σ
        p = ceiling * survival(u * (scale[0] * (1 - rho) - step / theta)) + floor + leak
        q = ceiling * survival(u * (scale[1] * (1 + rho) + step / theta)) + floor
        on = rng.binomial(n, np.minimum(p, 1.0))
        return on, rng.binomial(n - on, np.clip(q / np.maximum(1 - p, 1e-12), 0, 1))

    capture_sets.write_description(folder, theta_hardware_v=theta_v, contrast_of="voltage", **keys)
    signal = 0.5 + brightest * place
    on, off = draw(signal, 0.0, trials)
    arrays = {"signal_dn": signal, "n_on": on, "n_off": off, "n_trials": trials}
    if dark:
        arrays["dark_n_on"], arrays["dark_n_off"] = draw(np.zeros((size, size)), 0.0, trials)
    np.savez(folder / "evs_static.npz", **arrays)
    if steps:
        contrast = theta * np.linspace(-2, 2, 21)
        counts = [draw(np.full((size, size), steps_at), step, step_trials) for step in contrast]
        np.savez(
            folder / "evs_steps.npz", contrast=contrast, signal_dn=steps_at, n_trials=step_trials,
            n_on=np.stack([on for on, _ in counts]), n_off=np.stack([off for _, off in counts]),
        )  # fmt: skip
