"""From a scene file or a Mitsuba scene to objects that can be moved."""
