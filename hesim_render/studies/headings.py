"""What the columns of a study are called in tables for people, and which of them know the noise."""

from __future__ import annotations

from collections.abc import Mapping

from hesim_render.studies.table import Cell

#: Figures with the noise of their row: the matrix is that of the least squared error at this light and exposure.
NOISE_AWARE = {
    "ysnr_noise_aware": "YSNR", "ysnr_noise_aware_simulated": "YSNR simulated", "snr10_lux_noise_aware": "SNR10, lx",
    "delta_e_mean_noise_aware": "ΔE2000", "delta_e_noisy_noise_aware_simulated": "ΔE2000 of noisy pixels",
    "noise_amplification_noise_aware": "amplification",
}  # fmt: skip
#: The same with the matrix of colour, which is fitted without noise.
NOISE_FREE = {
    "ysnr": "YSNR", "ysnr_simulated": "YSNR simulated", "snr10_lux": "SNR10, lx",
    "delta_e_noisy_simulated": "ΔE2000 of noisy pixels", "noise_amplification": "amplification",
}  # fmt: skip
#: Levels.
LEVELS = {"white_saturation": "white / saturation", "dynamic_range_db": "DR, dB"}
#: What the words mean.
NOTE = (
    "Noise-aware: with the matrix of the least squared error, noise of this light and exposure included; the fair one "
    "to compare filter sets. Noise-free: with the matrix of the least colour error, fitted as if there was no noise. "
    "CLIPPED: a perfect white is above saturation; closed forms do not know that, simulated figures do."
)


def level_text(row: Mapping[str, Cell], text: str) -> str:
    """The text of ``white_saturation``, with a flag where a perfect white clips."""
    return f"{text} CLIPPED" if row.get("white_clipped") else text
