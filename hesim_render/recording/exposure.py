"""A note where the frames of a recording are nearly dark, or mostly saturated."""

from __future__ import annotations

import warnings

import numpy as np

from hesim_render.core.errors import HesimWarning
from hesim_render.recording.recording import Recording

#: Share of the pixels of a frame that is judged as dark where its signal is below the read noise.
_DARK_SHARE = 0.99
#: Share of saturated pixels that gives a warning.
_WHITE_SHARE = 0.5


def warn_of_exposure(recording: Recording) -> Recording:
    """The recording; warns, by its middle frame, if nearly all signal is below the read noise, or most is saturated.

    A scene without light is dark by intent, which gives no warning.
    """
    if not len(recording.frames):
        return recording
    frame, aps = recording.frames[len(recording.frames) // 2], recording.manifest["sensor"]["spec"]["aps"]
    signal_e = frame.electrons_mean[frame.valid]
    if signal_e.size == 0:
        return recording
    typical_e = float(np.quantile(signal_e, _DARK_SHARE))
    white = float(np.mean(frame.raw[frame.valid] >= recording.mosaic.white_level_dn))
    where = f"frame {frame.index}, exposed for {frame.exposure_us} µs"
    if signal_e.max() > 0 and typical_e < aps["read_noise_e"]:
        warnings.warn(
            f"{where}, is nearly dark: {100 * _DARK_SHARE:g} % of its pixels have fewer than {typical_e:.2g} e⁻, at a "
            f"read noise of {aps['read_noise_e']:g} e⁻; give more light or a longer exposure",
            HesimWarning, stacklevel=3,
        )  # fmt: skip
    elif white > _WHITE_SHARE:
        warnings.warn(
            f"{where}, is overexposed: {100 * white:.0f} % of its pixels are saturated; give less light or a shorter "
            "exposure",
            HesimWarning, stacklevel=3,
        )  # fmt: skip
    return recording
