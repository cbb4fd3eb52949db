"""Benchmarks as few large files for training: WebDataset (tar) or HDF5 shards, in a folder or at any fsspec address.

What a clip holds for training, as arrays: one sample for each frame, and each event in one of them.
"""

import hashlib
import io
import json
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from hesim_render.benchmark.card import card_header
from hesim_render.benchmark.folder import CARD_FILE, Benchmark, BenchmarkClip, parsed_json
from hesim_render.benchmark.store import Put, store_of
from hesim_render.benchmark.verify import digest_of
from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.core.guard import WholeFile
from hesim_render.core.hdf5 import COMPRESSION
from hesim_render.core.names import FileName
from hesim_render.core.progress import Progress
from hesim_render.specs.benchmark import SPLITS

#: Geometric truth that goes with each frame, and its name in the recording.
_TRUTH = {
    "depth_m": "frames/depth_m", "flow_px": "frames/flow_forward_px", "visible": "frames/visible_forward",
    "normal": "frames/normal", "object": "frames/object",
}  # fmt: skip


def samples(clip: BenchmarkClip) -> Iterator[tuple[str, dict[str, NDArray], dict[str, Any]]]:
    """The samples of a clip, in order of time.

    The events of a frame are those from the begin of its exposure to the begin of the next frame's; the first frame has
    those before it as well, the last one all to the end. A clip without frames is one sample.

    Yields
    ------
    Name, arrays and figures. Arrays: ``raw`` (uint16, DN) and ``sharp`` (uint16, DN, of the sharp image nearest to the
    middle of the exposure), ``events`` (`EVENT_DTYPE`) with ``label`` (uint8) and ``event_object`` (uint16), and the
    geometric truth of the frame, as far as the clip has them. Figures: split, times, levels and shapes.
    """
    recording, sharp, stored = clip.recording, clip.sharp, clip.recording.stored_truth
    frames, mosaic = recording.frames, recording.mosaic
    labels = recording.event_labels
    objects = recording.event_objects if recording.has_event_objects else None
    when = recording.events["t_us"]
    begins = [frame.exposure_start_us for frame in frames][1:]
    edges = np.searchsorted(when, begins, side="right") if begins else np.empty(0, np.int64)
    edges = np.concatenate([[0], edges, [len(when)]]).astype(np.int64)
    common = {
        "clip": clip.name, "split": clip.split, "sensor": clip.content["sensor"], "noise": clip.content["noise"],
        "event_shape": list(recording.event_shape), "bit_depth": mosaic.bit_depth,
        "black_level_dn": mosaic.black_level_dn, "duration_us": recording.duration_us,
    }  # fmt: skip
    for number in range(max(1, len(frames))):
        arrays: dict[str, NDArray] = {}
        figures: dict[str, Any] = {**common, "index": number}
        part = slice(edges[number], edges[number + 1])
        if 0 not in recording.event_shape:
            arrays["events"] = recording.events[part]
            if labels is not None:
                arrays["label"] = labels.label[part]
            if objects is not None:
                arrays["event_object"] = objects[part]
        if len(frames):
            frame = frames[number]
            arrays["raw"] = frame.raw
            figures |= {
                "exposure_start_us": frame.exposure_start_us, "exposure_us": frame.exposure_us,
                "line_time_us": frame.line_time_us,
            }  # fmt: skip
            if sharp is not None and len(sharp.time_us):
                nearest = sharp.nearest(frame.exposure_start_us + frame.exposure_us / 2)
                arrays["sharp"], figures["sharp_t_us"] = sharp.raw_dn(nearest), float(sharp.time_us[nearest])
            if stored is not None:
                arrays |= {key: stored.read(name, number) for key, name in _TRUTH.items() if name in stored.names}
        yield f"{clip.name}-{number:06d}", arrays, figures


INDEX_FILE = "index.json"
FORMATS = {"webdataset": "tar", "hdf5": "h5"}
_SCHEMA = 1


class _ShardEntry(BaseModel):
    name: FileName
    sha256: str


class _ShardIndex(BaseModel):
    """What is read of `INDEX_FILE`."""

    shards: list[_ShardEntry]


_Sample = tuple[str, dict[str, NDArray], dict[str, Any]]


class _TarShard:
    """A tar of ``NAME.KEY.npy`` and ``NAME.json``; the same samples give the same bytes."""

    def __init__(self, path: Path) -> None:
        self._file = tarfile.open(path, "w", format=tarfile.PAX_FORMAT)  # noqa: SIM115
        self.bytes = 0

    def add(self, sample: _Sample) -> None:
        name, arrays, figures = sample
        for key, values in arrays.items():
            content = io.BytesIO()
            np.save(content, values, allow_pickle=False)
            self._write(f"{name}.{key}.npy", content.getvalue())
        self._write(f"{name}.json", json.dumps(figures, sort_keys=True).encode())

    def _write(self, name: str, content: bytes) -> None:
        entry = tarfile.TarInfo(name)  # its times and owners are 0
        entry.size = len(content)
        self._file.addfile(entry, io.BytesIO(content))
        self.bytes += len(content)

    def close(self) -> None:
        self._file.close()


