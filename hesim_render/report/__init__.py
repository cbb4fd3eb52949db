"""A test report of event and hybrid sensors, from captures of real or simulated ones."""

from hesim_render.report.run import Report, make_report

__all__ = ["Report", "make_report"]
