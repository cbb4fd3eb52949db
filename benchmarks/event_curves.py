"""Time of the event pixels of asynchronous sensors whose photoreceptor bends the light, without any rendering.

Run: python benchmarks/event_curves.py [--sensor imx636] [--duration 0.02] [--every-us 1000] [--moving 0.1]

A part of the pixels sees sinusoidal light of 30 Hz, the rest still light. The script prints the time for a second of
the sensor, and the ratio to the same run in which every pixel is followed from node to node, not only those that may
come to a threshold. Both runs have the same events. Run it on an idle machine.
"""

import argparse
import time

import numpy as np

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.pixels.evs import last_event
from hesim_render.pixels.evs.stage import EvsStage


def run(noise, given):
    """Seconds of the steps, and all events."""
    rng, size = np.random.default_rng(0), int(np.prod(noise.layout.evs_shape))
    level, phase = np.log(rng.uniform(50, 500, size)), rng.uniform(0, 2 * np.pi, size)
    swing = 0.3 * (rng.random(size) < given.moving)
    stage, seconds, events = EvsStage(noise, 3), 0.0, []
    for t_us in range(0, round(given.duration * 1e6) + 2 * given.every_us, given.every_us):
        electrons = jit().Float(np.exp(level + swing * np.sin(60e-6 * np.pi * t_us + phase)).astype(np.float32))
        begin = time.monotonic()
        events.append(stage.step(electrons, t_us))
        if t_us > given.every_us:  # kernels are compiled by the first steps
            seconds += time.monotonic() - begin
    return seconds, np.concatenate(events)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="imx636")
    parser.add_argument("--duration", type=float, default=0.02, help="s")
    parser.add_argument("--every-us", type=int, default=1000, help="time between samples of the light")
    parser.add_argument("--moving", type=float, default=0.1, help="part of the pixels whose light changes")
    given = parser.parse_args()
    noise = hr.load_sensor(given.sensor).evs
    seconds, events = run(noise, given)
    margin = last_event._MARGIN_REL
    last_event._MARGIN_REL = 1e9
    all_seconds, all_events = run(noise, given)
    last_event._MARGIN_REL = margin
    same = "the same" if np.array_equal(events, all_events) else "OTHER"
    rows, cols = noise.layout.evs_shape
    print(
        f"{given.sensor}, {cols}x{rows}, {100 * given.moving:g} % of the pixels changing, {len(events)} events in "
        f"{given.duration:g} s: {seconds / given.duration:.1f} s for a second; all pixels followed take "
        f"{all_seconds / seconds:.1f} times as long, with {same} events"
    )


if __name__ == "__main__":
    main()
