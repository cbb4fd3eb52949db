#!/usr/bin/env python3
"""Make a capture set from a known noise model, in plain NumPy and SciPy, without hesim_render.

An independent generator: written before the calibration and apart from it, and kept as it was written, so
that a test that recovers its truth is not circular. Only its layout was changed.

    python make_captures.py OUT [--seed 1] [--size 256] [--frames 64] [--mismatch 0.03]

Writes the files of a capture set plus truth.json and truth_maps.npz.
Units: DN, seconds, ln units. The formulas are written out here on purpose: a calibration
that recovers the truth from these files does not owe it to a formula it shares with them.
"""

import argparse
import json
import os

import numpy as np
from scipy.special import ndtr

arg = argparse.ArgumentParser()
arg.add_argument("out")
arg.add_argument("--seed", type=int, default=1)
arg.add_argument("--size", type=int, default=256)
arg.add_argument("--frames", type=int, default=64)
arg.add_argument("--mismatch", type=float, default=0.0, help="relative std of the per-pixel event threshold")
arg = arg.parse_args()
os.makedirs(arg.out, exist_ok=True)
rng = np.random.default_rng(arg.seed)
S, FULL = arg.size - arg.size % 4, 1023
t_s = np.array([1, 2, 5, 10, 20]) * 1e-3

