"""Pixel positions and roles, exposure times, and the colour description of a mosaic."""
