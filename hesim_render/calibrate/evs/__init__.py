"""From counts of events and contrast steps to thresholds, noise and their spread."""
