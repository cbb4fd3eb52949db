"""Random draws: a pure function of the benchmark's seed, the kind of draw, and the numbers of scene, motion, light."""

import hashlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

#: Streams of random numbers; a new kind of draw gets a new number, so that it changes no other.
SOLIDS, MOTIONS, LIGHTS, EXPOSURES, CLIPS, AUDITS = range(6)
Item = TypeVar("Item")


def draws(seed: int, stream: int, *numbers: int) -> np.random.Generator:
    """The random numbers of one thing, whatever else is drawn.

    Parameters
    ----------
    seed : of the benchmark.
    stream : the kind of draw.
    numbers : of scene, motion, light, and so on.
    """
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, stream, *numbers])))


def log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    """A value between two limits above 0, uniform in its logarithm."""
    low, high = limits
    return float(low * (high / low) ** rng.random())


def shares(items: Sequence[Item], weights: Sequence[float], key: str) -> list[list[Item]]:
    """Items divided among splits: each belongs to one, and every split with a weight gets some where there are enough.

    Parameters
    ----------
    items : what is divided, in any order.
    weights : of the splits; their sum is 1.
    key : text that decides the order, such as the benchmark's seed.
    """
    order = sorted(items, key=lambda item: hashlib.sha256(f"{key}/{item}".encode()).digest())
    counts = [int(len(order) * weight) for weight in weights]
    wanting = [k for k, weight in enumerate(weights) if weight > 0]
    while sum(counts) < len(order):  # the largest remainder first, but none of the splits stays empty
        empty = [k for k in wanting if counts[k] == 0]
        best = max(empty or wanting, key=lambda k: weights[k] * len(order) - counts[k])
        counts[best] += 1
    for k in wanting:
        rich = max(range(len(counts)), key=counts.__getitem__)
        if counts[k] == 0 and counts[rich] > 1:
            counts[rich] -= 1
            counts[k] += 1
    ends = np.cumsum([0, *counts])
    return [order[ends[k] : ends[k + 1]] for k in range(len(counts))]
