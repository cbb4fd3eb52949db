"""A made-up recording: what the noise stages would give, without running them."""

from types import SimpleNamespace

import numpy as np

from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording.frame import Frame
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.lens import Lens, response
from hesim_render.sensor.reading import read_sensor


def sensor_like(name, width=128, height=96):
    """What the writer reads of a Sensor, without event pixels' noise models."""
    spec = read_sensor(name)
    layout = Layout.full(spec).crop(width, height)
    lens = Lens.of(spec)
    responses = {name: response(spec, name, lens) for name in spec.filters}
    aps = None if spec.aps is None else ApsNoise(spec.aps, layout, spec.device_seed)
    return SimpleNamespace(spec=spec, layout=layout, lens=lens, file=str(name), responses=responses, aps=aps)


def frame_of(sensor, index=0, seed=3):
    """Colour bars with a gradient, shot noise and invalid event pixels."""
    rng = np.random.default_rng(seed + index)
    layout, aps = sensor.layout, sensor.spec.aps
    rows, cols = layout.shape
    x = np.broadcast_to(np.linspace(0, 1, cols), (rows, cols))
    y = np.broadcast_to(np.linspace(0.2, 1, rows)[:, None], (rows, cols))
    level = np.stack([((x * 6).astype(int) >> k & 1) * 0.8 + 0.1 for k in range(8)])
    signal = level[layout.filter_index % 3, np.arange(rows)[:, None], np.arange(cols)] * y * 0.8 * aps.full_well_e
    valid = layout.aps_mask
    electrons = np.where(valid, signal, np.nan).astype(np.float32)
    dn = aps.black_level_dn + aps.system_gain_dn_per_e * rng.poisson(signal)
    raw = np.where(valid, np.clip(np.rint(dn), 0, 2**aps.bit_depth - 1), 0).astype(np.uint16)
    start = round(index * 1e6 / aps.frame_rate_hz)
    return Frame(
        raw=raw,
        valid=valid,
        electrons_mean=electrons,
        electrons_stderr=electrons * np.float32(0.001),
        t_us=start + aps.exposure_us,
        exposure_start_us=start,
        exposure_us=aps.exposure_us,
        line_time_us=aps.line_time_us,
        index=index,
    )


def events_of(sensor, duration_us, count=20_000, seed=5):
    rng = np.random.default_rng(seed)
    rows, cols = sensor.layout.evs_shape
    events = np.empty(count, dtype=EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, duration_us + 1, count))
    angle = events["t_us"] / duration_us * 2 * np.pi
    radius = rng.uniform(0.05, 0.45, count)
    events["x"] = ((0.5 + radius * np.cos(angle)) * cols).astype(int)
    events["y"] = ((0.5 + radius * np.sin(angle)) * rows).astype(int)
    events["polarity"] = rng.choice([-1, 1], count)
    return events


def fill(writer, sensor, frames, duration_us, count=20_000, block=3000):
    for k in range(frames):
        writer.add_frame(frame_of(sensor, k))
    if min(sensor.layout.evs_shape) > 0:
        events = events_of(sensor, duration_us, count)
        for first in range(0, count, block):
            writer.add_events(events[first : first + block])
        flux = np.linspace(1, 1000, events_shape_size(sensor), dtype=np.float32)
        writer.set_event_truth(flux, flux * 0.01)
    return writer.finish()


def events_shape_size(sensor):
    rows, cols = sensor.layout.evs_shape
    return rows * cols


def make(name="eiger", path=None, frames=2, duration_us=250_000, **options):
    size = {"width": options.pop("width", 128), "height": options.pop("height", 96)}
    sensor = sensor_like(name, **size)
    with RecordingWriter(path, sensor, seed=7, duration_us=duration_us, **options) as writer:
        return fill(writer, sensor, frames, duration_us)
