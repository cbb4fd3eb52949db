"""Dataclasses whose cached values are left out of pickles and copies."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


class PlainState:
    """Base of a dataclass whose cached properties are left out of pickles and copies.

    They are computed again on first use. Cached values may be large, or arrays on a device. Unpickling these would load
    Dr.Jit before `hesim_render.core.backend` has chosen a library for it.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
