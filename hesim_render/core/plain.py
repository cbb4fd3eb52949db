"""Plain values: dataclasses without their cached values, and content of JSON files."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


class PlainState:
    """Base of a dataclass whose cached properties are left out of pickles and copies.

    They are computed again on first use. Cached values may be large, or arrays on a device. Unpickling these would load
    Dr.Jit before `hesim_render.core.backend` has chosen a library for it.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


def finite(node: Any) -> Any:
    """Lists, mappings and numbers for a JSON file, which has no NaN or infinity: both become null."""
    if isinstance(node, dict):
        return {key: finite(value) for key, value in node.items()}
    if isinstance(node, list):
        return [finite(value) for value in node]
    if isinstance(node, float):
        return node if np.isfinite(node) else None
    return node
