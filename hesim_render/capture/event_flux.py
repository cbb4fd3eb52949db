"""Flux of the event pixels: the window that is being filled, and the mean over all samples, which is their truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import Float


class EventFlux:
    """Truth of the event pixels: mean flux over all samples, with both halves kept apart."""

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


class Window:
    """Mean flux of the event window being filled, and which of all samples it belongs to."""

    def __init__(self, ends_us: NDArray[np.int64]) -> None:
        self.ends_us = ends_us
        self.next = 0
        self.half_a: Float = 0.0
        self.half_b: Float = 0.0

    def add(self, half_a: Float, half_b: Float, share: float) -> None:
        self.half_a, self.half_b = self.half_a + half_a * share, self.half_b + half_b * share

    def reset(self) -> None:
        self.next += 1
        self.half_a = self.half_b = 0.0
