"""Scenes that cannot be rendered: one line on the command line, with file and key, and nothing left behind."""

import numpy as np
import pytest
from rendering import make_scene, mono

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.exact import RenderedFlux, require_finite
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.specs.motion import TrackSpec

SCENE = """\
schema_version: 1
name: wrong
description: a scene with one mistake
target: {type: flat, width_m: 0.3, height_m: 0.2, reflectance: 0.2}
light: {type: uniform, illuminance_lux: 100}
camera: {fit: target}
motion:
  - object: target
    keyframes:
      - {t_us: 0}
      - {t_us: 1000, translation_m: [0.1, 0, 0]}
"""
MITSUBA = """\
schema_version: 1
name: wrong
description: a Mitsuba scene with one mistake
mitsuba:
  inline:
    sky: {type: constant, radiance: {type: uniform, value: 1.0}}
    card:
      type: rectangle
      bsdf: {type: diffuse, reflectance: {type: uniform, value: 0.5}}
camera: {origin_m: [0, 0, 5], focal_length_mm: 16}
motion:
  - object: card
    keyframes:
      - {t_us: 0}
      - {t_us: 1000, translation_m: [0.1, 0, 0]}
"""


def fails(capsys, tmp_path, text, *options):
    """The one line that simulating a scene file gives."""
    (tmp_path / "wrong.yaml").write_text(text)
    out = tmp_path / "out"
    arguments = ["simulate", tmp_path / "wrong.yaml", "--sensor", "reference-mono", "--roi", "8x8", "--duration", 0.002]
    with pytest.raises(SystemExit) as caught:
        cli.main([str(a) for a in [*arguments, "--out", out, *options]])
    printed, err = capsys.readouterr()
    assert caught.value.code == 2 and not out.exists() and not list(tmp_path.glob("*out*"))
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("hesim-render: ") and "Traceback" not in err + printed
    return lines[0]


def matrix(linear, last=(0, 0, 0, 1)):
    rows = [[*row, 0.0] for row in np.asarray(linear, dtype=float).tolist()]
    return f"matrix: {[*rows, list(last)]}"


MISTAKES = {
    "object": ("object: target", "object: ball", 7, "motion: no object 'ball' in the scene; there are target, camera"),
    "order": ("t_us: 1000", "t_us: -5", 9, "in order of time: -5 µs follows 0 µs"),
    "scale": ("translation_m: [0.1, 0, 0]", matrix(np.diag([1, 2, 1])), 11, "not rigid: it scales by 1, 2, 1 along"),
    "shear": ("translation_m: [0.1, 0, 0]", matrix([[1, 0.6, 0], [0, 0.8, 0], [0, 0, 1]]), 11, "it shears"),
    "mirror": ("translation_m: [0.1, 0, 0]", matrix(np.diag([1, -1, 1])), 11, "it mirrors"),
    "last row": ("translation_m: [0.1, 0, 0]", matrix(np.eye(3), (0, 0, 1, 1)), 11, "last row of a pose"),
    "3x3": ("translation_m: [0.1, 0, 0]", "matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", 11, "matrix"),
    "both": ("translation_m: [0.1, 0, 0]", f"rotation_deg: 3, {matrix(np.eye(3))}", 11, "matrix or rotation_deg"),
    "no light": ("light: {type: uniform, illuminance_lux: 100}\n", "", 1, "light is required"),
    "empty list": ("light: {type: uniform, illuminance_lux: 100}", "light: []", 5, "at least 1 item"),
    "darkness": ("{type: uniform, illuminance_lux: 100}", "[{type: none}, {type: none}]", 5, "stands alone"),
    "waveform": ("lux: 100}", "lux: 100, waveform: {type: pwm, frequency_hz: 9, duti: 1}}", 5, "duti: unknown key"),
    "in a list": ("{type: uniform, illuminance_lux: 100}", "\n  - {type: uniform, lux: 1}", 6, "light.0.lux: unknown"),
}


@pytest.mark.parametrize("name", list(MISTAKES))
def test_a_mistake_in_a_scene_file_is_one_line_with_its_place(name, capsys, tmp_path):
    old, new, line, text = MISTAKES[name]
    assert old in SCENE
    said = fails(capsys, tmp_path, SCENE.replace(old, new))
    assert f"wrong.yaml:{line}: " in said and text in said


CARD = "reflectance: {type: uniform, value: 0.5}"
SKY = "    sky: {type: constant, radiance: {type: uniform, value: 1.0}}\n"


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("object: card", "object: cart", "motion: no shape 'cart' in the Mitsuba scene; there are card"),
        (SKY, "", "mitsuba: the Mitsuba scene has no emitter"),
        ("  inline:", "  unlit: [sun]\n  inline:", "mitsuba: no emitter 'sun' in the Mitsuba scene; there are 'sky'"),
        ("  inline:", "  waveforms: {sun: {type: mains, frequency_hz: 50, depth: 0.5}}\n  inline:", "no emitter 'sun'"),
        (
            "camera:",
            "light: {type: none}\ncamera:",
            "light: type 'none' is darkness, but the Mitsuba scene has emitters",
        ),
        ("value: 1.0", "value: .nan", "radiance that is not finite (nan), seen by 64 of 64 pixels, the first in row 0"),
        ("value: 1.0", "value: .inf", "'wrong' has a radiance that is not finite"),
        ("value: 0.5", "value: .nan", "'wrong' has a radiance that is not finite"),
        ("value: 0.5", "value: .inf", "'wrong' has a radiance that is not finite"),
    ],
)
def test_a_mistake_in_a_mitsuba_scene_is_one_line_with_its_file(old, new, text, capsys, tmp_path):
    assert old in MITSUBA
    said = fails(capsys, tmp_path, MITSUBA.replace(old, new), "--exact", "--samples", "2")
    assert "wrong.yaml: " in said and text in said


