"""Kinds of ground truth that a run can be asked for."""

from __future__ import annotations

from collections.abc import Iterable

from hesim_render.core.errors import RangeError, did_you_mean

#: Kinds with one image for each frame or time; all are those of the chief ray through each pixel's centre.
IMAGES = ("depth", "normals", "position", "ids", "flow", "mixed")
#: Kinds that are not images.
SERIES = ("poses", "boxes", "imu", "light")
#: Label of each event, events that were lost, and the events without noise.
EVENTS = "events"
TRUTH_KINDS = (*IMAGES, *SERIES, EVENTS)


def truth_kinds(names: str | Iterable[str]) -> tuple[str, ...]:
    """The kinds that names ask for, in the order of `TRUTH_KINDS`; ``all`` asks for all.

    One text holds names with commas between them, as on the command line.

    Raises
    ------
    RangeError
        For a name that is not a kind.
    """
    wanted: set[str] = set()
    for name in names.replace(" ", "").split(",") if isinstance(names, str) else names:
        if name == "all":
            wanted.update(TRUTH_KINDS)
        elif name in TRUTH_KINDS:
            wanted.add(name)
        else:
            known = (*TRUTH_KINDS, "all")
            raise RangeError("truth", name, f"one of {', '.join(known)}{did_you_mean(name, known)}")
    return tuple(kind for kind in TRUTH_KINDS if kind in wanted)
