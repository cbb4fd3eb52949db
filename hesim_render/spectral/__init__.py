"""Spectra, colorimetry, transfer functions and waveforms of light."""