# ---- APS: 16 variance polynomials over 1, I, t, I^2, I t, t^2 (I in DN of light, t in s)
base = np.array([2.2, 0.26, 52.0, 1.2e-5, 1.0, 2.1e3])
beta = base * rng.uniform(0.7, 1.3, (4, 4, 6))
beta[..., 4] *= rng.choice([-1, 1], (4, 4))
row = rng.normal(0, 0.8, S)
blc = 64 + rng.normal(0, 0.6, (S, S))
n_dp = np.abs(rng.normal(0, 10.0, (S, S)))  # DN/s
hot = rng.random((S, S)) < 0.003
n_dp[hot] = rng.uniform(200, 5000, hot.sum())
yy, xx = np.mgrid[0:S, 0:S]
patch = np.linspace(0.02, 1, 24)[rng.permutation(24)].reshape(4, 6)
ramp = 0.02 + 0.98 * (0.85 * xx / (S - 1) + 0.15 * (0.5 + 0.5 * np.sin(2 * np.pi * yy / 64)))
scene = np.where(yy < S // 2, patch[np.minimum(yy * 8 // S, 3), np.minimum(xx * 6 // S, 5)], ramp)
response = np.array([[1, 1, 0.7, 0.7], [1, 1, 0.7, 0.7], [0.6, 0.6, 1, 1], [0.6, 0.6, 1, 1]])
slope = 41e3 * scene * np.tile(response * rng.uniform(0.97, 1.03, (4, 4)), (S // 4, S // 4))  # DN/s
b = np.tile(beta, (S // 4, S // 4, 1))


def variance(i, t):
    return b[..., 0] + b[..., 1] * i + b[..., 2] * t + b[..., 3] * i * i + b[..., 4] * i * t + b[..., 5] * t * t


def shoot(lit):
    frames = np.empty((len(t_s), arg.frames, S, S), np.uint16)
    for k, t in enumerate(t_s):
        i = slope * t if lit else np.zeros((S, S))
        v = variance(i, t)
        assert v.min() > 0
        mean, std = i + t * n_dp + row[:, None] + blc, np.sqrt(v)
        for f in range(arg.frames):
            frames[k, f] = np.clip(np.rint(mean + std * rng.standard_normal((S, S))), 0, FULL)
    return frames


exposures_us = np.rint(t_s * 1e6).astype(np.int64)
np.savez(f"{arg.out}/aps_dark.npz", frames=shoot(False), exposures_us=exposures_us)
np.savez(f"{arg.out}/aps_lit.npz", frames=shoot(True), exposures_us=exposures_us)

# ---- EVS: sigma_n = sqrt(2((b3 I)^2 + b4^2 + 2 b5 b3 I b4)) / (b1 I + b2), theta = b0 Theta, one draw a trial
THETA, N = 0.75e-3, 20000
u = rng.uniform(0.85, 1.15, 5)
be = np.array([8.0 * u[0], 0.0728 * u[1], 15.6 * u[2] / u[0], 5.87e-4 * u[3], 0.02, rng.uniform(-0.15, 0.2)])
theta = be[0] * THETA
th = theta * (1 + arg.mismatch * np.random.default_rng(arg.seed + 1).standard_normal((S, S)))
bad = rng.random((S, S)) < 0.005
offset = np.where(bad, rng.choice([-1, 1], (S, S)) * rng.uniform(0.3, 0.8, (S, S)), 0.0) * theta
signal = 0.5 + 40 * np.clip(0.9 * xx / (S - 1) + 0.1 * rng.random((S, S)), 0, 1)  # DN


def draw(i, contrast=0.0, trials=N):
    v = be[1] * i + be[2]
    s = np.sqrt(2 * ((be[3] * i) ** 2 + be[4] ** 2 + 2 * be[5] * be[3] * i * be[4])) / v
    p, q = ndtr(-(th - contrast - offset) / s), ndtr(-(th + contrast + offset) / s)
    on = rng.binomial(trials, p)
    off = rng.binomial(trials - on, np.clip(q / np.maximum(1 - p, 1e-12), 0, 1))
    return on.astype(np.int32), off.astype(np.int32)


on, off = draw(signal)
don, doff = draw(np.zeros((S, S)))
np.savez(f"{arg.out}/evs_static.npz", signal_dn=signal, n_on=on, n_off=off, n_trials=N, dark_n_on=don, dark_n_off=doff)
contrast = theta * np.linspace(-2, 2, 21)
steps = [draw(np.full((S, S), 20.0), c, 200) for c in contrast]
np.savez(
    f"{arg.out}/evs_steps.npz",
    contrast=contrast,
    signal_dn=20.0,
    n_trials=200,
    n_on=np.stack([s[0] for s in steps]),
    n_off=np.stack([s[1] for s in steps]),
)
with open(f"{arg.out}/capture.yaml", "w") as f:
    f.write(
        "bit_depth: 10\ntile_rows: 4\ntile_cols: 4\ncontrast_of: voltage\n"
        f"theta_hardware_v: {THETA}\nnotes: made by make_captures.py seed {arg.seed}; one beta_e for all positions\n"
    )
json.dump(
    dict(
        order=["1", "I", "t", "I^2", "I*t", "t^2"],
        beta_a=beta.tolist(),
        adc_variance_dn2=1 / 12,
        theta_hardware_v=THETA,
        theta_ln=theta,
        theta_mismatch=arg.mismatch,
        n_trials=N,
        beta_e=be.tolist(),
        A=be[0] * be[1] / be[4],
        B=be[0] * be[2] / be[4],
        C=be[3] / be[4],
        D=be[5],
    ),
    open(f"{arg.out}/truth.json", "w"),  # noqa: SIM115
    indent=1,
)
gauge = blc.mean(1, keepdims=True)  # row means belong to N_row
n_row = row + gauge[:, 0]
black = n_row.mean()
np.savez(
    f"{arg.out}/truth_maps.npz",
    black=black,
    n_row=n_row - black,
    n_blc=blc - gauge,
    n_dp=n_dp,
    hot=hot,
    slope_dn_per_s=slope,
    evs_bad=bad,
    evs_offset_ln=offset,
)
print(
    f"{arg.out}: lit clipped {np.mean(slope * t_s[-1] + blc > FULL):.3f} at the longest exposure, "
    f"P static {on.sum() / N / S / S:.2e} to {on[~bad].max() / N:.2e}, theta {theta:.4f} ln"
)
