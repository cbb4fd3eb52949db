"""Stratified sequences and wavelengths."""
