"""The motion of a scene in a sensor's picture: trails, density of events, and what a recording of it would hold."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hesim_render.core.drawing import new_figure, report_style
from hesim_render.core.html import tick_text
from hesim_render.core.output import replacing
from hesim_render.core.progress import counted
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.schedule import exposures
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.truth.motion_look import MotionLook
from hesim_render.spectral.transfer import encode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

#: Bytes of a pixel of a frame with its electrons, and of an event, packed: 13.2 and 4.3 of `rotating-star` on 96x72
#: pixels of `davis346`, 32,197 events, four frames.
_FRAME_BYTES, _EVENT_BYTES = 13.0, 4.5
#: Width of a panel, and heights of a picture at least and at most, px.
_PANEL_PX, _LOW_PX, _HIGH_PX = 560, 200, 640
#: Width of a colour bar with its labels, px.
_BAR_PX = 130


def write_motion(look: MotionLook, sensor: Sensor, t_us: float, path: Path) -> None:
    """Draw what moves: the picture with trails, and beside it the density of events.

    Parameters
    ----------
    look, t_us : from `motion_look`, and its time, µs.
    sensor : the same.
    path : PNG file; replaced in one step.
    """
    rows, cols = sensor.layout.shape
    panels = 1 if look.events is None else 2
    height = int(np.clip((_PANEL_PX - _BAR_PX) * rows / cols, _LOW_PX, _HIGH_PX)) + 60
    with report_style(), replacing(path) as unfinished:
        figure = new_figure((panels * _PANEL_PX, height))
        axes = np.atleast_1d(figure.subplots(1, panels))
        _trails(look, sensor, t_us, figure, axes[0])
        if look.events is not None:
            _density(look, sensor, figure, axes[1])
        figure.savefig(unfinished, format="png", metadata={"Software": None}, dpi=100)


def _trails(look: MotionLook, sensor: Sensor, t_us: float, figure: "Figure", axes: "Axes") -> None:
    from matplotlib.collections import LineCollection

    rows, cols = sensor.layout.shape
    shown = encode(np.clip(look.picture, 0, 1).astype(np.float32), "srgb", depth=8)
    axes.imshow(shown, extent=(-0.5, cols - 0.5, rows - 0.5, -0.5), alpha=0.75)
    pieces = np.stack([look.trails[:, :-1], look.trails[:, 1:]], axis=2).reshape(-1, 2, 2)
    length_s = (look.times_us[1] - look.times_us[0]) * S_PER_US
    speed = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=-1) / length_s
    known = np.isfinite(speed)
    if known.any():
        drawn = LineCollection(list(pieces[known]), array=speed[known], cmap="plasma", linewidths=1.2)
        drawn.set_clim(0, float(np.quantile(speed[known], 0.98)))
        axes.add_collection(drawn)
        _bar(figure, axes, drawn, "speed, px/s")
    axes.set(
        xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5), xlabel="px", ylabel="px",
        title=f"the scene at {t_us * S_PER_US:g} s, and trails over {look.times_us[-1] * S_PER_US:g} s",
    )  # fmt: skip
    axes.grid(visible=False)


def _density(look: MotionLook, sensor: Sensor, figure: "Figure", axes: "Axes") -> None:
    from matplotlib.colors import LogNorm

    assert look.events is not None
    density, (rows, cols) = look.events.density_hz, sensor.layout.evs_shape
    high = max(float(density.max()), 1.0)
    image = axes.imshow(
        np.ma.masked_equal(density, 0), extent=(-0.5, cols - 0.5, rows - 0.5, -0.5), cmap="cividis",
        norm=LogNorm(max(high / 1000, 0.01), high),
    )  # fmt: skip
    axes.set_facecolor("#f2f2f2")
    axes.set(title=f"events: {_rate(look.events.mean_hz)} of all pixels, mean", xlabel="px of the event grid")
    axes.grid(visible=False)
    _bar(figure, axes, image, "events per pixel and second; none: light grey")


def _bar(figure: "Figure", axes: "Axes", drawn: "ScalarMappable", label: str) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    bar = figure.colorbar(drawn, cax=axes.inset_axes((1.02, 0, 0.035, 1)), label=label)
    bar.ax.yaxis.set_major_formatter(FuncFormatter(tick_text))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())


def _rounded(value: float, digits: int = 2) -> str:
    """A number of so many digits, never as a power of ten."""
    return f"{float(f'{value:.{digits}g}'):.15g}"


def _rate(rate_hz: float) -> str:
    return f"{_rounded(rate_hz / 1e6)} million/s" if rate_hz >= 1e5 else f"{_rounded(rate_hz)}/s"


def motion_figures(look: MotionLook, sensor: Sensor, duration_us: int) -> dict[str, float | None]:
    """Figures of what moves, and of a recording of it.

    Parameters
    ----------
    look, sensor : from `motion_look`, and its sensor.
    duration_us : length of the run, µs.

    Returns
    -------
    ``moving``, ``speed_px_per_s`` (fastest point, at the time of the picture), ``blur_px`` of an exposure,
    ``events_per_s``, ``busy_events_per_s``, ``readout_events_per_s``, ``events``, ``frames`` and ``bytes``; None for
    what the sensor does not have.
    """
    aps, evs, events = sensor.spec.aps, sensor.spec.evs, look.events
    speed = float(look.speed_px_per_s.max(initial=0.0))
    frames = None if aps is None else len(exposures(aps, sensor.layout.rows, duration_us))
    count = None if events is None else events.mean_hz * duration_us * S_PER_US
    return {
        "moving": look.moving,
        "speed_px_per_s": speed,
        "blur_px": None if aps is None else speed * aps.exposure_us * S_PER_US,
        "events_per_s": None if events is None else events.mean_hz,
        "busy_events_per_s": None if events is None else events.busy_hz,
        "readout_events_per_s": None if evs is None else evs.readout_max_events_per_s,
        "events": count,
        "frames": frames,
        "bytes": _FRAME_BYTES * (frames or 0) * sensor.layout.rows * sensor.layout.cols + _EVENT_BYTES * (count or 0.0),
    }


def motion_lines(figures: dict[str, float | None], sensor: Sensor, duration_us: int) -> list[str]:
    """These figures in words.

    Parameters
    ----------
    figures : from `motion_figures`.
    sensor, duration_us : the same.
    """
    aps, length = sensor.spec.aps, f"{duration_us * S_PER_US:g} s"
    first = (
        f"{figures['moving']:.0%} of the picture moves, at up to {_rounded(figures['speed_px_per_s'] or 0.0, 3)} px/s"
    )
    if aps is not None:
        first += f": {_rounded(figures['blur_px'] or 0.0)} px in an exposure of {aps.exposure_us / 1000:g} ms"
    lines = [first]
    mean, busy, most = (figures[name] for name in ("events_per_s", "busy_events_per_s", "readout_events_per_s"))
    if mean is not None and busy is not None:
        text = f"events: about {_rate(mean)}, 90 % of the time below {_rate(busy)}"
        if most is not None:
            text += f" (the read-out takes {_rate(most)}{': EVENTS WILL BE LOST' if busy > most else ''})"
        lines.append(f"{text}; without noise, shadows and highlights")
    of = [] if figures["frames"] is None else [counted(round(figures["frames"]), "frame")]
    of += [] if figures["events"] is None else [f"{_rounded(figures['events'])} events"]
    lines.append(
        f"a recording of {length} has about {_rounded((figures['bytes'] or 0.0) / 1e6)} MB: {' and '.join(of)}"
    )
    return lines
