"""Our sensor and other event simulators in the same light, compared with the events of noise-free pixels."""

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render import __version__
from hesim_render.benchmark.metrics import chamfer, count_error, quiet_rates, timing
from hesim_render.benchmark.peer_run import (
    exposures_us,
    pictures,
    program_of,
    run_peer,
    version_of,
    write_pictures,
    write_settings,
)
from hesim_render.benchmark.plan import chosen_sensor, file_of
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import HesimError, SpecError
from hesim_render.core.guard import printable
from hesim_render.core.output import check_place, write_whole
from hesim_render.core.plain import as_plain
from hesim_render.core.progress import Progress
from hesim_render.exchange import EventStream
from hesim_render.measure.event_distance import event_distances
from hesim_render.measure.event_statistics import EventStatistics, event_statistics
from hesim_render.pixels.evs.events import no_events
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.scene import Scene, load_scene
from hesim_render.specs.peers import Peer, PeersSpec, read_peers

OURS = "hesim_render"


@dataclass(frozen=True)
class _Ours:
    """What our sensor gives: its events, those of its noise-free pixels, and the error of the render."""

    events: NDArray[np.void]
    truth: NDArray[np.void]
    error: dict[str, float] | None
    seconds: float

    def between(self, first_us: float, last_us: float) -> tuple[NDArray[np.void], NDArray[np.void]]:
        return _between(self.events, first_us, last_us), _between(self.truth, first_us, last_us)


def compare_peers(
    spec: PeersSpec | str | Path,
    out: str | Path | None = None,
    progress: Progress | None = None,
    *,
    run_programs: bool = False,
) -> dict[str, Any]:
    """Give the same light to our sensor and to other simulators, and compare their events with the noise-free ones.

    Parameters
    ----------
    spec : the comparison, or the path of its YAML file.
    out : JSON file of the result; None writes none. It is replaced if it exists.
    progress : called with (done, total, what).
    run_programs : True lets the programs run that the specification names. A file from somebody else may name any.

    Returns
    -------
    ``peers``: version of each, or why it was not run; ``rows``: measures by scene, rate of pictures and peer;
    ``sensor``, ``settings`` and ``render_error``.

    Raises
    ------
    SpecError
        If the specification is not valid, the sensor has no event pixels, or programs may not run.
    OutputError
        If `out` cannot be written.
    """
    spec = spec if isinstance(spec, PeersSpec) else read_peers(spec)
    if not run_programs:
        named = "; ".join(" ".join(peer.command) for peer in spec.peers)
        raise SpecError(
            f"this runs the programs that the file names ({printable(named)}); if you trust them, give --run-programs "
            "(run_programs=True)",
            key="peers",
        )
    target = None if out is None else check_place(out)
    sensor = chosen_sensor(spec.sensor, spec.folder, "sensor.sensor", spec.sensor.set)
    if sensor.spec.evs is None:
        raise SpecError(f"{sensor.name} has no event pixels", key="sensor")
    scenes = [load_scene(file_of(spec.folder, name, f"scenes.{k}")) for k, name in enumerate(spec.scenes)]
    facts = {OURS: {"version": __version__}} | {peer.name: _version_of(peer, spec.folder) for peer in spec.peers}
    able = [peer for peer in spec.peers if "version" in facts[peer.name]]
    rows: list[dict[str, Any]] = []
    errors = {}
    total, done = len(scenes) * (1 + len(spec.fps)), 0
    for name, scene in zip(spec.scenes, scenes, strict=True):
        ours = _our_events(scene, sensor, spec)
        errors[name] = ours.error
        for fps in spec.fps:
            done += 1
            if progress is not None:
                progress(done, total, "runs")
            rows += _rows(name, scene, sensor, spec, fps, ours, able)
        done += 1
    settings = spec.model_dump(mode="json", exclude={"peers", "sensor"})
    result = {
        "settings": settings, "sensor": sensor.name, "shape": list(sensor.layout.evs_shape), "peers": facts,
        "render_error": errors, "rows": rows,
    }  # fmt: skip
    if target is not None:
        write_whole(target, json.dumps(as_plain(result), indent=1) + "\n")
    return result


