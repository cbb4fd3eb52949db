"""Running another event simulator in a process of its own: the pictures that it takes, and the events that it writes.

Pictures are the light of a scene as numbered PNG files, with their time stamps.
"""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import HesimError
from hesim_render.core.guard import printable
from hesim_render.core.npz import read_array
from hesim_render.core.units import US_PER_S
from hesim_render.mosaic.schedule import BLOCK_INTERVALS, Block
from hesim_render.pixels.evs.events import events_of
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.scene import Scene
from hesim_render.specs.peers import Peer
from hesim_render.spectral.transfer import encode_exactly

#: Time that a program has to tell its version, s.
_VERSION_S = 120.0
#: Variables that would let the program import from this one's environment.
_OURS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
TIMES_FILE, SETTINGS_FILE = "timestamps.txt", "settings.json"
#: The brightest half percent of the first picture becomes this part of full scale.
_PERCENTILE, _WHITE = 99.5, 0.95


class PeerError(HesimError):
    """A peer that is there, but did not do what it should."""


def program_of(peer: Peer, folder: Path) -> str | None:
    """Path of the program of a peer whose file is in `folder`; None if it is not installed here."""
    first = peer.command[0]
    if len(Path(first).parts) > 1:
        path = (folder / Path(first).expanduser()).absolute()  # a link into a virtual environment is not followed
        return str(path) if os.access(path, os.X_OK) and path.is_file() else None
    return shutil.which(first)


def _run(peer: Peer, folder: Path, arguments: list[str], limit_s: float) -> str:
    """Run the program; returns its standard output.

    Raises
    ------
    PeerError
        If it fails, with the last line that it wrote, or takes too long.
    """
    program = program_of(peer, folder)
    if program is None:
        raise PeerError(f"{peer.command[0]}: no such program")
    environment = {key: value for key, value in os.environ.items() if key not in _OURS}
    process = subprocess.Popen(
        [program, *peer.command[1:], *arguments], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", start_new_session=True,
    )  # fmt: skip
    try:
        output, errors = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise PeerError(f"took more than {limit_s:g} s") from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # its own children as well
            process.communicate()
    if process.returncode:
        lines = [line for line in errors.splitlines() if line.strip()]
        last = printable(lines[-1][:300]) if lines else "it printed nothing"
        raise PeerError(f"exit status {process.returncode}: {last}")
    return output


def version_of(peer: Peer, folder: Path) -> str:
    """What the program answers to ``--version``, on one line."""
    lines = _run(peer, folder, ["--version"], min(_VERSION_S, peer.timeout_s)).split("\n")
    return printable(lines[0].strip()[:100]) or "unknown"


def run_peer(
    peer: Peer, folder: Path, pictures: Path, out: Path, shape: tuple[int, int], duration_us: float
) -> tuple[NDArray[np.void], float]:
    """Let a peer make events from pictures: ``COMMAND PICTURES OUT``; returns them, and its time with its start, s.

    Parameters
    ----------
    peer, folder : the peer, and the folder of the file that names it, where it runs.
    pictures : folder from `write_pictures`.
    out : the ``.npy`` file that it is to write.
    shape, duration_us : of the pictures; events outside are an error.

    Raises
    ------
    PeerError
        If the program fails, or what it wrote are no such events.
    """
    begin = time.monotonic()
    _run(peer, folder, [str(pictures), str(out)], peer.timeout_s)
    seconds = time.monotonic() - begin
    return read_events(out, shape, duration_us), seconds


def read_events(path: Path, shape: tuple[int, int], duration_us: float) -> NDArray[np.void]:
    """Events of a ``.npy`` file: [event, 4] with the columns t (µs), x, y, polarity (1; 0 or -1 for OFF).

    Parameters
    ----------
    path : the file.
    shape : rows and columns that x and y must fit into.
    duration_us : latest time, µs.

    Raises
    ------
    PeerError
        If it is missing, or its content is not of this form; the message names the first wrong value.
    """
    if not path.is_file():
        raise PeerError("wrote no events file")
    table = read_array(path)
    if table.ndim != 2 or table.shape[1] != 4 or table.dtype.kind not in "iuf":
        raise PeerError(f"wrote {table.dtype} {list(table.shape)}; expected numbers [event, 4]")
    rows, cols = shape
    limits = {"t_us": (0, duration_us), "x": (0, cols - 1), "y": (0, rows - 1), "polarity": (-1, 1)}
    for column, (name, (low, high)) in enumerate(limits.items()):
        values = table[:, column]
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if wrong.size:
            raise PeerError(f"wrote {name} {values[wrong[0]]:g} in event {wrong[0]}; expected {low:g} to {high:g}")
    events = events_of(np.rint(table[:, 0]), *table[:, 1:].T)
    return events[np.argsort(events["t_us"], kind="stable")]


