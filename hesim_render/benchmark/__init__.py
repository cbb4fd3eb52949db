"""Benchmarks: many varied clips built from one specification, verified by hashes, and evaluated."""

from hesim_render.benchmark.build import build_benchmark
from hesim_render.benchmark.evaluate import evaluate_benchmark
from hesim_render.benchmark.folder import Benchmark, BenchmarkClip
from hesim_render.benchmark.verify import verify_benchmark

__all__ = ["Benchmark", "BenchmarkClip", "build_benchmark", "evaluate_benchmark", "verify_benchmark"]
