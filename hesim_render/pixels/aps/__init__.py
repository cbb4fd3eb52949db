"""Frame pixels: formulas and sampler, fixed patterns."""
