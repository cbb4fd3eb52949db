"""Made-up events, and files of them."""

from pathlib import Path

import numpy as np

from hesim_render.exchange import EVENT_FORMATS, EventStream
from hesim_render.pixels.evs.events import EVENT_DTYPE, no_events

DATA = Path(__file__).parents[1] / "data"
SHAPE = (720, 1280)


def made(*items):
    return np.array(list(items), dtype=EVENT_DTYPE)


def many(count, latest_us, shape=SHAPE, seed=3):
    rng = np.random.default_rng(seed)
    events = np.empty(count, dtype=EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, latest_us // 5, count) * 5)  # many equal times
    events["y"], events["x"] = rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)
    events["polarity"] = rng.choice([-1, 1], count)
    return events


def written(events, name, folder, shape=SHAPE):
    path = folder / f"events{EVENT_FORMATS[name].suffix}"
    with path.open("wb") as file:
        EVENT_FORMATS[name].write(EventStream.of(events, shape), file, path)
    return path


def joined(found):
    return np.concatenate([no_events(), *found])


def columns(t, x, y, on):
    events = np.empty(len(t), dtype=EVENT_DTYPE)
    events["t_us"], events["x"], events["y"] = t, x, y
    events["polarity"] = np.where(np.asarray(on) > 0, 1, -1)
    return events


def raw(tmp_path, words, dtype="<u2", header="% evt 3.0\n% geometry 1280x720\n% end\n"):
    path = tmp_path / "hand.raw"
    path.write_bytes(header.encode() + np.array(words, dtype=dtype).tobytes())
    return path
