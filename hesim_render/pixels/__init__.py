"""The statistical model of both pixel types: formulas, device maps and samplers."""
