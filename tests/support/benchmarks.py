"""Small benchmarks for tests: given scenes at a few pixels, or generated ones that are not rendered."""

from __future__ import annotations

from typing import Any

from hesim_render.specs.benchmark import BenchmarkSpec

#: Two clips: one that moves, one that does not.
SMALL: dict[str, Any] = {
    "schema_version": 1,
    "name": "small",
    "description": "Two shipped scenes.",
    "duration_s": 0.02,
    "scenes": {"given": [{"scene": "rotating-star", "split": "train"}, {"scene": "flat-field", "split": "test"}]},
    "sensors": [{"sensor": "reference-mono", "roi": "24x16"}],
    "sharp": {"every_us": 5000, "window_us": 500},
    "truth": ["flow", "events"],
    "quality": 4,
}


def small(**changes: Any) -> BenchmarkSpec:
    """The small benchmark with some keys changed."""
    return BenchmarkSpec.model_validate(SMALL | changes)


_KEPT = ("schema_version", "name", "description", "sensors", "quality", "duration_s")


def generated(count: int, **changes: Any) -> BenchmarkSpec:
    """A benchmark of generated scenes alone, in the default ranges."""
    scenes = {"count": count, **changes.pop("scenes", {})}
    return BenchmarkSpec.model_validate({key: SMALL[key] for key in _KEPT} | {"scenes": scenes} | changes)
