"""Cost of the live view: the same run with and without it, in processor time and by the clock.

Run: python benchmarks/live.py [--roi 256x192] [--duration 0.1] [--repeats 3] [--video]

Both runs are made in turn in one process, after one of each that compiles kernels and loads rerun, whose time is said
apart. ``--video`` takes a made-up video, the fastest source, in place of a rendered scene. Run it on an idle machine:
the ratio of processor times is the cost, that of the clock is noisier.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import hesim_render as hr
from hesim_render.core.region import parse_roi
from hesim_render.recording import live_view, rerun_view


def run(given, out, live):
    """Processor time and time by the clock of one run, s."""
    begin = time.process_time(), time.monotonic()
    if given.video:
        shade = np.linspace(20, 235, 480 * 640).reshape(480, 640)
        pictures = np.stack([np.roll(shade, 3 * k, axis=1) for k in range(round(given.duration * 250))])
        clip = np.repeat(pictures[..., None], 3, axis=-1).astype(np.uint8)
        tags = {"fps": 250, "transfer": "srgb", "primaries": "bt709", "white_lux": 500}
        hr.simulate_video(clip, given.loaded, out=out, overwrite=True, live=live, **tags)
    else:
        hr.simulate(given.scene, given.loaded, duration_s=given.duration, out=out, overwrite=True, live=live)
    return time.process_time() - begin[0], time.monotonic() - begin[1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="rotating-star")
    parser.add_argument("--sensor", default="gen2")
    parser.add_argument("--roi", default="256x192")
    parser.add_argument("--duration", type=float, default=0.1, help="s")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--video", action="store_true", help="a video in place of the scene")
    given = parser.parse_args()
    given.loaded = hr.load_sensor(given.sensor).crop(*parse_roi(given.roi))
    rerun_view.can_show = lambda: False  # the file, not the viewer
    begin = time.process_time()
    live_view.live_file(Path())
    print(f"rerun is loaded in {time.process_time() - begin:.2f} s of the processor")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "r"
        for live in (False, True):
            run(given, out, live)
        times = np.array([[run(given, out, live) for live in (False, True)] for _ in range(given.repeats)])
        size = (out / "live.rrd").stat().st_size
    for k, name in enumerate(("processor", "clock")):
        without, with_ = times[:, :, k].T
        ratios = with_ / without - 1
        print(
            f"{name}: {without.mean():.2f} s without, {with_.mean():.2f} s with the live view; it costs "
            f"{np.median(ratios):+.1%} (median of {given.repeats}; {ratios.min():+.1%} to {ratios.max():+.1%})"
        )
    print(f"live.rrd has {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
