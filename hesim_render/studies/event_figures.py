"""What the event pixels of a filter set see: contrast sensitivity, noise rate, and steps between surfaces."""

from __future__ import annotations

from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.namespace import NUMPY
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs import formulas
from hesim_render.sensor.sensor import Sensor
from hesim_render.spectral.colour_difference import delta_e_ab, lab
from hesim_render.studies.colour_noise import GREY
from hesim_render.studies.colour_samples import ColourSamples

#: Pairs of surfaces with at most this difference of L*, and at least this one of colour, are isoluminant.
_SAME_LIGHTNESS, _OTHER_COLOUR = 5.0, 20.0


def event_figures(
    sensor: Sensor,
    filters: list[str],
    white_e_per_s: NDArray[np.float64],
    channels: NDArray[np.float64],
    samples: ColourSamples,
) -> dict[str, float | None]:
    """Figures of the event pixels of a tile.

    Parameters
    ----------
    sensor : with event pixels.
    filters : of the event pixels.
    white_e_per_s : [filter], electrons per second of a pixel on a perfect white.
    channels : [surface, filter], response to each surface over that to white.
    samples : the surfaces' colours.

    Returns
    -------
    ``event_contrast_on``: relative rise of the light on an 18 % grey card at which an event is as likely as not, the
    mean over the event pixels of the tile; ``event_noise_rate_hz``: events of one pixel on that card without any
    change, leak included (None for asynchronous pixels, where no closed form holds); ``event_seen``: probability that
    at least one event pixel of the tile tells when one surface replaces another, the mean over pairs;
    ``event_seen_isoluminant``: the same for pairs that differ in colour (ΔE*ab above 20), but hardly in lightness
    (ΔL* below 5), None if there are no such pairs.
    """  # fmt: skip
    spec, evs = sensor.spec.evs, sensor.evs
    assert spec is not None
    per_window = white_e_per_s * (spec.window_us * S_PER_US)
    tile = sensor.spec.tile_rows
    where = [filters.index(sensor.spec.pixels[tile[i][j]].filter) for i, j in sensor.spec.positions("evs")]
    theta_on, theta_off = spec.contrast_threshold_on, spec.contrast_threshold_off
    spread_on, spread_off = (spec.threshold_mismatch_rel * theta for theta in (theta_on, theta_off))
    contrast, rate, missed = [], [], np.ones((len(channels), len(channels)))
    for position, column in enumerate(where):
        k = evs.table.each(itemgetter(position))
        grey = GREY * per_window[column]
        signal = k.slope * grey
        contrast.append(np.expm1(theta_on) * (1 + k.base / signal) if signal > 0 else np.inf)
        if spec.tick_us is not None:
            _, variance = formulas.log_level(k, np.asarray(grey), spec.shot_law, NUMPY)
            on = formulas.exceedance(theta_on, np.sqrt(2 * variance + spread_on**2))
            off = formulas.exceedance(theta_off, np.sqrt(2 * variance + spread_off**2))
            rate.append(float(on + off) / (spec.tick_us * S_PER_US) + evs.leak_rate_hz)
        level, variance = formulas.log_level(k, channels[:, column] * per_window[column], spec.shot_law, NUMPY)
        change = level[None, :] - level[:, None]
        sigma2 = variance[None, :] + variance[:, None]
        on = formulas.exceedance(theta_on - change, np.sqrt(sigma2 + spread_on**2))
        off = formulas.exceedance(theta_off + change, np.sqrt(sigma2 + spread_off**2))
        missed *= 1 - np.minimum(on + off, 1)
    seen = 1 - missed
    pairs = ~np.eye(len(channels), dtype=bool)
    colours = lab(samples.xyz, samples.white_xyz)
    same = np.abs(colours[:, None, 0] - colours[None, :, 0]) < _SAME_LIGHTNESS
    isoluminant = pairs & same & (delta_e_ab(colours[:, None], colours[None]) > _OTHER_COLOUR)
    return {
        "event_contrast_on": float(np.mean(contrast)),
        "event_noise_rate_hz": float(np.mean(rate)) if rate else None,
        "event_seen": float(seen[pairs].mean()) if pairs.any() else None,
        "event_seen_isoluminant": float(seen[isoluminant].mean()) if isoluminant.any() else None,
    }
