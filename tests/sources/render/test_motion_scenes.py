"""The shipped motion scenes: made by their script, full of texture, and moving."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from rendering import flux_image
from scipy.spatial.transform import Rotation

import hesim_render as hr
from hesim_render.sources.render.scene.parents import trajectories
from hesim_render.specs.files import data_folder

_FILE = Path(__file__).parents[3] / "examples" / "motion_scenes.py"
_SPEC = importlib.util.spec_from_file_location("motion_scenes", _FILE)
script = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(script)
#: Two times, µs, between which the picture changes.
TIMES = {"facade-drive": (0, 100_000), "traffic-light": (0, 250_000)}


@pytest.mark.parametrize("name", script.SCENES)
def test_the_script_writes_the_shipped_files(name):
    assert (data_folder("scenes") / f"{name}.yaml").read_text() == script.content_of(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", script.SCENES)
def test_a_motion_scene_has_texture(name):
    textured = [item for item in hr.load_scene(name).spec.objects if item.pattern is not None]
    assert len(textured) >= 50


@pytest.mark.slow
@pytest.mark.parametrize("name", script.SCENES)
def test_a_motion_scene_moves(name):
    scene = hr.load_scene(name)
    sensor = hr.load_sensor("reference-mono").crop(32, 24)
    before, after = (flux_image(scene, sensor, 16, begin_us=t, end_us=t + 1.0)[0] for t in TIMES.get(name, (0, 30_000)))
    assert np.isfinite(before).all() and np.isfinite(after).all() and np.ptp(before) > 0.2 * before.mean() > 0
    # the same rays at both times: what stands still is the same to the bit
    changed = before != after
    assert changed.any()
    if "camera" not in trajectories(scene.spec):
        assert not changed.all()


def test_blades_ride_on_a_rotor_that_rides_on_a_head():
    """Each link written out: the head's swing, then the rotor's turn about the hub."""
    tracks = trajectories(hr.load_scene("fan").spec)
    hub, swing_at = np.array([0.0, 0.6, 0.2]), np.array([0.0, 0.6, 0.05])
    tip = np.array([0.0, 0.85, 0.2])
    for t_us in (0.0, 12_345.0, 1_234_567.0):
        spin = Rotation.from_rotvec([0, 0, -2 * np.pi * (t_us / 50_000 % 1)])
        share = t_us / 2_000_000
        swing = Rotation.from_euler("y", -25 + 50 * share, degrees=True)
        expected = swing.apply(spin.apply(tip - hub) + hub - swing_at) + swing_at
        for name in ("rotor", "blade-0", "blade-3"):
            found = (tracks[name].matrix(t_us) @ np.append(tip, 1))[:3]
            np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_pendulum_keeps_its_energy():
    """Between keyframes of the shipped file the bob's height and speed obey ½ v² + g h."""
    track = trajectories(hr.load_scene("pendulum").spec)["bob"]
    times = np.arange(10_000, int(track.period_us) - 10_000, 8000.0)
    place = np.append([0, 0.6, 0.1], 1)
    before, at, after = ((track.matrix(times + d) @ place)[:, :3] for d in (-4000.0, 0.0, 4000.0))
    speed = np.linalg.norm(after - before, axis=1) / 8e-3
    energy = 0.5 * speed**2 + 9.80665 * at[:, 1]
    assert np.ptp(energy) < 0.02 * 9.80665 * 0.4 * (1 - np.cos(np.radians(30)))
    # the period of 30 degrees is 1.0174 times that of small swings
    assert track.period_us * 1e-6 == pytest.approx(1.0174 * 2 * np.pi * np.sqrt(0.4 / 9.80665), rel=0.01)


def test_a_wheel_rolls():
    """Where the traffic light's car touches the road its wheel stands still."""
    track = trajectories(hr.load_scene("traffic-light").spec)["wheel-0"]
    hub, radius = np.array([-0.6, 0.28, -0.18]), 0.28
    for t_us in (20_000.0, 123_456.0):
        pose, step = track.matrix(t_us), 10.0
        under = np.linalg.inv(pose) @ np.append((pose @ np.append(hub, 1))[:3] - [0, radius, 0], 1)
        moved = (track.matrix(t_us + step) @ under - track.matrix(t_us - step) @ under)[:3] / (2e-6 * step)
        assert np.linalg.norm(moved) < 0.05  # of 10 m/s


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["eiger", "davis346"])
@pytest.mark.parametrize("name", script.SCENES)
def test_a_motion_scene_is_recorded_by_default(name, sensor):
    small = hr.load_sensor(sensor).crop(24, 16)
    run = hr.simulate(hr.load_scene(name), small, duration_s=0.003, quality=4, seed=1, max_minutes=None)
    assert run.manifest["settings"]["mode"] == "change-driven"