class _Hdf5Shard:
    """An HDF5 file with a group for each sample: arrays as data sets, figures as a text attribute."""

    def __init__(self, path: Path) -> None:
        self._file = h5py.File(path, "w", track_order=True)
        self.bytes = 0

    def add(self, sample: _Sample) -> None:
        name, arrays, figures = sample
        group = self._file.create_group(name, track_order=True)
        for key, values in arrays.items():
            packed = {"compression": COMPRESSION} if values.size else {}
            stored = group.create_dataset(key, data=values, track_times=False, **packed)
            stored.flush()  # its chunks have their place in the file now, whoever else refers to the data set
            self.bytes += stored.id.get_storage_size()
        group.attrs["figures"] = json.dumps(figures, sort_keys=True)

    def close(self) -> None:
        self._file.close()


def pack_benchmark(
    root: str | Path,
    target: str | Path,
    *,
    format: str = "webdataset",
    shard_mb: float = 256.0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write all samples of a benchmark (`samples`) into shards of each split: ``train-000000.tar``, …

    A folder appears whole or not at all. At an address a shard appears when all of it is written, and ``index.json``
    comes last: with it the set is whole. ``README.md`` has the header that hubs read. After an error no shard is left
    there. Returns the number of samples.

    Parameters
    ----------
    root : folder of the benchmark.
    target : a folder, or an address that fsspec knows, such as ``s3://bucket/set``.
    format : ``webdataset`` or ``hdf5``.
    shard_mb : size at which a shard is closed, MB.
    overwrite : replace a finished set.
    progress : called with (done, total, what).

    Raises
    ------
    RangeError
        If the format is unknown, or the size is not above 0.
    SpecError
        If the folder is no finished benchmark.
    OutputError
        If the target holds a finished set, or cannot be written.
    """
    if format not in FORMATS:
        raise RangeError("format", format, f"one of {', '.join(FORMATS)}{did_you_mean(format, FORMATS)}")
    if not 0 < shard_mb < float("inf"):
        raise RangeError("shard_mb", shard_mb, "a size above 0, MB")
    benchmark, store = Benchmark(root), store_of(target)
    shards: list[dict[str, Any]] = []
    total, done = len(benchmark.manifest["clips"]), 0
    with store.writing(INDEX_FILE, overwrite) as put, tempfile.TemporaryDirectory() as folder:
        for split in SPLITS:
            clips = list(benchmark.clips(split))

            def made(clips: list = clips) -> Iterator[_Sample]:
                nonlocal done
                for clip in clips:
                    yield from samples(clip)
                    done += 1
                    if progress is not None:
                        progress(done, total, "clips")

            shards += _write_split(split, made(), put, Path(folder), format, shard_mb * 1e6)
        index = {
            "schema_version": _SCHEMA, "benchmark": benchmark.manifest["name"], "digest": digest_of(benchmark),
            "format": format, "shards": shards,
        }  # fmt: skip
        card = Path(folder) / CARD_FILE
        card.write_text(_card(benchmark.manifest, shards, format), encoding="utf-8")
        put(CARD_FILE, card)
        file = Path(folder) / INDEX_FILE
        file.write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
        put(INDEX_FILE, file)
    return sum(shard["samples"] for shard in shards)


def _card(manifest: dict[str, Any], shards: list[dict[str, Any]], format: str) -> str:
    """The header that hubs read, and where the card of the benchmark is."""
    splits = [split for split in SPLITS if any(shard["split"] == split for shard in shards)]
    header = card_header(manifest, {split: f"{split}-*.{FORMATS[format]}" for split in splits})
    return f"{header}\nShards of a benchmark of hesim_render; `{INDEX_FILE}` has their SHA-256 and its digest.\n"


def _write_split(
    split: str, given: Iterator[_Sample], put: Put, folder: Path, format: str, most_bytes: float
) -> list[dict[str, Any]]:
    """Write the shards of a split; returns their entries of the index."""
    result: list[dict[str, Any]] = []
    sample = next(given, None)
    while sample is not None:
        name = f"{split}-{len(result):06d}.{FORMATS[format]}"
        path, count = folder / name, 0
        shard = _TarShard(path) if format == "webdataset" else _Hdf5Shard(path)
        try:
            while sample is not None and (count == 0 or shard.bytes < most_bytes):
                shard.add(sample)
                count += 1
                sample = next(given, None)
        finally:
            shard.close()
        put(name, path)
        result.append({
            "name": name, "split": split, "samples": count, "bytes": path.stat().st_size,
            "sha256": WholeFile(path).sha256(),
        })  # fmt: skip
        path.unlink()
    return result


def verify_shards(target: str | Path, progress: Progress | None = None) -> list[str]:
    """Compare every shard with its SHA-256.

    Parameters
    ----------
    target : folder or address that `pack_benchmark` wrote to.
    progress : called with (done, total, what).

    Returns
    -------
    A line for each shard that is missing or changed; empty if all is as it was written.

    Raises
    ------
    SpecError
        If there is no finished set.
    """
    store = store_of(target)
    index = parsed_json(b"".join(store.blocks(INDEX_FILE)), _ShardIndex, f"{target}/{INDEX_FILE}")
    problems = []
    for done, shard in enumerate(index["shards"]):
        try:
            digest = hashlib.sha256()
            for block in store.blocks(shard["name"]):
                digest.update(block)
            if digest.hexdigest() != shard["sha256"]:
                problems.append(f"{shard['name']}: was changed")
        except SpecError:
            problems.append(f"{shard['name']}: is missing")
        if progress is not None:
            progress(done + 1, len(index["shards"]), "shards")
    return problems
