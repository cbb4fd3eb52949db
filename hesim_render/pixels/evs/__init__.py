"""Event pixels: formulas and sampler, the comparator with its memory, and what is around it."""
