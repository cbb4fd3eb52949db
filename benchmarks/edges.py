"""Error of rays about fitted lines against that of rays all over the pixel, by contrast of the edge.

    python benchmarks/edges.py [SCENE SENSOR WxH MS]

Pairs of pixels and windows that change in a run of MS milliseconds are drawn at random. The truth is 4 x 4096 rays of
another stream; its own error is subtracted. Errors are rms, in units of the sensor's noise. 64 or 128 decision rays of
each pair are not among those that are printed.
"""

import sys

import numpy as np

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import TERMS, noise_models
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows

PAIRS, CONTRASTS, RAYS = 3000, (5, 100, 300, 3000), (64, 128, 256)


def changing_pairs(source, sensor, duration_us):
    """Mosaic indices and windows of random pairs of pixels whose flux changes by 3 units, and all windows."""
    capture = Capture(source, source.sensor, *noise_models(sensor, False, (), TERMS), duration_us, 7)
    blocks = capture.sample_of_event_blocks().blocks
    begin, end = (np.concatenate([getattr(b, f"{name}_us")[b.wanted] for b in blocks]) for name in ("begin", "end"))
    flux = np.array([np.array(s.half_a) for s in source.flux_of_blocks(capture.event_pixels, iter(blocks))])
    unit = source.noise_unit(capture.event_pixels, flux[:1].astype(float), True)[0]
    changing = capture.event_pixels[np.ptp(flux, axis=0) > 3 * unit]
    rng = np.random.default_rng(1)
    pixel, window = rng.choice(changing, PAIRS), rng.integers(1, begin.size, PAIRS)
    return pixel, window, Windows(begin, end)


def main(scene="rotating-star", sensor="davis346", region="96x72", milliseconds="8"):
    loaded = hr.load_sensor(sensor).crop(*map(int, region.split("x")))
    source = ChangeDrivenFlux(hr.load_scene(scene), loaded, seed=7)
    pixel, window, windows = changing_pairs(source, loaded, round(1000 * float(milliseconds)))
    tracer, index, controlled = source._tracer, source._index[pixel], np.ones(PAIRS, np.bool_)
    truth = np.stack([
        tracer.trace(index, window, windows, np.full(PAIRS, 4096), controlled, Stream.AUDIT, repeat=k).mean
        for k in range(4)
    ]).astype(float)  # fmt: skip
    unit = source.noise_unit(pixel, truth.mean(axis=0)[None], True)[0]
    own = truth.std(axis=0, ddof=1) / 2 / unit

    def rms(some, rays, edges=None):
        got = tracer.trace(index[some], window[some], windows, np.full(some.size, rays), controlled[some], edges=edges)
        error = (got.mean - truth.mean(axis=0)[some]) / unit[some]
        return np.sqrt(max(0, np.mean(error**2) - np.mean(own[some] ** 2)))

    fit = tracer.edges(index, window, windows, 64, 1.5, controlled)
    contrast = (fit.high - fit.low) * tracer.axis_factor(index) / unit
    share = 100 * fit.is_edge.mean()
    print(f"{scene}, {sensor} {region}, {milliseconds} ms: {share:.0f} % of changing pairs hold an edge")
    for low, high in zip(CONTRASTS, CONTRASTS[1:], strict=False):
        some = np.flatnonzero(fit.is_edge & (contrast >= low) & (contrast < high))
        if some.size < 20:
            continue
        told = [f"{n}: {rms(some, n, fit.models(some)):.2f} (plain {4 * n}: {rms(some, 4 * n):.2f})" for n in RAYS]
        share = 100 * some.size / PAIRS
        print(f"  contrast {low} to {high} units, {share:.0f} % of pairs; rms with n rays " + ", ".join(told))


if __name__ == "__main__":
    main(*sys.argv[1:])
