"""Noise terms that can be switched off by name."""

from __future__ import annotations

from collections.abc import Iterable

from hesim_render.core.errors import RangeError


def switched_off(already: frozenset[str], terms: Iterable[str], known: tuple[str, ...]) -> frozenset[str]:
    """`already` and `terms` together.

    Raises
    ------
    RangeError
        If a name is not among `known`; the message lists them.
    """
    for term in terms:
        if term not in known:
            raise RangeError("noise term", term, f"one of {', '.join(known)}")
    return already | frozenset(terms)
