"""Settings of a run as scripts give them: numbers of NumPy, texts in place of numbers."""

import json

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture.run_settings import RunSettings, noise_models
from hesim_render.core.errors import RangeError


def test_numbers_of_numpy_are_numbers():
    """What a loop over an array gives. A recording that holds one of them could not be written, after its render."""
    settings = RunSettings(
        duration_s=np.float32(0.03), seed=np.uint16(41), quality=np.float32(0.7), clean=np.True_, truth=["depth"],
        truth_every_us=np.int64(700), max_minutes=np.int32(3),
    )  # fmt: skip
    assert settings == RunSettings(
        duration_s=float(np.float32(0.03)), seed=41, quality=float(np.float32(0.7)), clean=True, truth=["depth"],
        truth_every_us=700, max_minutes=3,
    )  # fmt: skip
    assert settings.duration_us == 30_000
    kinds = [type(getattr(settings, name)) for name in ("seed", "quality", "clean", "truth_every_us")]
    assert kinds == [int, float, bool, int]
    assert json.loads(json.dumps(settings.as_dict()))["truth"]["every_us"] == 700


@pytest.mark.parametrize(("given", "message"), [
    ({"seed": 3.5}, "seed is 3.5; expected a whole number"),
    ({"seed": "7"}, "seed is '7'; expected a whole number"),
    ({"duration_s": "0.1"}, "duration_s is '0.1'; expected a number"),
    ({"quality": "0.5"}, "quality is '0.5'; expected a number"),
    ({"samples": "64"}, "samples is '64'; expected a number"),
    ({"truth_every_us": "1000"}, "truth_every_us is '1000'; expected a number"),
])  # fmt: skip
def test_text_is_no_number(given, message):
    with pytest.raises(RangeError, match=f"^{message}"):
        RunSettings(**given)


def test_recordings_with_numbers_of_numpy_are_written(tmp_path):
    sensor = hr.load_sensor("dvs128").crop(8, 8)
    video = np.full((3, 8, 8), 0.4, np.float32)
    made = [
        hr.simulate("dark", sensor, duration_s=np.float64(0.002), seed=np.int64(3), samples=np.int16(2), clean=np.True_,
                    out=tmp_path / "scene"),
        hr.simulate_video(video, sensor, fps=np.int64(100), seed=np.uint32(3), clean=np.True_, transfer="linear",
                          out=tmp_path / "video"),
    ]  # fmt: skip
    for recording in made:
        manifest = hr.Recording.load(recording.path).manifest
        assert manifest["seed"] == 3 and manifest["settings"]["clean"] is True
    with pytest.raises(RangeError, match=r"without is 'evs.leak'; expected a list: \['evs.leak'\]"):
        noise_models(sensor, without="evs.leak")
