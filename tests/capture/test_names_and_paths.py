"""The Python API takes names and paths as well as objects, tells if scene and sensor are swapped, and reads well."""

import re

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render.core.errors import ConflictError, RangeError, SpecError
from hesim_render.isp import develop_recording
from hesim_render.measure import measure_mtf
from hesim_render.recording.recording import Recording
from hesim_render.sensor.sensor import as_sensor
from hesim_render.sources.scene import scene_and_sensor
from hesim_render.specs.files import data_folder

SCENE, SENSOR = data_folder("scenes") / "colorchecker.yaml", data_folder("sensors") / "eiger.yaml"


def test_names_paths_and_objects_are_the_same():
    scene, sensor = hr.load_scene("colorchecker"), hr.load_sensor("eiger")
    for given in (("colorchecker", "eiger"), (SCENE, str(SENSOR)), (scene, "eiger"), ("colorchecker", sensor)):
        found = scene_and_sensor(*given)
        assert (found[0].name, found[1].spec) == ("colorchecker", sensor.spec)
    assert scene_and_sensor(scene, sensor) == (scene, sensor) and as_sensor(sensor) is sensor


@pytest.mark.parametrize("call", [hr.simulate, hr.SceneTruth, lambda *given: hr.rig_scenes(*given, {"a": np.eye(4)}),
                                  lambda *given: hr.render_cube(*given, [450.0, 550.0])])  # fmt: skip
def test_swapped_arguments_are_told(call):
    scene, sensor = hr.load_scene("colorchecker"), hr.load_sensor("eiger")
    for given in (("eiger", "colorchecker"), (sensor, scene), ("eiger", scene), (sensor, "colorchecker")):
        with pytest.raises(ConflictError, match=r"the scene comes first, then the sensor; given were ['<]"):
            call(*given)
    with pytest.raises(SpecError, match=r"eiger\.yaml: is a sensor file; expected a scene file"):
        call(SENSOR, SCENE)
    for given, told in (
        ((3, sensor), r"^scene is 3; expected a scene from load_scene or Scene\.from_mitsuba, a name, or the path"),
        ((scene, 2.5), r"^sensor is 2\.5; expected a sensor from load_sensor, a name, or the path"),
        ((scene, None), r"^sensor is None; expected a sensor"),
    ):
        with pytest.raises(RangeError, match=told):
            call(*given)
    with pytest.raises(SpecError, match=r"no scene named 'colorcheker'.*did you mean 'colorchecker'"):
        call("colorcheker", "eiger")


def test_a_sensor_alone_may_be_a_name_too(tmp_path):
    clip = np.full((2, 48, 64, 3), 90, np.uint8)
    for call in (
        lambda given: hr.simulate_video(clip, given, fps=100, transfer="srgb", primaries="bt709"),
        lambda given: hr.simulate_cube(tmp_path / "nothing.npy", given),
        lambda given: hr.photocurrent(np.ones(2), [400.0, 700.0], given, 10, filter="clear"),
    ):
        with pytest.raises(SpecError, match=r"no sensor named 'igger'"):
            call("igger")
        with pytest.raises(RangeError, match="expected a sensor from load_sensor"):
            call(hr.load_scene("dark"))
    named = hr.photocurrent(np.ones(471), np.arange(360.0, 831.0), "reference-mono", 10, filter="clear")
    assert named == hr.photocurrent(
        np.ones(471), np.arange(360.0, 831.0), hr.load_sensor("reference-mono"), 10, filter="clear"
    )


def test_a_recording_may_be_its_folder(tmp_path):
    recording = recordings.make("reference-bayer", tmp_path / "r")
    found = []
    for given in (recording, tmp_path / "r", str(tmp_path / "r")):
        with pytest.raises(RangeError) as caught:
            measure_mtf(given, filter_name="red")
        found.append(str(caught.value))
    assert len(set(found)) == 1
    with pytest.raises(RangeError, match="expected a recording, or the path of its folder"):
        measure_mtf(recording.frames[0])
    with pytest.raises(ConflictError, match=r"3 filters: say on which to measure, --filter NAME .* blue, green, red"):
        measure_mtf(recording)
    with pytest.raises(SpecError, match="in memory: save it first"):
        develop_recording(recordings.make("reference-bayer"))
    with pytest.raises(RangeError, match=r"events is <Recording.*; expected an array of events") as caught:
        hr.events.event_frame(recording, recording.event_shape)


def test_what_a_notebook_shows_is_short_and_no_address(tmp_path):
    """Nothing is shown as ``<… object at 0x…>``, nor as all of its numbers."""
    kept = recordings.make("eiger", tmp_path / "r", frames=3)
    sensor, scene = hr.load_sensor("eiger").crop(32, 24), hr.load_scene("colorchecker")
    truth = hr.SceneTruth(scene, sensor)
    layout, folder = "<Layout 'eiger': 32x24+1616+1212 px>", tmp_path / "r"
    shown = {
        repr(Recording.load(folder).frames): f"<3 frames of 128x96 px in {folder}>",
        repr(Recording.load(folder).frames[1:2]): f"<1 frame of 128x96 px in {folder}>",
        repr(truth): "<SceneTruth of 'colorchecker' seen by 'eiger': target, wall>",
        repr(sensor.aps.without("read", "shot")): f"<ApsNoise of the frame pixels of {layout}; off: read, shot>",
        repr(sensor.evs): f"<EvsNoise of the event pixels of {layout}>",
    }
    for found, expected in shown.items():
        assert found == expected
    for each in (kept, kept.frames, kept.event_truth, sensor, scene, truth):
        assert not re.search(r" at 0x|array\(", repr(each)) and len(repr(each)) < 400