def test_only_flux_that_is_not_finite_is_refused_and_its_pixel_named():
    from hesim_render.core.backend import jit

    types = jit()
    scene, layout = hr.load_scene("flat-field"), mono(8, 8).layout
    pixel = np.array([3, 17, 44], dtype=np.uint32)
    good = types.Float([0.0, 1e30, -1.0])
    require_finite(good, good, scene, layout, pixel)
    # a sum beyond single precision is no fault of any pixel
    large = types.Float([3e38, 3e38, 0.0])
    require_finite(large, types.Float([0.0, 0.0, 0.0]), scene, layout, pixel)
    for wrong in (np.nan, np.inf, -np.inf):
        for halves in ((good, types.Float([1.0, wrong, wrong])), (types.Float([1.0, wrong, wrong]), good)):
            with pytest.raises(
                SpecError, match=r"flat-field\.yaml: .*seen by 2 of 3 pixels, the first in row 2, column 1"
            ):
                require_finite(*halves, scene, layout, pixel)


# ---- matrices that are right --------------------------------------------------------------------


def turn(axis, angle_deg):
    """Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def pose(linear, shift):
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = linear, shift
    return full


def test_a_matrix_is_the_pose_whatever_the_pivot():
    rng = np.random.default_rng(8)
    poses = [pose(turn(rng.normal(size=3), rng.uniform(0, 180)), rng.normal(size=3)) for _ in range(8)]
    poses += [np.eye(4), pose(turn((0, 1, 0), 180), (1, 2, 3)), pose(np.eye(3), (1, 0, 0))]
    for pivot in ((0, 0, 0), (0.3, -2, 5)):
        keys = [{"t_us": 1000 * k, "matrix": p.tolist()} for k, p in enumerate(poses)]
        trajectory = Trajectory(TrackSpec.model_validate({"object": "x", "pivot_m": pivot, "keyframes": keys}))
        for k, expected in enumerate(poses):
            np.testing.assert_allclose(trajectory.matrix(1000.0 * k), expected, atol=1e-12)
        # the pivot moves in a straight line
        point = np.array([*pivot, 1.0])
        half = trajectory.matrix(500.0) @ point
        np.testing.assert_allclose(half, (poses[0] @ point + poses[1] @ point) / 2, atol=1e-12)


def test_matrices_go_the_shortest_way_and_do_not_lose_turns():
    # 20 steps of 70° about one axis: a turn of 1400°, the sign of each matrix's own axis changing on the way
    steps = [pose(turn((1, 2, 2), 70 * k), (0, 0, 0)) for k in range(21)]
    keys = [{"t_us": 1000 * k, "matrix": p.tolist()} for k, p in enumerate(steps)]
    track = TrackSpec.model_validate({"object": "x", "keyframes": keys})
    trajectory = Trajectory(track)
    for k in range(20):
        middle = trajectory.matrix(1000.0 * k + 500)
        np.testing.assert_allclose(middle[:3, :3], turn((1, 2, 2), 70 * k + 35), atol=1e-9)
    # what is written back says the same
    again = TrackSpec.model_validate(track.model_dump(mode="json", exclude_none=True))
    np.testing.assert_allclose(Trajectory(again).matrix(12_345.0), trajectory.matrix(12_345.0), atol=1e-12)
    # backwards, through no turn at all, and after a keyframe that counts its turns
    back = [{"t_us": 0, "rotation_deg": 730, "rotation_axis": [0, 0, -2]}]
    back += [
        {"t_us": 1000 * (k + 1), "matrix": pose(turn((0, 0, 1), a), (0, 0, 0)).tolist()} for k, a in enumerate((0, 20))
    ]
    trajectory = Trajectory(TrackSpec.model_validate({"object": "x", "keyframes": back}))
    np.testing.assert_allclose(trajectory.matrix(500.0)[:3, :3], turn((0, 0, 1), -5), atol=1e-12)
    np.testing.assert_allclose(trajectory.matrix(1500.0)[:3, :3], turn((0, 0, 1), 10), atol=1e-12)


def test_rounded_matrices_are_taken_as_the_nearest_rotation():
    rounded = np.round(pose(turn((1, 1, 0), 33), (1, 2, 3)), 5)
    keys = [{"t_us": 0}, {"t_us": 1000, "matrix": rounded.tolist()}]
    end = Trajectory(TrackSpec.model_validate({"object": "x", "keyframes": keys})).matrix(1000.0)
    np.testing.assert_allclose(end[:3, :3] @ end[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(end, rounded, atol=1e-5)


def test_a_card_moved_by_a_matrix_is_seen_where_a_translation_puts_it():
    def seen(key):
        scene = make_scene(
            target={"type": "flat", "width_m": 0.1, "height_m": 0.1, "reflectance": {"flat": 0.1}},
            light={"type": "uniform", "illuminance_lux": 100},
            camera={"origin_m": (0, 0, 1)},
            motion=[{"object": "target", "pivot_m": (0.2, 0, 0), "keyframes": [{"t_us": 0}, {"t_us": 1000, **key}]}],
        )
        source = RenderedFlux(scene, mono(24, 24), 4)
        return np.array(source.mean_flux(np.arange(576, dtype=np.uint32), 1000.0, 1001.0)[0])

    moved = seen({"matrix": pose(turn((0, 0, 1), 30), (0.05, 0, 0)).tolist()})
    shift = turn((0, 0, 1), 30) @ (0.2, 0, 0) - (0.2, 0, 0) + (0.05, 0, 0)
    same = seen({"rotation_deg": 30, "translation_m": tuple(shift)})
    np.testing.assert_allclose(moved, same, rtol=1e-5)
    assert np.ptp(moved) > 0
