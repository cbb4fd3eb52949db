"""From the first events of asynchronous pixels after a reset to thresholds, noise, bandwidth and leak."""
