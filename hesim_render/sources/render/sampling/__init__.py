"""Stratified sequences of random numbers, and the sampling of wavelengths."""
