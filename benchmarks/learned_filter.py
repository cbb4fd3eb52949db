"""A small network that tells signal from noise events by the times of their neighbours (extra ``torch``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.event_filters import last_before
from hesim_render.core.errors import RangeError, SpecError, how_to_install
from hesim_render.core.units import US_PER_S

try:
    import torch
except ImportError:  # reported when a filter is trained
    torch = None  # type: ignore[assignment]

#: Neighbours within this distance are looked at, px; time constants of how much a past event counts, µs.
_REACH, _TAU_US = 3, (2_000.0, 20_000.0)
_HIDDEN, _BATCH, _RATE, _STEPS = 32, 512, 2e-3, 1500


def features(events: NDArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    """What the network sees of each event: how long ago its pixel and its neighbours had their last events.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.

    Returns
    -------
    float32 [event, 4 · 49]: exp(−Δt / τ) of the last event of each polarity, the event's own and the other one, in the
    7×7 pixels around, for τ of 2 ms and 20 ms; 0 without an event.
    """
    reach = range(-_REACH, _REACH + 1)
    is_on = events["polarity"] > 0
    found = np.zeros((len(events), 2 * len(_TAU_US) * len(reach) ** 2), np.float32)
    column = 0
    for row in reach:
        for col in reach:
            on, off = (last_before(events, shape, row, col, events[is_on == sign]) for sign in (True, False))
            for last in (np.where(is_on, on, off), np.where(is_on, off, on)):
                age = (events["t_us"] - last).astype(np.float64)
                for tau in _TAU_US:
                    found[:, column] = np.exp(-age / tau)
                    column += 1
    return found


class LearnedFilter:
    """A perceptron of one hidden layer, trained on labelled events.

    Parameters
    ----------
    streams : events, labels (True for signal) and shape of the event grid of each recording.
    seed : of its first weights and of the order of events.

    Raises
    ------
    SpecError
        If PyTorch is missing.
    RangeError
        If the events are all signal or all noise.
    """

    def __init__(self, streams: Sequence[tuple[NDArray, NDArray[np.bool_], tuple[int, int]]], seed: int = 0) -> None:
        if torch is None:
            raise SpecError(f"a learned filter needs PyTorch: {how_to_install('torch')}")
        x = np.concatenate([features(events, shape) for events, _, shape in streams])
        y = np.concatenate([labels for _, labels, _ in streams])
        if not 0 < np.count_nonzero(y) < len(y):
            raise RangeError("labels", f"{np.count_nonzero(y)} of {len(y)} signal", "events of both kinds")
        generator = torch.Generator().manual_seed(seed)
        self._network = self._trained(torch.from_numpy(x), torch.from_numpy(y.astype(np.float32)), generator)

    @staticmethod
    def _trained(x: Any, y: Any, generator: Any) -> Any:
        """Adam on the cross-entropy; each batch has as many signal as noise events."""
        network = torch.nn.Sequential(
            torch.nn.Linear(x.shape[1], _HIDDEN), torch.nn.ReLU(), torch.nn.Linear(_HIDDEN, 1)
        )
        with torch.no_grad():
            for values in network.parameters():
                size = values.shape[-1] ** -0.5
                values.copy_(size * (2 * torch.rand(values.shape, generator=generator) - 1))
        kinds = [torch.nonzero(y == kind)[:, 0] for kind in (0, 1)]
        adam = torch.optim.Adam(network.parameters(), lr=_RATE)
        loss = torch.nn.BCEWithLogitsLoss()
        for _ in range(_STEPS):
            of_each = [kind[torch.randint(len(kind), (_BATCH // 2,), generator=generator)] for kind in kinds]
            chosen = torch.cat(of_each)
            adam.zero_grad()
            loss(network(x[chosen])[:, 0], y[chosen]).backward()
            adam.step()
        return network

    def score(self, events: NDArray, shape: tuple[int, int]) -> NDArray[np.float32]:
        """How sure the network is that events are signal, [event], 0 to 1.

        Parameters
        ----------
        events : structured array of `EVENT_DTYPE`, in order of time.
        shape : rows and columns of the event grid.
        """
        with torch.no_grad():
            logits = self._network(torch.from_numpy(features(events, shape)))[:, 0]
            return torch.sigmoid(logits).numpy()


def area_under_curve(score: NDArray, is_signal: NDArray[np.bool_]) -> float:
    """Area under the curve of kept signal over kept noise, by ranks: the chance that a signal event scores higher.

    Parameters
    ----------
    score : [event].
    is_signal : [event].

    Returns
    -------
    0.5 for a blind filter, 1 for a perfect one; NaN where one kind is missing.
    """
    from scipy.stats import rankdata

    positive, count = int(np.count_nonzero(is_signal)), len(is_signal)
    if not 0 < positive < count:
        return float("nan")
    ranks = rankdata(score)[is_signal].sum()
    return float((ranks - positive * (positive + 1) / 2) / (positive * (count - positive)))


def uniform_noise(
    events: NDArray, shape: tuple[int, int], rate_hz: float, duration_us: int, rng: np.random.Generator
) -> tuple[NDArray, NDArray[np.bool_]]:
    """Events with noise that knows nothing of a sensor: the same rate at all pixels and times, any polarity.

    Parameters
    ----------
    events : noise-free events, structured array of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    rate_hz : of noise events per pixel.
    duration_us : of the recording, µs.
    rng : random numbers.

    Returns
    -------
    All events in order of time, and which are signal.
    """
    rows, cols = shape
    added = np.zeros(rng.poisson(rate_hz * rows * cols * duration_us / US_PER_S), events.dtype)
    added["t_us"], added["polarity"] = rng.integers(1, duration_us + 1, len(added)), rng.choice([-1, 1], len(added))
    added["x"], added["y"] = rng.integers(0, cols, len(added)), rng.integers(0, rows, len(added))
    both = np.concatenate([events, added])
    order = np.argsort(both["t_us"], kind="stable")
    return both[order], (np.arange(len(both)) < len(events))[order]
