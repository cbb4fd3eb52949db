"""Noise parameters of a real or simulated sensor from captures, with their uncertainty.

The package needs NumPy and SciPy only, and neither the renderer nor the simulators, so that it runs on real captures.
"""

from hesim_render.calibrate.aps.calibration import calibrate_aps
from hesim_render.calibrate.evs.calibration import calibrate_evs
from hesim_render.calibrate.report.page import write_report
from hesim_render.calibrate.result import read_calibration, read_maps

__all__ = ["calibrate_aps", "calibrate_evs", "read_calibration", "read_maps", "write_report"]
