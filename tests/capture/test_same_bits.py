"""Five recordings, to the bit: what moves code from place to place must change none of them.

Bits are those of one backend and one kind of processor; elsewhere the last digits may differ, and the test is skipped.
Where arithmetic is changed on purpose, the hashes are made anew: ``python tests/capture/test_same_bits.py``.
"""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core import backend

HASHES = Path(__file__).parents[1] / "data" / "same_bits.json"
SIZE = 32, 24


def render(folder):
    return hr.simulate(hr.load_scene("rotating-star"), hr.load_sensor("gen2").crop(*SIZE), duration_s=0.02, seed=3)


def asynchronous(folder):
    return hr.simulate(hr.load_scene("rotating-star"), hr.load_sensor("davis346").crop(*SIZE), duration_s=0.01, seed=4)


def flicker(folder):
    light = {"light.waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.4}}
    sensor = hr.load_sensor("eiger", {"aps.exposure_us": 3000}).crop(*SIZE)
    return hr.simulate(hr.load_scene("colorchecker", light), sensor, duration_s=0.02, seed=5)


def video(folder):
    shade = np.linspace(0, 255, 40 * 32).reshape(32, 40)
    pictures = np.stack([np.roll(shade, k, axis=1) for k in range(4)])
    clip = np.repeat(pictures[..., None], 3, axis=-1).astype(np.uint8)
    return hr.simulate_video(
        clip, hr.load_sensor("eiger").crop(*SIZE), seed=6, fps=200, transfer="srgb", primaries="bt709", white_lux=500
    )


def lab(folder):
    from hesim_render.capture import lab as laboratory

    given = hr.load_sensor("reference-mono").crop(*SIZE)
    laboratory.write_captures(given, folder, frames=8, ticks=200, seed=7)
    return folder


RUNS = {"render": render, "asynchronous": asynchronous, "flicker": flicker, "video": video, "lab": lab}


def hash_of(made):
    """Of all values; not of files, which hold times and versions."""
    found = hashlib.sha256()
    if isinstance(made, Path):
        for path in sorted(made.rglob("*.npz")):
            with np.load(path) as archive:
                for name in sorted(archive.files):
                    found.update(name.encode() + np.ascontiguousarray(archive[name]).tobytes())
        return found.hexdigest()
    for frame in made.frames:
        for values in (frame.raw, frame.electrons_mean, frame.electrons_stderr):
            found.update(np.ascontiguousarray(values).tobytes())
    if made.events is not None:
        found.update(np.ascontiguousarray(made.events).tobytes())
    return found.hexdigest()


def machine():
    """What bits depend on."""
    chosen = backend.select()
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    told = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    features = hashlib.sha256(told.get("flags", "").encode()).hexdigest()[:8]
    model = f"{told.get('model name', 'unknown')} {features}"
    versions = (f"{name} {version(name)}" for name in ("drjit", "mitsuba", "numpy", "scipy"))
    return ", ".join([f"{chosen.backend} {chosen.version}", model, *versions])


@pytest.mark.parametrize("name", RUNS)
def test_bits_are_those_of_before(name, tmp_path):
    known = json.loads(HASHES.read_text(encoding="utf-8"))
    expected = known.get(machine(), {}).get(name)
    if expected is None:
        pytest.skip(f"no hash of {machine()}")
    assert hash_of(RUNS[name](tmp_path / "out")) == expected


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        new = {name: hash_of(run(Path(folder) / name)) for name, run in RUNS.items()}
    every = json.loads(HASHES.read_text(encoding="utf-8")) if HASHES.exists() else {}
    HASHES.write_text(json.dumps(every | {machine(): new}, indent=1) + "\n", encoding="utf-8")
    print(new)
