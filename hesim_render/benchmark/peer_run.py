"""Running another event simulator in a process of its own, and reading the events that it writes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import HesimError
from hesim_render.core.guard import printable
from hesim_render.core.npz import read_array
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.specs.peers import Peer

#: Time that a program has to tell its version, s.
_VERSION_S = 120.0
#: Variables that would let the program import from this one's environment.
_OURS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")


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
    events = np.empty(len(table), EVENT_DTYPE)
    events["t_us"], events["x"], events["y"] = np.rint(table[:, 0]), table[:, 1], table[:, 2]
    events["polarity"] = np.where(table[:, 3] > 0, 1, -1)
    return events[np.argsort(events["t_us"], kind="stable")]