def exposures_us(duration_us: int, fps: float, shutter: float) -> NDArray[np.float64]:
    """Begin and end of each picture's exposure, [picture, 2], µs; all lie within the run.

    Parameters
    ----------
    duration_us : of the run, µs.
    fps : pictures per second.
    shutter : share of a picture's period that it is exposed.
    """
    period = US_PER_S / fps
    begin = np.arange(int(np.floor(duration_us / period + 1e-9))) * period
    return np.column_stack([begin, begin + shutter * period])


def pictures(
    scene: Scene, sensor: Sensor, times_us: NDArray[np.float64], seed: int, quality: float
) -> Iterator[NDArray[np.float32]]:
    """Mean flux of the event pixels in each exposure, [y, x], e⁻/s.

    Parameters
    ----------
    scene, sensor, seed, quality : as of the run of the sensor itself, which sees the same light.
    times_us : begin and end of the exposures, [picture, 2], µs.
    """
    layout = sensor.layout
    flux = scene_renderer(in_absolute_light(scene)[0], sensor, seed, quality)
    source = with_crosstalk(flux, layout.shape, sensor.evs.crosstalk)
    for sample in source.flux_of_blocks(layout.evs_pixel.ravel(), _blocks(times_us)):
        mean = 0.5 * (np.array(sample.half_a, dtype=np.float32) + np.array(sample.half_b, dtype=np.float32))
        yield mean.reshape(layout.evs_shape)


def _blocks(times_us: NDArray[np.float64]) -> Iterator[Block]:
    """The exposures as windows of a source; a block begins with the last window of the block before."""
    yield Block(times_us[:1, 0], times_us[:1, 1], np.ones(1, np.bool_))
    for first in range(0, len(times_us) - 1, BLOCK_INTERVALS):
        part = times_us[first : first + BLOCK_INTERVALS + 1]
        wanted = np.ones(len(part), np.bool_)
        wanted[0] = False
        yield Block(part[:, 0], part[:, 1], wanted)


def encoded(picture: NDArray[np.float32], white: float, encoding: str, bits: int) -> NDArray[Any]:
    """Codes of a picture, uint8 or uint16, rounded.

    Parameters
    ----------
    picture : [y, x], e⁻/s.
    white : flux of full scale; brighter pixels are clipped.
    encoding : ``linear`` or ``srgb``.
    bits : 8 or 16.
    """
    values = np.clip(picture.astype(np.float64) / white, 0, 1)
    if encoding == "srgb":
        values = encode_exactly(values)
    return np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def write_pictures(
    folder: Path,
    given: Iterator[NDArray[np.float32]],
    times_us: NDArray[np.float64],
    kinds: Sequence[tuple[str, int]],
) -> dict[tuple[str, int], Path]:
    """Write pictures once for every kind of encoding, as they come.

    Each folder has ``000000.png``, … (grey) and ``timestamps.txt`` (the middle of each exposure, µs, one a line).

    Parameters
    ----------
    folder : holds a folder for each kind.
    given : [y, x] each, e⁻/s.
    times_us : begin and end of each exposure, [picture, 2], µs.
    kinds : encodings and numbers of bits.
    """
    from PIL import Image

    folders = {kind: folder / f"{kind[0]}{kind[1]}" for kind in dict.fromkeys(kinds)}
    for path in folders.values():
        path.mkdir(parents=True)
    white = 1.0
    for number, picture in enumerate(given):
        if number == 0:
            white = max(float(np.percentile(picture, _PERCENTILE)) / _WHITE, 1e-30)
        for kind, path in folders.items():
            Image.fromarray(encoded(picture, white, *kind)).save(path / f"{number:06d}.png")
    middles = "".join(f"{t:.3f}\n" for t in times_us.mean(axis=1))
    for path in folders.values():
        (path / TIMES_FILE).write_text(middles, encoding="utf-8")
    return folders


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write ``settings.json`` beside pictures: the settings of the next program."""
    (folder / SETTINGS_FILE).write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
