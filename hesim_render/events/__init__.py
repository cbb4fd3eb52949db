"""Events as arrays for eyes and networks: frames, time surfaces, voxel grids and rates (``hr.events``).

All functions take a structured array of `EVENT_DTYPE`, such as `Recording.events` or a part of it from
`Recording.event_slice`, and the shape of the event grid, such as `Recording.event_shape`.

Examples
--------
>>> import hesim_render as hr
>>> sensor = hr.load_sensor("gen2", {"evs.contrast_threshold_on": 0.02}).crop(64, 32)
>>> rec = hr.simulate(hr.load_scene("dark"), sensor, duration_s=0.02)
>>> hr.events.voxel_grid(rec.events, rec.event_shape, bins=5).shape
(5, 8, 16)
"""

from hesim_render.events.grids import event_frame, event_frames, time_surface, voxel_grid
from hesim_render.events.rates import EventRate, event_rate
from hesim_render.pixels.evs.events import EVENT_DTYPE, EventLabels, Label, Lost, Origin, no_events

__all__ = [
    "EVENT_DTYPE", "EventLabels", "EventRate", "Label", "Lost", "Origin", "event_frame", "event_frames", "event_rate",
    "no_events", "time_surface", "voxel_grid",
]  # fmt: skip
