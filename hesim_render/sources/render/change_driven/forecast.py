"""Forecast of the time and memory of a run, from pilot passes over a sample of the pixels."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.adaptive import pixels_at_once
from hesim_render.sources.render.change_driven.anchor import anchor_us, period_us
from hesim_render.sources.render.change_driven.event_blocks import is_between
from hesim_render.sources.render.change_driven.one_window import FEW
from hesim_render.sources.renderer import Demand, Estimate

if TYPE_CHECKING:
    from hesim_render.sources.render.change_driven.error_target import Role
    from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

#: Number of patches, side of a patch, px, and number of blocks over the run, in which rays are counted. Most rays are
#: spent on few pixels, so many small patches tell more than few large ones.
_PATCHES, _SIDE, _BLOCKS = 192, 4, 3
#: Number of pixels, where these have no neighbours of their kind.
_SINGLE = 4096
#: Memory of the program with its kernels, per window of a block and pixel processed at a time, per event pixel (its
#: pilot rays) and per frame pixel, where there are frames, bytes: fitted to the star on `davis346` and `eiger`, the
#: sweep on `gen2` and `imx636`; judged on `fan` on `dvxplorer`.
_BASE_BYTES, _WINDOW_BYTES, _EVENT_BYTES, _FRAME_BYTES = 0.6e9, 75, 500, 60
#: Of a pilot ray that is kept: its two fluxes, and its part of the statistics of its pixel.
_KEPT_BYTES = 10
#: Time of plans, statistics and copies for each ray, beside that of tracing it, s: of event pixels (`rotating-star` on
#: `davis346` and `eiger`, `camera-sweep` on `gen2`, 0.02 s each), and of frames (`camera-sweep` and `pendulum` on
#: `reference-bayer`, 0.04 s each), on two threads of AVX-512 servers.
_BESIDE_S, _FRAME_BESIDE_S = 33e-9, 15e-9
#: Rays of an audit of asynchronous pixels that see paths, which looks at changes: the median of five scenes of light
#: that bounces (`benchmarks/rows.py`) on `davis346`, and the length of these runs, µs. A shorter one has fewer units.
_PATH_AUDIT_RAYS, _PATH_AUDIT_US = 13e6, 20_000


def forecast(source: "ChangeDrivenFlux", demand: Demand) -> Estimate:
    """Forecast the time of the rays of a run, and its memory.

    Parameters
    ----------
    source : the renderer.
    demand : what the run asks of it.

    Returns
    -------
    The estimate.
    """
    is_static, event_pixel, exposures = source.is_static, demand.event_pixel, demand.exposures
    rng, look = np.random.default_rng(source.seed), source.foresight
    event_band = pixels_at_once("events", source.has_ticks, source.is_apart("events"))
    # rays of the picture and of pilots, and traces
    picture, pilots, traces, windows, beside_s = 0.0, 0.0, 0.0, 0, 0.0
    if event_pixel.size and demand.blocks.blocks:
        every, count = demand.blocks.blocks, demand.blocks.count
        if len(every) > 1 and is_between(*every[:2]):
            # the window with which a run begins costs nothing
            every, count = every[1:], count - 1
        windows = max(block.wanted.size for block in every)
        chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, _BLOCKS).astype(int))]
        patch = _sample(event_pixel, source, "events", rng)
        # the last block goes beyond the end of the run, which counts where all blocks are looked at
        is_all = len(chosen) == len(every)
        ends = [int(np.flatnonzero(b.wanted)[-1]) if is_all and b.wanted.any() else None for b in chosen]
        begin_us, end_us = anchor_us(every[0].begin_us, every[0].end_us, source.has_ticks)
        anchor = np.array([begin_us]), np.array([end_us])
        # what never changes is rendered in the first anchor alone
        alive = look.may_change(patch, *anchor)
        moving, alive_part = patch[alive], float(np.mean(alive))
        blocks = [
            look.block(moving, block.begin_us, block.end_us, "events", end)
            for block, end in zip(chosen, ends, strict=True)
        ]
        each, compared, anchors, looks = np.mean([block.rays for block in blocks], axis=0)
        # all pixels are rendered in the first anchor, and in later ones those that are compared with it
        first = look.block(patch, *anchor, "events", is_anchor=True)
        # the first window of the first block belongs to no block before it, and may be the anchor itself
        begin = 0.0
        if (begin_us, end_us) != (every[0].begin_us[0], every[0].end_us[0]):
            begin = float(look.block(moving, every[0].begin_us[:1], every[0].end_us[:1], "events").rays[0])
        # where nearly all may change, the pilot of the first anchor goes on
        saved = float(first.rays[3]) if 1 - alive_part <= FEW else 0.0
        share = np.mean([np.ptp(block.end_us) / period_us(block.end_us, source.has_ticks) for block in chosen])
        more_anchors = max(0.0, float(np.ceil(count * share)) - 1)
        rest = begin + each * count + anchors * more_anchors + compared * (1 + more_anchors)
        picture += float(first.rays[0] + alive_part * rest) * event_pixel.size
        pilots += float(first.rays[3] + alive_part * (looks * count - saved)) * event_pixel.size
        bands = np.ceil(alive_part * event_pixel.size / event_band)
        traces += float(bands * np.mean([block.traces for block in blocks]) * count)
        beside_s = (picture + pilots) * _BESIDE_S
    # frames; of a static scene each pixel once, those of events included
    pixel = demand.pixels if is_static else np.unique(demand.frame_pixel if exposures else demand.frame_pixel[:0])
    if pixel.size:
        patch = _sample(pixel, source, "any", rng)
        begin, end = (0.0, 1000.0) if not exposures else (float(exposures[0].start_us), float(exposures[0].t_us))
        frame, times = look.block(patch, np.array([begin]), np.array([end]), "any"), 1 if is_static else len(exposures)
        picture += float(frame.rays[:3].sum()) * pixel.size * times
        beside_s += float(frame.rays.sum()) * pixel.size * times * _FRAME_BESIDE_S
        pilots += float(frame.rays[3]) * pixel.size * times
        traces += frame.traces * float(np.ceil(pixel.size / pixels_at_once("any", source.has_ticks, False))) * times
    speed, rays = look.speed(), picture + pilots
    path_audit = _PATH_AUDIT_RAYS * min(1.0, demand.duration_us / _PATH_AUDIT_US)
    # pilots are kept where another block comes
    kept = _KEPT_BYTES * source.kept_rays if demand.blocks.count > 1 else 0
    held = (_EVENT_BYTES + kept) * event_pixel.size
    return Estimate(
        seconds=picture * speed.picture_ray_s + pilots * speed.pilot_ray_s + beside_s + traces * speed.start_s,
        peak_bytes=_BASE_BYTES
        + _WINDOW_BYTES * windows * min(event_pixel.size, event_band)
        + held
        + (_FRAME_BYTES * demand.frame_pixel.size if exposures else 0),
        rays=rays,
        held_bytes=held,
        audit_rays=path_audit if source.sees_paths and not source.has_ticks else float("inf"),
        ray_s=speed.picture_ray_s + _BESIDE_S,
        trace_s=speed.start_s,
    )


def _sample(
    pixel: NDArray[np.uint32], source: "ChangeDrivenFlux", role: "Role", rng: np.random.Generator
) -> NDArray[np.uint32]:
    """Listed pixels in some small squares, which keep neighbours together, as in the run; single ones without
    neighbours.
    """
    is_apart = source.is_apart(role)
    count = min(_SINGLE if is_apart else _PATCHES, pixel.size)
    # one of each part of the list, so that all rows are seen
    chosen = np.unique(((np.arange(count) + rng.random(count)) * (pixel.size / count)).astype(np.int64))
    if is_apart:
        return pixel[chosen]
    row, col = np.divmod(pixel.astype(np.int64), source.sensor.cols)
    side = _SIDE * max(1.0, np.sqrt(source.sensor.rows * source.sensor.cols / pixel.size))
    is_inside = np.zeros(pixel.size, np.bool_)
    for centre in chosen:
        is_inside |= (np.abs(row - row[centre]) <= side / 2) & (np.abs(col - col[centre]) <= side / 2)
    return pixel[is_inside]