def _version_of(peer: Peer, folder: Path) -> dict[str, str]:
    """Version of a peer, or why there is none."""
    if program_of(peer, folder) is None:
        return {"missing": f"{peer.command[0]} is not installed here"}
    try:
        return {"version": version_of(peer, folder)}
    except HesimError as error:
        return {"failed": str(error)}


def _our_events(scene: Scene, sensor: Sensor, spec: PeersSpec) -> _Ours:
    begin = time.monotonic()
    flux = scene_renderer(in_absolute_light(scene)[0], sensor, spec.seed, spec.quality)
    _, evs = noise_models(sensor)
    capture = Capture(flux, sensor, None, evs, spec.duration_us, spec.seed, labels=True)
    events = np.concatenate([no_events(), *(item for item in capture.run() if isinstance(item, np.ndarray))])
    assert capture.labeller is not None
    truth = capture.labeller.taken().clean
    return _Ours(events, truth, capture.errors["events"].as_dict(spec.quality), time.monotonic() - begin)


def _between(events: NDArray[np.void], first_us: float, last_us: float) -> NDArray[np.void]:
    return events[(events["t_us"] > first_us) & (events["t_us"] <= last_us)]


def _rows(
    name: str, scene: Scene, sensor: Sensor, spec: PeersSpec, fps: float, ours: _Ours, peers: Sequence[Peer]
) -> list[dict[str, Any]]:
    """Measures of our sensor and of every peer on one scene at one rate of pictures.

    Only the time from the middle of the first picture to that of the last one counts, for all.
    """
    times = exposures_us(spec.duration_us, fps, spec.shutter)
    first, last = float(times[0].mean()), float(times[-1].mean())
    shape = sensor.layout.evs_shape
    events, truth = ours.between(first, last)
    expected = _statistics(truth, shape, first, last)

    def row(peer: str, made: NDArray[np.void], seconds: float) -> dict[str, Any]:
        return {
            "scene": name, "fps": fps, "peer": peer, "events": len(made), "true_events": len(truth),
            "count_error": count_error(made, truth), **timing(made, truth, shape, spec.match_us),
            **quiet_rates(made, truth, shape, last - first), "chamfer_px": chamfer(made, truth), "seconds": seconds,
            **_distances(expected, _statistics(made, shape, first, last)),
        }  # fmt: skip

    rows = [row(OURS, events, ours.seconds)]
    if not peers:
        return rows
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        given = pictures(scene, sensor, times, spec.seed, spec.quality)
        written = write_pictures(folder, given, times, [(peer.encoding, peer.bits) for peer in peers])
        for peer in peers:
            given_to = written[peer.encoding, peer.bits]
            write_settings(given_to, _settings(peer, sensor, spec, fps))
            out = folder / f"{peer.name}.npy"
            try:
                made, seconds = run_peer(peer, spec.folder, given_to, out, shape, spec.duration_us)
            except HesimError as error:
                rows.append({"scene": name, "fps": fps, "peer": peer.name, "error": str(error)})
                continue
            rows.append(row(peer.name, _between(made, first, last), seconds))
    return rows


def _statistics(
    events: NDArray[np.void], shape: tuple[int, int], first_us: float, last_us: float
) -> EventStatistics | str:
    """Statistics of events, or why there are none."""
    stream = replace(EventStream.of(events, shape), interval_us=(int(first_us), int(np.ceil(last_us)) + 1))
    try:
        return event_statistics(stream)
    except SpecError as error:
        return str(error)


def _distances(truth: EventStatistics | str, made: EventStatistics | str) -> dict[str, Any]:
    """Distances from the true events, as `compare` has them, and the figures in which a peer differs from them."""
    for one, whose in ((truth, "true events"), (made, "events")):
        if isinstance(one, str):
            return {"distances": {}, "loses": None, "no_distances": f"{whose}: {one}"}
    assert not isinstance(truth, str) and not isinstance(made, str)
    result = event_distances(truth, made)
    return {
        "distances": {one.name: {"value": one.value, "interval_95": list(one.interval_95), "within": one.within,
                                 "differs": one.differs} for one in result},
        "loses": [one.name for one in result if one.differs],
    }  # fmt: skip


