"""A recording as the npz files of H-ESIM and RGB-Event-ISP: frames, and one picture of events for each tick."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded


def write_tick_files(recording: Recorded, folder: Path, tick_us: int | None) -> int:
    """Write ``TTTTTTTTT_aps_raw.npz`` and ``TTTTTTTTT_evs.npz``, with the time in µs in nine digits.

    H-ESIM has frames as ``raw`` and events as ``events``, -1, 0 or +1; RGB-Event-ISP has ``aps_raw`` and ``event_raw``,
    0, 1 (OFF) or 2 (ON). Each file has both. Of two events of a pixel in one tick the later one counts.

    Parameters
    ----------
    recording, folder : the recording, and a folder, which is made.
    tick_us : interval of the comparisons, µs; None writes frames alone.

    Returns
    -------
    The number of frames.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for frame in recording.frames:
        np.savez_compressed(folder / f"{frame.t_us:09d}_aps_raw.npz", raw=frame.raw, aps_raw=frame.raw)
    if tick_us is None:
        return len(recording.frames)
    for tick in range(tick_us, recording.duration_us + 1, tick_us):
        result = recording.event_slice(tick - tick_us + 1, tick + 1)
        signs = np.zeros(recording.event_shape, np.int8)
        signs[result["y"], result["x"]] = result["polarity"]
        codes = np.select([signs > 0, signs < 0], [2, 1], 0).astype(np.uint8)
        np.savez_compressed(folder / f"{tick:09d}_evs.npz", events=signs, event_raw=codes)
    return len(recording.frames)
