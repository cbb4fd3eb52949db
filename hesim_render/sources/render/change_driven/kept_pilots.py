"""Pilots that are kept from one block to the next, with their single rays, to compare those of other windows with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.pair_flux import PilotFlux, PilotRays
from hesim_render.sources.render.change_driven.windows import Windows


@dataclass(frozen=True)
class Anchored:
    """Pilot of all sites in the anchor of their block, see `anchor`.

    Parameters
    ----------
    flux : its statistics, [site].
    rays : its rays.
    window_us : begin and end of the anchor, µs.
    near_us : interval for which `flux.met` holds, or a longer one, µs; None: that of the anchor.
    is_long : True if this interval holds many blocks, so that each has to ask what comes near within its own.
    """

    flux: PilotFlux
    rays: PilotRays
    window_us: tuple[float, float]
    near_us: tuple[float, float] | None = None
    is_long: bool = False

    def tells(self, span_us: tuple[float, float] | None) -> bool:
        """True if `flux.met` is True wherever a ray came near a moving object within an interval, µs."""
        if span_us is None or self.near_us is None:
            return False
        return self.near_us[0] <= span_us[0] and span_us[1] <= self.near_us[1]

    def is_in(self, windows: Windows, numbers: NDArray[np.int64]) -> bool:
        """True if all sites have one window, [site] by number, and the anchor is this one."""
        return _is_one(self.window_us, windows, numbers)


@dataclass(frozen=True)
class Ended:
    """Pilot of all sites in the last window of a block, which is the first of the next.

    Parameters
    ----------
    flux : its statistics, [site], with the known shadows.
    rays : its rays, without these.
    shadows : [site], known shadows, see `PairTracer.trace`.
    window_us : begin and end of the window, µs.
    anchor_us : begin and end of the anchor with which it is compared, µs.
    """

    flux: PilotFlux
    rays: PilotRays
    shadows: NDArray[np.uint32]
    window_us: tuple[float, float]
    anchor_us: tuple[float, float]

    @classmethod
    def of(
        cls,
        flux: PilotFlux,
        rays: PilotRays,
        shadows: NDArray[np.uint32],
        windows: Windows,
        numbers: NDArray[np.int64],
        ending: Anchored,
    ) -> "Ended":
        """As given, where all sites have one window, [site] by number. Statistics are copied out of larger tables."""
        own = PilotFlux(**{name: values.copy() for name, values in flux.tables.items()})
        return cls(own, rays, shadows, _span_us(windows, int(numbers[0])), ending.window_us)

    def begins(self, windows: Windows, numbers: NDArray[np.int64], anchored: Anchored | None) -> bool:
        """True if all sites begin with this window, [site] by number, and are compared with the same anchor."""
        return (
            anchored is not None and self.anchor_us == anchored.window_us and _is_one(self.window_us, windows, numbers)
        )


def _is_one(window_us: tuple[float, float], windows: Windows, numbers: NDArray[np.int64]) -> bool:
    """True if all sites have one window, [site] by number, which is this one."""
    return bool(np.all(numbers == numbers[0])) and window_us == _span_us(windows, int(numbers[0]))


def _span_us(windows: Windows, number: int) -> tuple[float, float]:
    """Begin and end of a window, µs."""
    return float(windows.begin_us[number]), float(windows.end_us[number])
