"""Estimated time of what a run does besides its rays: kernels, windows, noise of event pixels, frames, the audit."""

from dataclasses import replace

from hesim_render.core.backend import select
from hesim_render.core.bands import processors
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs.processes import NODES_PER_CUTOFF_PERIOD
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.renderer import Demand, Estimate

# Processor time of one thread of an AVX-512 server (`time.process_time`), of runs of `rotating-star`, `fan` and
# `colorchecker` on `eiger`, `davis346` and `imx636` at 64x48 px, and of event stages of 3,000 to 49,000 pixels.
#: Start of a run after its estimate, kernels that are on the disk included, s.
_START_S = 0.5
#: A window of the event pixels: planning and bookkeeping of the renderer, s.
_WINDOW_S = 5e-3
#: A step of the event stage, and a step of asynchronous pixels behind a photoreceptor: s, and s for each event pixel.
_STEP_S, _STEP_PIXEL_S = 0.4e-3, 0.035e-6
_BENT_STEP_S, _BENT_STEP_PIXEL_S = 2.5e-3, 0.035e-6
#: A frame, and a pixel of a frame, through noise and into its file, s.
_FRAME_S, _FRAME_PIXEL_S = 2e-2, 60e-9
#: Rays of an audit: a multiple of the run's own, and at most so many for pixels with a tick and for asynchronous ones,
#: whose units have ten windows, or this part of the run's own; its start, s.
_AUDIT_RAYS, _MOST_TICK_RAYS, _MOST_ASYNCHRONOUS_RAYS, _AUDIT_PART, _AUDIT_S = 8.0, 8e6, 24e6, 0.0625, 0.5
#: Traces of such an audit, for pixels with a tick and for asynchronous ones: those of `camera-sweep`, `rotating-star`,
#: `pendulum` and `robot-arm` on `davis346`, `gen2` and `reference-mono`, 5 to 20 ms.
_TICK_TRACES, _ASYNCHRONOUS_TRACES = 400.0, 115.0
#: Renders by several processes: time to start them, s; part of the time of one process that kernels take on one
#: processor, and part of the rest that is not divided, as processes wait for each other; what rows that two look at
#: add. Fitted to `rotating-star` on `davis346` (2 and 16 processors, and 16 with a GPU, 0.02 and 0.1 s) and on `eiger`
#: (with a GPU); judged on `camera-sweep` on `gen2` (2 processors).
_WORKERS_S, _KERNELS, _UNDIVIDED, _NEIGHBOURS = 2.5, 0.8, 0.25, 1.1
#: Memory of the process that the workers render for, bytes.
_PARENT_BYTES = 0.4e9


def with_overheads(rays: Estimate, sensor: Sensor, demand: Demand, *, audited: bool, rests: bool) -> Estimate:
    """The estimate of a whole run from that of its rays.

    Parameters
    ----------
    rays : time and number of the rays alone.
    sensor : region read out, with its event and frame pixels.
    demand : what the run asks of its source.
    audited : the run has an audit.
    rests : the light never changes, so that photoreceptors rest and windows are not rendered.

    Returns
    -------
    The estimate, right to about a factor of two where the rays are.
    """
    windows = demand.blocks.windows
    seconds = rays.seconds + _START_S + noise_seconds(sensor, demand.duration_us, windows, rests=rests)
    seconds += len(demand.exposures) * (_FRAME_S + _FRAME_PIXEL_S * sensor.layout.rows * sensor.layout.cols)
    if not rests:
        seconds += _WINDOW_S * windows
    if audited and rays.seconds > 0:
        evs = sensor.spec.evs
        has_tick = evs is None or evs.reference == "previous_sample"
        most, traces = (_MOST_TICK_RAYS, _TICK_TRACES) if has_tick else (_MOST_ASYNCHRONOUS_RAYS, _ASYNCHRONOUS_TRACES)
        # what takes fewer rays takes fewer traces
        traces *= min(1.0, rays.audit_rays / most)
        most = min(most, rays.audit_rays)
        again = min(rays.rays if rests else _AUDIT_RAYS * rays.rays, max(most, _AUDIT_PART * rays.rays))
        seconds += _AUDIT_S + again * rays.ray_s + (0.0 if rests else traces * rays.trace_s)
    return replace(rays, seconds=seconds)


def with_workers(one: Estimate, workers: int) -> Estimate:
    """The estimate of a render by several processes from that of one.

    Parameters
    ----------
    one : time and memory of a render by one process.
    workers : number of processes.
    """
    if workers == 1:
        return one
    at_once = min(workers, processors())
    # kernels use all processors, or the GPU, anyway; what the host does between them is divided
    kernels = 0.0 if select().backend == "cuda" else min(1.0, _KERNELS / processors())
    part = _NEIGHBOURS * (kernels + (1 - kernels) * (_UNDIVIDED + (1 - _UNDIVIDED) / at_once))
    # each holds the pilots of its own pixels
    memory = _PARENT_BYTES + workers * (one.peak_bytes - one.held_bytes) + one.held_bytes
    return replace(one, seconds=one.seconds * part + _WORKERS_S, peak_bytes=memory)


def noise_seconds(sensor: Sensor, duration_us: int, windows: float, *, rests: bool) -> float:
    """Time of the event stage: its steps, from window to window and to each node of the noise.

    Parameters
    ----------
    sensor, rests : as for `with_overheads`.
    duration_us, windows : length of the run, µs, and number of windows in which event pixels are sampled.
    """
    evs = sensor.spec.evs
    if evs is None:
        return 0.0
    pixels = sensor.layout.evs_pixel.size
    steps = max(windows, duration_us / evs.tick_us if evs.tick_us is not None else 0.0)
    is_asynchronous = evs.reference == "last_event"
    if is_asynchronous and evs.noise_cutoff_hz is not None:
        steps += NODES_PER_CUTOFF_PERIOD * evs.noise_cutoff_hz * duration_us * S_PER_US
    # a tick behind a photoreceptor is one step as any other
    if is_asynchronous and evs.photoreceptor is not None and not rests:
        return steps * (_BENT_STEP_S + _BENT_STEP_PIXEL_S * pixels)
    return steps * (_STEP_S + _STEP_PIXEL_S * pixels)
