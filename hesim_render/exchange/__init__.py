"""Event and frame files of other programs, written and read in pieces."""

from hesim_render.exchange.formats import EVENT_FORMATS, FRAME_FORMATS, is_event_file, open_events
from hesim_render.exchange.stream import EventStream

__all__ = ["EVENT_FORMATS", "FRAME_FORMATS", "EventStream", "is_event_file", "open_events"]
