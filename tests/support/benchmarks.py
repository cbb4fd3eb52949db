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


def generated(count: int, **changes: Any) -> BenchmarkSpec:
    """A benchmark of generated scenes alone."""
    scenes = {"count": count, **changes.pop("scenes", {})}
    content = {key: value for key, value in SMALL.items() if key not in ("scenes", "sharp", "truth")}
    return BenchmarkSpec.model_validate(content | {"scenes": scenes} | changes)
