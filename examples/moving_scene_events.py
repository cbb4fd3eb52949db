"""Events of a turning star: how many are signal, how many are noise?

The same run twice: once with the sensor's noise, once without. Seeds make the difference exact.

Run: python examples/moving_scene_events.py [folder]
"""

import sys

import numpy as np

import hesim_render as hr

sensor = hr.load_sensor("gen2").crop(256, 192)
scene = hr.load_scene("rotating-star")
noisy = hr.simulate(scene, sensor, duration_s=0.03, seed=7, samples=16)
clean = hr.simulate(scene, sensor, duration_s=0.03, seed=7, samples=16, clean=True)

for label, recording in (("with noise", noisy), ("clean", clean)):
    events = recording.events
    rate = events.size / (recording.duration_us * 1e-6) / np.prod(recording.event_shape)
    on = np.count_nonzero(events["polarity"] > 0)
    print(f"{label:<11} {events.size:6d} events, {on} ON; {rate:.1f} per second and pixel")

# Where do they fall? Most near the rim, where the edges run fastest.
rows, cols = noisy.event_shape
radius = np.hypot(noisy.events["x"] - cols / 2, noisy.events["y"] - rows / 2)
print("events by distance from the centre:", np.histogram(radius, bins=np.linspace(0, rows / 2, 7))[0])

if len(sys.argv) > 1:
    print("saved to", noisy.save(sys.argv[1]))  # with preview.png and preview.gif
