"""Speed of the video path at its named size, 3200 pictures/s of 1296x1024, inversion included.

Prints, for each kind of input, how fast pictures become flux and then frames or events::

    python benchmarks/video.py [--pictures 64] [--repeat 3]

APS: every picture is inverted and added to the open exposure; beside it the worst case, in which every picture is
read out with all noise as a frame of its own. EVS: every picture is an event sample of every pixel, all noise on. The
whole run is `Capture` at the rates of the H-ESIM paper (3200 pictures/s, events at 800 Hz, frames at 24 Hz) on eiger's
mosaic, reading included. Reading is decoding for files, nothing for arrays, and in no other column.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core import backend
from hesim_render.sources.video import VideoFlux, VideoOptions

WIDTH, HEIGHT, FPS = 1296, 1024, 3200
BOUND_APS, BOUND_EVS = 60, 80


def pictures(count, dtype):
    """A moving texture: smooth tones with noise, so that events occur."""
    rng = np.random.default_rng(1)
    top = np.iinfo(dtype).max
    base = rng.uniform(0.1, 0.9, (HEIGHT // 16, WIDTH // 16, 3)).repeat(16, 0).repeat(16, 1)
    return [
        (top * np.clip(np.roll(base, 3 * k, 1) + rng.normal(0, 0.01, base.shape), 0, 1)).astype(dtype)
        for k in range(count)
    ]


def encode(path, codec, pixel_format, frames, options):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixel_format
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace, context.color_range = 1, 13, 1, 1
        for picture in frames:
            frame = av.VideoFrame.from_ndarray(picture, "rgb24" if picture.dtype == np.uint8 else "rgb48le")
            frame = frame.reformat(format=pixel_format, dst_colorspace="ITU709", dst_color_range="MPEG")
            frame.color_primaries, frame.color_trc = 1, 13
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def inputs(count, folder):
    eight, sixteen = pictures(count, np.uint8), pictures(count, np.uint16)
    array = np.stack(eight)
    yield "array, 8 bit RGB", array, {"fps": FPS, "transfer": "srgb"}
    yield "array, 16 bit RGB", np.stack(sixteen), {"fps": FPS, "transfer": "srgb"}
    encode(folder / "a.mp4", "libx264", "yuv420p", eight, {"preset": "ultrafast", "qp": "18"})
    yield "H.264, 8 bit 4:2:0", folder / "a.mp4", {}
    encode(
        folder / "b.mp4", "libx265", "yuv420p10le", sixteen, {"preset": "ultrafast", "x265-params": "log-level=none"}
    )
    yield "H.265, 10 bit 4:2:0", folder / "b.mp4", {}


class Kept:
    """A reader whose pictures have been read already."""

    def __init__(self, reader):
        self.pictures = [reader.read(k) for k in range(reader.count)]

    def read(self, index):
        return self.pictures[index]

    def close(self):
        pass


def timed(work, repeat):
    """Least wall-clock and least processor time of `repeat` runs after one that compiles, s."""
    import drjit as dr

    spent = []
    for _ in range(repeat + 1):
        start = time.perf_counter(), time.process_time()
        work()
        dr.sync_thread()
        spent.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return np.min(spent[1:], axis=0)


def measure(source, options, repeat):
    """Reading time of a picture (s), and (wall-clock, processor) time per picture of each kind of work (s)."""
    import drjit as dr

    from hesim_render.pixels.evs.stage import EvsStage

    colour = hr.load_sensor("eiger").crop(WIDTH, HEIGHT)
    mono = hr.load_sensor("reference-mono", {"geometry.rows": HEIGHT, "geometry.cols": WIDTH})
    whole = np.arange(WIDTH * HEIGHT, dtype=np.uint32)
    flux = VideoFlux(source, colour, VideoOptions.of(**options))
    start = time.perf_counter()
    kept = Kept(flux._reader)
    count = len(kept.pictures)
    reading = (time.perf_counter() - start) / count
    grey = VideoFlux(source, mono, VideoOptions.of(**options))
    flux._reader = grey._reader = kept
    frame_us = int(1e6 / FPS)

    def rates(source):
        source._maps.clear()
        for k in range(count):
            yield k, source.mean_flux(whole, k * 1e6 / FPS, (k + 1) * 1e6 / FPS)[0]

    def integrate():
        total = 0.0
        for _, rate in rates(flux):
            total = total + rate
            dr.eval(total)

    def frames():
        for k, rate in rates(flux):
            colour.aps.sample_dn(rate * (frame_us * 1e-6), frame_us, 7, k).numpy()

    def events():
        stage = EvsStage(mono.evs, 7)
        for k, rate in rates(grey):
            stage.step(rate * 1e-3, frame_us * (k + 1))

    changed = {"evs.tick_us": 1250, "evs.window_us": 1000, "aps.frame_rate_hz": 24, "aps.exposure_us": 10000}
    paper = hr.load_sensor("eiger", changed).crop(WIDTH, HEIGHT)
    models = noise_models(paper)

    def capture():
        opened = VideoFlux(source, paper, VideoOptions.of(**options))
        for _ in Capture(opened, paper, *models, int(opened.clock.end_us), 7).run():
            pass
        opened.close()

    return reading, [timed(work, repeat) / count for work in (integrate, frames, events, capture)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=4)
    given = parser.parse_args()
    megapixels = WIDTH * HEIGHT * 1e-6
    print(f"{WIDTH}x{HEIGHT}, {given.pictures} pictures, {backend.select().describe()}, {os.cpu_count()} cores")
    print(
        "Mpixel/s by the clock, and in brackets per second of one core; "
        f"bounds on two cores: APS {BOUND_APS}, EVS {BOUND_EVS}"
    )
    heads = ("APS", "APS, a frame each", "EVS", "whole run")
    print(f"{'':22}{'reading':>14}" + "".join(f"{head:>20}" for head in heads) + f"{'pictures/s':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for name, source, options in inputs(given.pictures, Path(folder)):
            reading, spent = measure(source, options, given.repeat)
            cells = [f"{megapixels / wall:.0f} ({megapixels / cpu:.0f})" for wall, cpu in spent]
            print(
                f"{name:22}{reading * 1e3:11.1f} ms"
                + "".join(f"{cell:>20}" for cell in cells)
                + f"{1 / spent[-1][0]:12.0f}",
                flush=True,
            )
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9:.2f} GB")


if __name__ == "__main__":
    main()
