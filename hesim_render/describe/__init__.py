"""What a sensor does, from its file alone: curves against light, photon transfer, spectral response, tables."""

from hesim_render.describe.curve_picture import write_picture
from hesim_render.describe.curves import EventCurves, event_curves, photon_transfer, s_curve
from hesim_render.describe.motion import motion_figures, motion_lines, write_motion
from hesim_render.describe.table import Row, figures_of, table_lines

__all__ = [
    "EventCurves", "Row", "event_curves", "figures_of", "motion_figures", "motion_lines", "photon_transfer", "s_curve",
    "table_lines", "write_motion", "write_picture",
]  # fmt: skip
