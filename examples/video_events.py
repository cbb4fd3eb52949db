"""A high-speed video into events and frames; any file will do, here pictures of a turning disc are made by formula.

Run: python examples/video_events.py [clip.mp4 or a folder] [folder to save to]
"""

import sys

import numpy as np

import hesim_render as hr

rows, cols = np.mgrid[:96, :128]
angle = np.arctan2(rows - 48, cols - 64)
inside = np.hypot(rows - 48, cols - 64) < 44


def picture(k):
    """A disc of six sectors that turns by half a degree a picture, 8-bit sRGB."""
    bright = np.sin(6 * (angle - np.radians(0.5) * k)) > 0
    colour = np.where(bright[..., None], (230, 200, 60), (30, 60, 140))
    return np.where(inside[..., None], colour, 90).astype(np.uint8)


if len(sys.argv) > 1:
    video, options = sys.argv[1], {}  # a tagged file needs nothing else; see docs/video.md for what can be given
else:
    video, options = np.stack([picture(k) for k in range(320)]), {"fps": 3200, "transfer": "srgb"}

sensor = hr.load_sensor("gen2").crop(256, 192)
for mode in ("matrix", "spectral"):
    recording = hr.simulate_video(video, sensor, mode=mode, white_lux=1000, seed=7, **options)
    electrons = np.mean([np.nanmean(frame.electrons_mean) for frame in recording.frames])
    print(f"{mode:<9} {len(recording.frames)} frames of {electrons:.0f} e- on average, {recording.events.size} events")
for note in recording.manifest["settings"]["video"]["notes"]:
    print("note:", note)
if len(sys.argv) > 2:
    print("saved to", recording.save(sys.argv[2]))
