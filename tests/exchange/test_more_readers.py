"""Event files read by more libraries of others, where they are installed: evutils and dv-processing."""

import numpy as np
import pytest
from event_files import SHAPE, columns, joined, made, many, written

EVENTS = {
    "one": made((0, 0, 0, 1)),
    "corners": made((5, 1279, 719, -1), (5, 0, 0, -1), (5, 1279, 0, 1)),
    "turns": made(*((max(0, (1 << k) + step), 3, 4, 1) for k in (6, 12, 24, 25, 32, 34, 40) for step in (-1, 0, 1))),
    "many": many(20_000, 1 << 26),
    "days": many(5000, 1 << 40, seed=4),
}


@pytest.mark.parametrize("events", EVENTS.values(), ids=EVENTS)
@pytest.mark.parametrize("name", ["evt2", "evt3", "aedat4", "dsec", "npz"])
def test_evutils_reads_the_exact_events(name, events, tmp_path):
    reader = pytest.importorskip("evutils.io").EventReader
    if name == "dsec" and events["t_us"][-1] >= 1 << 32:
        pytest.skip("times of this form are 32 bits")
    path = written(events, name, tmp_path)
    found = reader(path, mode="all", max_time=1 << 62).read()
    np.testing.assert_array_equal(
        columns(*(np.asarray(getattr(found, key)).astype(np.int64) for key in "txyp")), events
    )


@pytest.mark.parametrize("events", EVENTS.values(), ids=EVENTS)
def test_dv_processing_reads_the_exact_events(events, tmp_path):
    io = pytest.importorskip("dv_processing").io
    recording = io.MonoCameraRecording(str(written(events, "aedat4", tmp_path)))
    assert recording.isEventStreamAvailable() and recording.getEventResolution() == SHAPE[::-1]
    parts = []
    while recording.isRunning() and (batch := recording.getNextEventBatch()) is not None:
        part = batch.numpy()
        parts.append(columns(*(part[key] for key in ("timestamp", "x", "y", "polarity"))))
    np.testing.assert_array_equal(joined(parts), events)
