"""Events and true optical flow as pairs to train on, and the simplest model that learns from them.

Clips of moving scenes become voxel grids of events (five bins of time) and the flow of the chief ray through every
event pixel. A linear model (ridge regression on products of the grid's derivatives) is fitted on the first
clips of each scene and judged on the last one.

Run: python examples/flow_dataset.py FOLDER [pixels across]
"""

import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

import hesim_render as hr

FOLDER = Path(sys.argv[1])
COLS = int(sys.argv[2]) if len(sys.argv) > 2 else 128
BINS, SPAN_US, CLIPS = 5, 50_000, 4
SCENES = ("camera-sweep", "facade-drive")


def clips(name):
    sensor = hr.load_sensor("gen2", {"aps.exposure_us": 1000}).crop(COLS, COLS * 3 // 4)
    rec = hr.simulate(hr.load_scene(name), sensor, duration_s=CLIPS * SPAN_US * 1e-6, seed=1, quality=2)
    for k in range(CLIPS):
        begin = k * SPAN_US
        inside = (rec.events["t_us"] >= begin) & (rec.events["t_us"] < begin + SPAN_US)
        flow = rec.truth.flow(begin, begin + SPAN_US, grid="events")
        grid = hr.events.voxel_grid(rec.events[inside], rec.event_shape, BINS, begin, begin + SPAN_US)
        yield grid, flow.flow_px, flow.visible


def features(grid):
    """Products of the grid's derivatives over 9x9 pixels, over their size: what a local method sees of the motion."""
    along_t, along_y, along_x = np.gradient(grid)
    yy, xx, xy, ty, tx = (
        uniform_filter((a * b).mean(axis=0), 9)
        for a, b in (
            (along_y, along_y),
            (along_x, along_x),
            (along_x, along_y),
            (along_t, along_y),
            (along_t, along_x),
        )
    )
    size = xx + yy + 1e-2
    columns = [value / size for value in (tx, ty, xx - yy, xy)]
    columns += [a * b for a in columns[:2] for b in columns[2:]]
    return np.stack([np.ones(grid.shape[1:]), *columns], axis=-1)


FOLDER.mkdir(parents=True, exist_ok=True)
rows = {"train": [], "test": []}
for name in SCENES:
    for k, (grid, flow_px, visible) in enumerate(clips(name)):
        part = "train" if k < CLIPS - 1 else "test"
        file = FOLDER / f"{part}-{name}-{k}.npz"
        np.savez_compressed(file, voxels=grid, flow_px=flow_px, valid=visible)
        active = uniform_filter(np.abs(grid).sum(axis=0), 9) > 0
        seen = visible & active & np.isfinite(flow_px).all(axis=-1)
        rows[part].append((features(grid)[seen], flow_px[seen]))
x, y = (np.concatenate(values) for values in zip(*rows["train"], strict=True))
scale = x.std(axis=0) + 1e-12
model = np.linalg.solve((x / scale).T @ (x / scale) + len(x) * 1e-3 * np.eye(x.shape[1]), (x / scale).T @ y)
for part, found in rows.items():
    x, y = (np.concatenate(values) for values in zip(*found, strict=True))
    length = np.linalg.norm(y, axis=1).mean()
    error = np.linalg.norm((x / scale) @ model - y, axis=1).mean()
    print(f"{part}: {len(y)} pixels, mean flow {length:.2f} px, mean error of the model {error:.2f} px")
print("pairs in", FOLDER)
