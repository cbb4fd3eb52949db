"""Wanted error of a render, in units of the noise of the sensor's own pixels."""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import S_PER_US
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.change_driven.neighbours import Lattice

#: Use of a pixel: "events" is a window of an event pixel; "any" is a frame exposure, or a window where there is none.
Role = Literal["any", "events"]

#: Maps flux [..., n], e⁻/s, to the noise unit of n pixels: the change of flux equal to one standard deviation, e⁻/s.
NoiseUnit = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Noise:
    """Noise of a sensor's pixels, expressed as flux.

    Parameters
    ----------
    sensor : with its noise models.
    most_power : largest factor by which the flux is multiplied later (largest over mean power of a flickering light).
    rests : True if nothing moves, so that the same value of a pixel serves its frames and its events.
    """

    def __init__(self, sensor: Sensor, most_power: float = 1.0, rests: bool = False) -> None:
        self._sensor, self._power = sensor, most_power
        spec, layout = sensor.spec, sensor.layout
        rows, cols = layout.tile_shape
        self._is_frame = np.zeros((rows, cols), np.bool_)
        if spec.aps is not None:
            for place in spec.positions("aps"):
                self._is_frame[place] = True
        #: Number of the event position at each place of the tile; 0, the first one, at other places.
        self._position = np.zeros((rows, cols), np.uint16)
        #: Places of both roles, if the quieter one of them decides.
        self._is_both = np.zeros((rows, cols), np.bool_)
        if spec.evs is not None:
            for number, place in enumerate(spec.positions("evs")):
                self._position[place] = number
                self._is_both[place] = rests and self._is_frame[place]

    def of(self, role: Role, index: NDArray[np.uint32]) -> NoiseUnit:
        """Noise unit of listed pixels. A pixel without the role takes that of the first position that has it.

        Such pixels occur as sources of crosstalk and as neighbours. The noise of a frame pixel is read noise, shot
        noise, dark noise, rounding and PRNU of one exposure. The noise of an event pixel is one standard deviation of
        ln x of one window, at least θ/20.

        Parameters
        ----------
        role : use of the pixels.
        index : [n], numbers on the full sensor.

        Returns
        -------
        Function from flux [..., n] to the noise unit [..., n], both e⁻/s.
        """
        row, col = np.divmod(index.astype(np.int64), self._sensor.spec.geometry.cols)
        rows, cols = self._position.shape
        # the tile repeats, so the place in it tells role and event position
        place = row % rows, col % cols
        if self._sensor.spec.evs is None:
            return self._frame_unit()
        events = self._event_unit(self._position[place])
        if role == "events" or self._sensor.spec.aps is None:
            return events
        frames, is_frame, is_both = self._frame_unit(), self._is_frame[place], self._is_both[place]
        if is_frame.all() and not is_both.any():
            return frames

        def unit(flux: NDArray[np.float32]) -> NDArray[np.float32]:
            of_frames, of_events = frames(flux), events(flux)
            # a value that serves frames and events must satisfy the quieter of the two
            either = np.where(is_both, np.minimum(of_frames, of_events), of_frames)
            return np.where(is_frame, either, of_events)

        return unit

    def _frame_unit(self) -> NoiseUnit:
        noise, power = self._sensor.aps, np.float32(self._power)
        exposure_us = noise.spec.exposure_us
        seconds = np.float32(exposure_us * S_PER_US) * power
        return lambda flux: (noise.noise_equivalent_e(flux * seconds, exposure_us) / seconds).astype(np.float32)

    def _event_unit(self, position: NDArray[np.uint16]) -> NoiseUnit:
        noise = self._sensor.evs
        seconds = np.float32(noise.spec.window_us * S_PER_US) * np.float32(self._power)
        return lambda flux: (noise.noise_equivalent_e(flux * seconds, position) / seconds).astype(np.float32)

    def is_apart(self, role: Role) -> bool:
        """True if pixels of a role have no direct neighbours of that role: fewer than half of all pixels have it."""
        return 2 * len(self._places(role)) < self._position.size

    def lattice(self, role: Role) -> Lattice | None:
        """The pixels of a role, all pixels where they are not apart; None where they lie on no regular lattice."""
        geometry, places = self._sensor.spec.geometry, self._places(role)
        if not self.is_apart(role):
            return Lattice.whole(geometry.rows, geometry.cols)
        first, step, counts = [], [], []
        for axis, size in enumerate((geometry.rows, geometry.cols)):
            tile, own = self._position.shape[axis], sorted({place[axis] for place in places})
            # a lattice along this axis: places at equal distances that divide the tile
            distance, rest = divmod(tile, len(own))
            if rest or any(each != own[0] + k * distance for k, each in enumerate(own)):
                return None
            first.append(own[0])
            step.append(distance)
            counts.append(len(range(own[0], size, distance)))
        # both axes are regular, but not every crossing has the role
        if len(places) * step[0] * step[1] != self._position.size:
            return None
        return Lattice(counts[0], counts[1], (first[0], first[1]), (step[0], step[1]), geometry.cols)

    def _places(self, role: Role) -> list[tuple[int, int]]:
        """Places of a role in the tile."""
        spec = self._sensor.spec
        return spec.positions("evs" if role == "events" or spec.aps is None else "aps")
