"""Scene files and Mitsuba scenes as loaded scenes whose objects can be moved."""