def _settings(peer: Peer, sensor: Sensor, spec: PeersSpec, fps: float) -> dict[str, Any]:
    """What a peer is given: the pictures, and the figures of the sensor that it may have as well."""
    evs = sensor.spec.evs
    assert evs is not None
    rows, cols = sensor.layout.evs_shape
    return {
        "width": cols, "height": rows, "duration_us": spec.duration_us, "fps": fps, "encoding": peer.encoding,
        "bits": peer.bits, "contrast_threshold_on": evs.contrast_threshold_on,
        "contrast_threshold_off": evs.contrast_threshold_off, "threshold_mismatch_rel": evs.threshold_mismatch_rel,
        "leak_rate_hz": evs.leak.rate_hz if evs.leak else evs.leak_rate_hz,
        "refractory_period_us": evs.refractory_period_us or 0,
        "seed": spec.seed, "noise": peer.noise, "options": peer.options,
    }  # fmt: skip


#: Columns of the table: name, key, scale and format.
_COLUMNS = (
    ("events", "events", 1, "d"), ("count error %", "count_error", 100, "+.1f"), ("missed %", "missed", 100, ".1f"),
    ("extra %", "extra", 100, ".1f"), ("delay µs", "delay_us", 1, "+.0f"), ("|Δt| µs", "timing_us", 1, ".0f"),
    ("90 % µs", "timing_90_us", 1, ".0f"), ("still ON Hz", "quiet_on_hz", 1, ".3g"),
    ("still OFF Hz", "quiet_off_hz", 1, ".3g"), ("chamfer px", "chamfer_px", 1, ".2f"),
)  # fmt: skip


def peers_table(result: dict[str, Any]) -> str:
    """The result of `compare_peers` as a Markdown table, one block for each scene and rate of pictures."""
    lines = []
    groups = dict.fromkeys((row["scene"], row["fps"]) for row in result["rows"])
    for scene, fps in groups:
        rows = [row for row in result["rows"] if (row["scene"], row["fps"]) == (scene, fps)]
        lines += [f"{scene}, {fps:g} pictures/s, {rows[0]['true_events']} true events", ""]
        lines += ["| | " + " | ".join(name for name, *_ in _COLUMNS) + " |", "|---" * (len(_COLUMNS) + 1) + "|"]
        for row in rows:
            cells = [_cell(row, key, scale, form) for _, key, scale, form in _COLUMNS]
            cells = [f"failed: {row['error']}"] if "error" in row else cells
            lines.append(f"| {row['peer']} | {' | '.join(cells)} |")
        lines += ["", *_distance_lines(rows)]
    for name, facts in result["peers"].items():
        lines.append(f"{name}: " + "; ".join(f"{key} {value}" for key, value in facts.items()))
    return "\n".join(lines)


def _distance_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Table of the distances of `compare` from the true events, and what each peer loses."""
    names = next((list(row["distances"]) for row in rows if row.get("distances")), [])
    if not names:
        return []
    lines = ["| distance from the true events | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for row in rows:
        result = row.get("distances") or {}
        cells = [
            f"{result[name]['value']:.3g}{'*' if result[name]['differs'] else ''}" if result else "–" for name in names
        ]
        lines.append(f"| {row['peer']} | {' | '.join(cells)} |")
    lines += ["", "*: more than parts of the true events differ from one another", ""]
    for row in rows:
        if row.get("no_distances"):
            lines.append(f"{row['peer']}: {row['no_distances']}")
    return lines


def _cell(row: dict[str, Any], key: str, scale: float, form: str) -> str:
    value = row.get(key)
    if value is None or not np.isfinite(value):
        return "–"
    return format(value if form == "d" else scale * value, form)
