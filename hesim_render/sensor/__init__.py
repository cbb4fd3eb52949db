"""Sensor files, and a sensor ready to use: its specification, read-out region, lens and pixel models."""
