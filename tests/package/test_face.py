"""The public face as a person at a prompt meets it: names, short descriptions, and nothing changed on the side."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render.capture.simulate import simulate
from hesim_render.core.errors import ConflictError


def test_dir_shows_the_public_names_and_no_others():
    assert [name for name in dir(hr) if not name.startswith("__")] == [n for n in hr.__all__ if n != "__version__"]
    child = "import hesim_render as hr; print(set(hr.__all__) <= set(dir(hr)))"  # before any was used
    assert subprocess.run([sys.executable, "-c", child], capture_output=True, text=True).stdout == "True\n"


def test_the_package_says_that_it_is_typed():
    """A type checker reads the annotations of an installed package only beside this file, empty by PEP 561."""
    assert (Path(hr.__file__).parent / "py.typed").read_bytes() == b""


def test_importing_the_package_takes_a_quarter_of_a_second_at_most():
    """Processor time, the best of three: other work on the machine does not count."""
    code = "import time; t = time.process_time(); import hesim_render; print(time.process_time() - t)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3)]
    assert min(float(run.stdout) for run in runs) < 0.25


def test_descriptions_are_short_and_say_what_is_what():
    sensor = hr.load_sensor("eiger").crop(512, 384, 8, 16)
    assert "512x384+8+16 of 3264x2448 px; events on 256x192 px" in repr(sensor)
    no_frames = {"pixels.M.roles": ["evs"], "aps": None, "sources": {}, "assumptions": {}}
    assert "no frames" in repr(hr.load_sensor("reference-mono", no_frames))
    scene = hr.load_scene("camera-sweep")
    assert repr(scene).startswith("<Scene 'camera-sweep': object floor") and "moving: camera" not in repr(sensor)
    frame = recordings.frame_of(recordings.sensor_like("eiger"), 3)
    assert repr(frame).startswith("<Frame 3: 128x96 px, t_us=")
    for thing in (sensor, sensor.layout, scene, hr.load_scene("cornell-box"), frame):
        assert len(repr(thing)) < 200


@pytest.mark.slow
@pytest.mark.parametrize(
    "call",
    [
        "illuminant('FL11')",
        pytest.param("colour.delta_e_2000([[1, 1, 1]], [[1, 1, 0]])", marks=pytest.mark.slow),
    ],
)
def test_numpy_prints_as_before(call):
    """colour-science sets NumPy's print options for the whole process when it is imported."""
    code = (
        "import numpy as np, hesim_render\nfrom hesim_render.isp import colour\n"
        "from hesim_render.spectral.spectrum import illuminant\n"
        f"before = np.get_printoptions()\n{call}\nprint(np.get_printoptions() == before)\n"
        "import sys; print('colour' in sys.modules)"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.split() == ["True", "True"]


def test_the_manifest_has_the_camera_that_was_used():
    sensor = hr.load_sensor("reference-mono").crop(64, 32)
    fitted = simulate(hr.load_scene("flat-field"), sensor, duration_s=0.001, samples=2)
    camera = fitted.manifest["settings"]["camera"]
    # the file says no more than "fit: target": of 0.3 m (or 0.2 m) the region's 64 (or 32) pixels see all
    lens, target = fitted.manifest["lens"], fitted.manifest["scene"]["spec"]["target"]
    margin = fitted.manifest["scene"]["spec"]["camera"].get("fit_margin", 1.0)
    image_mm = lens["focal_length_mm"] * (1 + lens["magnification"])
    scale = margin * min(64 * 5e-6 / target["width_m"], 32 * 5e-6 / target["height_m"])
    np.testing.assert_allclose(camera["origin_m"], [0, 0, image_mm * 1e-3 / scale], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(camera["forward"], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(camera["up"], [0, 1, 0], atol=1e-12)
    expected_deg = 2 * np.degrees(np.arctan(32 * 5e-3 / image_mm))
    np.testing.assert_allclose(camera["horizontal_fov_deg"], expected_deg, rtol=1e-9)
    # a scene of Mitsuba's brings its own
    box = simulate(hr.load_scene("cornell-box"), sensor, duration_s=0.001, samples=2).manifest
    assert "camera" not in box["scene"]["spec"]
    np.testing.assert_allclose(box["settings"]["camera"]["origin_m"], [0, 0, 3.9], atol=0.2)
    np.testing.assert_allclose(box["settings"]["camera"]["forward"], [0, 0, -1], atol=1e-6)


def test_quality_and_samples_exclude_each_other_in_one_reading():
    scene, sensor = hr.load_scene("dark"), hr.load_sensor("reference-mono").crop(8, 8)
    with pytest.raises(ConflictError, match=r"^give --quality or --samples \(quality, samples\), not both: "):
        simulate(scene, sensor, quality=0.5, samples=4)
    with pytest.raises(ConflictError, match=r"^give --quality or --exact \(quality, exact\), not both: "):
        simulate(scene, sensor, quality=0.5, exact=True)


@pytest.mark.slow
def test_shells_complete_commands_and_names():
    def completed(*words):
        environment = {
            **os.environ,
            "_HESIM_RENDER_COMPLETE": "complete_bash",
            "COMP_WORDS": " ".join(("hesim-render", *words)),
            "COMP_CWORD": str(len(words)),
        }
        program = "import sys; sys.argv = ['hesim-render']; from hesim_render.cli import main; main()"
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
        assert done.stderr == ""
        return done.stdout.split()

    assert completed("sim") == ["simulate"]
    assert completed("simulate", "color") == ["colorchecker"]
    assert completed("simulate", "dark", "--sensor", "davis3") == ["davis346"]
    assert completed("simulate", "x", "--without", "evs.m") == ["evs.mismatch"]
