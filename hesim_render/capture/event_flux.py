"""Mean flux of the event pixels over all samples, which is their truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import Float


class EventFlux:
    """Truth of the event pixels: mean flux over all samples, with both halves kept apart."""

    STATE = ("_half_a", "_half_b", "samples")

    def __init__(self, count: int) -> None:
        self._half_a, self._half_b = np.zeros(count), np.zeros(count)
        self.samples = 0

    def add(self, half_a: Float, half_b: Float) -> None:
        self._half_a += np.array(half_a)
        self._half_b += np.array(half_b)
        self.samples += 1

    def mean_e_per_s(self) -> NDArray[np.float32]:
        """[event pixel], e⁻/s."""
        return ((self._half_a + self._half_b) / (2 * max(1, self.samples))).astype(np.float32)

    def stderr_e_per_s(self) -> NDArray[np.float32]:
        """[event pixel], standard error of that mean from its two halves, e⁻/s."""
        return (np.abs(self._half_a - self._half_b) / (2 * max(1, self.samples))).astype(np.float32)
