"""Thresholds, noise, bandwidth and leak from the first events of asynchronous pixels after a reset."""
