"""Event files read by more libraries of others: faery, evutils, eventcv, dv-processing and evio.

Continuous integration installs all of them (extra ``test``) and lets none of these tests be skipped.
"""

import importlib
import os

import hdf5plugin
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


def library(name):
    """A library; where all of them must be there, that it is missing is a failure."""
    if os.environ.get("HESIM_RENDER_ALL_READERS"):
        return importlib.import_module(name)
    return pytest.importorskip(name)


def by_faery(path):
    parts = library("faery").events_stream_from_file(path)
    return joined(columns(*(part[key] for key in ("t", "x", "y", "on"))) for part in parts)


def by_evutils(path):
    found = library("evutils.io").EventReader(path, mode="all", max_time=1 << 62).read()
    return columns(*(np.asarray(getattr(found, key)).astype(np.int64) for key in "txyp"))


def by_eventcv(path):
    x, y, t, p = library("eventcv").load(str(path), sensor_size=SHAPE[::-1]).numpy().T
    return columns(t, x, y, p)


def by_dv_processing(path):
    recording = library("dv_processing").io.MonoCameraRecording(str(path))
    assert recording.isEventStreamAvailable() and recording.getEventResolution() == SHAPE[::-1]
    parts = []
    while recording.isRunning() and (batch := recording.getNextEventBatch()) is not None:
        part = batch.numpy()
        parts.append(columns(*(part[key] for key in ("timestamp", "x", "y", "polarity"))))
    return joined(parts)


#: Reader, formats that it reads.
READERS = {
    "faery": (by_faery, ["evt2", "evt3", "dat", "aedat4"]),
    "evutils": (by_evutils, ["evt2", "evt3", "dat", "aedat4", "dsec", "npz"]),
    "eventcv": (by_eventcv, ["evt2", "evt3", "aedat4", "dsec", "npz"]),
    "dv_processing": (by_dv_processing, ["aedat4"]),
}


@pytest.mark.parametrize("events", EVENTS.values(), ids=EVENTS)
@pytest.mark.parametrize(("reader", "name"), [(key, name) for key, (_, names) in READERS.items() for name in names])
def test_another_reader_has_the_exact_events(reader, name, events, tmp_path, monkeypatch):
    if name in ("dsec", "dat") and events["t_us"][-1] >= 1 << 32:
        pytest.skip("times of this form are 32 bits")
    if (reader, name) == ("faery", "evt3") and events["t_us"][-1] >= 1 << 26:
        pytest.skip("it counts one turn of the 24 bits of time, and no second one without events between")
    monkeypatch.setenv("HDF5_PLUGIN_PATH", hdf5plugin.PLUGIN_PATH)  # an HDF5 of eventcv's own has no Blosc
    found = READERS[reader][0](written(events, name, tmp_path))
    if (reader, name) == ("eventcv", "dsec"):
        found["t_us"] += events["t_us"][0]  # it begins at the first event
    np.testing.assert_array_equal(found, events)


def test_several_packets_of_aedat4_are_read_by_all(tmp_path, monkeypatch):
    """Numbers of 8 bytes in the table of packets begin at multiples of 8; faery refuses others."""
    monkeypatch.setattr("hesim_render.exchange.aedat4._PACKET_EVENTS", 300)
    for count in (299, 301, 700, 1000, 1300):
        events = many(count, 1 << 26)
        path = written(events, "aedat4", tmp_path)
        for read, names in READERS.values():
            if "aedat4" in names:
                np.testing.assert_array_equal(read(path), events)


def test_evio_reads_the_exact_events_of_nmnist(tmp_path):
    events = many(20_000, 1 << 23, (256, 256))
    found = library("evio").read(written(events, "nmnist", tmp_path, (256, 256)))
    np.testing.assert_array_equal(columns(*(found[key] for key in "txyp")), events)
