"""How exact a render is wanted: its error is measured against the noise of the sensor's own pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor

#: What a pixel is asked for: its part of a frame or, if it gives none, of an event's window ("any"); or the latter.
Role = Literal["any", "events"]

#: Flux [..., n], e⁻/s → what one standard deviation of the noise of each of n pixels is worth there, e⁻/s.
NoiseUnit = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Noise:
    """Noise of a sensor's pixels, in terms of the flux behind it.

    Parameters
    ----------
    sensor : with both noise models.
    most_power : largest factor by which a flux is multiplied afterwards (a flickering light's power over its mean).
    """

    def __init__(self, sensor: Sensor, most_power: float = 1.0) -> None:
        self._sensor, self._power = sensor, most_power
        spec, layout = sensor.spec, sensor.layout
        rows, cols = layout.tile_shape
        self._is_frame = np.zeros((rows, cols), np.bool_)
        if spec.aps is not None:
            for place in spec.positions("aps"):
                self._is_frame[place] = True
        #: Number of the event position of each place of the tile; of others, the first.
        self._position = np.zeros((rows, cols), np.int64)
        if spec.evs is not None:
            for number, place in enumerate(spec.positions("evs")):
                self._position[place] = number

    def of(self, role: Role, index: NDArray[np.uint32]) -> NoiseUnit:
        """Of listed pixels; in a role that they do not have, of the first pixel that has it (crosstalk, neighbours).

        Frames: read noise, shot noise, dark noise, rounding and PRNU of one exposure. Events: one standard deviation of
        ln x of one window, at least θ/20.

        Parameters
        ----------
        index : [n], numbers on the full sensor.
        """
        row, col = np.divmod(index.astype(np.int64), self._sensor.spec.geometry.cols)
        rows, cols = self._position.shape
        place = row % rows, col % cols
        if self._sensor.spec.evs is None:
            return self._frame_unit()
        events = self._event_unit(self._position[place])
        if role == "events" or self._sensor.spec.aps is None:
            return events
        frames, is_frame = self._frame_unit(), self._is_frame[place]
        if is_frame.all():
            return frames
        return lambda flux: np.where(is_frame, frames(flux), events(flux))

    def _frame_unit(self) -> NoiseUnit:
        noise, power = self._sensor.aps, np.float32(self._power)
        exposure_us = noise.spec.exposure_us
        seconds = np.float32(exposure_us * S_PER_US) * power
        return lambda flux: (noise.noise_equivalent_e(flux * seconds, exposure_us) / seconds).astype(np.float32)

    def _event_unit(self, position: NDArray[np.int64]) -> NoiseUnit:
        noise = self._sensor.evs
        seconds = np.float32(noise.spec.window_us * S_PER_US) * np.float32(self._power)
        return lambda flux: (noise.noise_equivalent_e(flux * seconds, position) / seconds).astype(np.float32)

    def is_apart(self, role: Role) -> bool:
        """Whether the pixels of a role have no neighbours to ask: fewer than half of all pixels have it."""
        spec = self._sensor.spec
        counted = spec.positions("evs" if role == "events" or spec.aps is None else "aps")
        return 2 * len(counted) < self._position.size
