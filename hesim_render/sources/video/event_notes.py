"""What the rate of a video's pictures does to events, for the way in which the pixels compare."""

from __future__ import annotations

import numpy as np

from hesim_render.specs.event_pixels import EvsSpec


def event_notes(spec: EvsSpec, period_us: float, is_held: bool) -> list[str]:
    """Notes for the user of a video in front of event pixels, in sentences.

    Parameters
    ----------
    spec : the event pixels.
    period_us : time from one picture to the next, µs.
    is_held : each picture is held until the next one; otherwise the light goes in a straight line between them.

    Returns
    -------
    No note where events follow the pictures.
    """
    if spec.tick_us is None:
        return [
            "the sensor's event pixels are asynchronous: their ln x goes in a straight line from the middle of one "
            "picture to that of the next, so that events are not half a picture late; frames see held pictures"
        ] if is_held else []  # fmt: skip
    if period_us <= spec.tick_us:
        return []
    rates = f"pictures come every {period_us:.0f} µs, event comparisons every {spec.tick_us} µs"
    if spec.reference == "last_event":  # small steps add up
        gather = f"{rates}: events gather where pictures change; interpolation 'linear' spreads them and loses none"
        return [gather] if is_held else []
    ticks, threshold = period_us / spec.tick_us, min(spec.contrast_threshold_on, spec.contrast_threshold_off)
    # light goes in a straight line: its largest relative step is that at the dark end
    spread, held = (f"{1 + number * np.expm1(threshold):.3g} times" for number in (ticks, 1.0))
    lost = (
        f"spreads a change over {ticks:.3g} comparisons, each with the sample before: one of less than {spread} "
        f"between two pictures gives no event, and {held} are enough where pictures are held"
    )
    if is_held:
        return [
            f"{rates}: events gather where pictures change; only pictures as fast as the comparisons avoid that. "
            f"Interpolation is not advised for this sensor: it {lost}"
        ]
    return [
        f"{rates}: events are LOST, as interpolation {lost}. Hold the pictures (interpolation 'none'), or use pictures "
        "as fast as the comparisons"
    ]
