"""What is in the picture, told before anything is rendered, and shown by ``--framing``."""

import time
import warnings

import numpy as np
import pytest
from PIL import Image
from rendering import make_scene, mono

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import HesimWarning
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.framing import framing, outline, posed_view, warn_if_unseen
from hesim_render.sources.render.look import _colours, look
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

LIGHT = {"type": "uniform", "illuminance_lux": 100}
CARD = {"type": "flat", "width_m": 0.3, "height_m": 0.2}
WIDE = {"type": "flat", "width_m": 3, "height_m": 2, "bend_radius_m": 4}
UNSEEN = "no part of the target is in the picture at any time"


def scene_of(target=CARD, camera=None, motion=(), **sections):
    return make_scene(
        target=target, light=LIGHT, camera=camera or {"fit": "target"}, motion=list(motion), **sections
    )  # fmt: skip


def framed(scene, sensor, t_us=0.0):
    return framing(scene.spec, place_camera(scene.spec, sensor), t_us)


def test_a_fitted_target_fills_its_margin():
    found = framed(scene_of(camera={"fit": "target", "fit_margin": 0.8}), mono(60, 40))
    np.testing.assert_allclose(found.fills, 0.8, rtol=1e-9)
    assert found.inside == 1 and not found.from_behind
    np.testing.assert_allclose(found.mm_per_px, 300 / (0.8 * 60), rtol=1e-9)
    over = framed(scene_of(camera={"fit": "target", "fit_margin": 2.0}), mono(60, 40))
    # of a grid of 33 × 33 points the middle 17 × 17 are in the picture
    np.testing.assert_allclose([*over.fills, over.inside], [2, 2, (17 / 33) ** 2], rtol=1e-9)


def test_tilt_place_and_motion_of_target_and_camera_count():
    camera = {"origin_m": [0, 0, 1], "horizontal_fov_deg": 90}  # sees -1 to 1 m across
    small = {**CARD, "width_m": 0.2, "height_m": 0.2}
    behind = framed(scene_of({**small, "rotation_deg": 180}, camera), mono(40, 40))
    assert behind.from_behind and behind.inside == 1
    half = framed(scene_of({**small, "position_m": [0.98, 0, 0]}, camera), mono(40, 40))
    np.testing.assert_allclose(half.inside, 20 / 33)  # points up to 0.02 of -0.1 … 0.1
    assert framed(scene_of({**small, "position_m": [0, 0, 3]}, camera), mono(40, 40)).inside == 0
    keyframes = [{"t_us": 0}, {"t_us": 1000, "translation_m": [2, 0, 0]}]
    for moved in ("target", "camera"):
        scene = scene_of(small, camera, [{"object": moved, "keyframes": keyframes}])
        seen = [framed(scene, mono(40, 40), t).inside for t in (0, 400, 490, 1000)]
        np.testing.assert_allclose(seen, [1, 1, 20 / 33, 0])
    bent = framed(scene_of({**small, "width_m": 1.0, "bend_radius_m": 0.5}, camera), mono(40, 40))
    # the ends of an arc of 1 rad at a radius of 0.5 m: x = 0.5 sin 1, z = 0.5 (1 - cos 1)
    np.testing.assert_allclose(bent.fills[0], 0.5 * np.sin(1) / (1 - 0.5 * (1 - np.cos(1))), rtol=1e-9)


def test_edges_lie_where_they_are_in_the_picture():
    """40 by 30 px see 2 m by 1.5 m; a card from −0.35 to 0.2 m and −0.25 to 0.4 m: columns 13 to 24, rows 7 to 20."""
    card = {"name": "card", "shape": "rectangle", "size_m": [0.55, 0.65, 0], "position_m": [-0.075, 0.075, 0]}
    scene = make_scene(
        objects=[{**card, "reflectance": 0.5}], light=[{"type": "uniform", "illuminant": "D65", "illuminance_lux": 9}],
        camera={"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": 90},
    )  # fmt: skip
    mi = mitsuba()
    built = build(mi, scene.spec)
    view = posed_view(scene.spec, place_camera(scene.spec, mono(40, 30)), 0.0)
    edges = {(13, 10.3): (1, 0), (24, 10.3): (-1, 0), (18.2, 7): (0, 1), (18.2, 20): (0, -1)}
    sides = [np.array(place) + 0.02 * sign * np.array(inwards) for place, inwards in edges.items() for sign in (1, -1)]
    seen = _colours(mi, built.scene, view, *np.array(sides).T).reshape(4, 2, 3)
    card_seen, beyond = _colours(mi, built.scene, view, np.array([18.2, 1.0]), np.array([11.0, 1.0]))
    np.testing.assert_allclose(seen[:, 0], np.tile(card_seen, (4, 1)), rtol=0.15)
    np.testing.assert_allclose(seen[:, 1], np.tile(beyond, (4, 1)), rtol=1e-6)
    assert np.abs(card_seen - beyond).min() > 0.05


@pytest.mark.parametrize(
    ("target", "camera", "motion", "told"),
    [
        ({**CARD, "position_m": [5, 0, 0]}, None, [], UNSEEN),
        ({**CARD, "rotation_deg": 180}, None, [], "sees the target from behind, where it is black"),
        (CARD, None, [], None),
        # the target comes into the picture late in the run
        (
            {**CARD, "position_m": [5, 0, 0]},
            None,
            [{"object": "target", "keyframes": [{"t_us": 0}, {"t_us": 10_000, "translation_m": [-5, 0, 0]}]}],
            None,
        ),
        # a close look at 2 cm of a wide, bent card, between two of the points that are looked for
        (WIDE, {"origin_m": [0.03, 0.05, 0.9], "target_m": [0.07, 0.06, 0], "horizontal_fov_deg": 1.3}, [], None),
        (WIDE, {"origin_m": [0.03, 0.05, 0.9], "target_m": [0.07, 0.06, 2], "horizontal_fov_deg": 1.3}, [], UNSEEN),
        (WIDE, {"origin_m": [0.03, 0.05, 0.9], "target_m": [0.07, 2.3, 0], "horizontal_fov_deg": 1.3}, [], UNSEEN),
        (
            {**WIDE, "rotation_deg": 180},
            {"origin_m": [0.03, 0.05, 0.9], "target_m": [0.07, 0.06, 0], "horizontal_fov_deg": 1.3},
            [],
            "sees the target from behind",
        ),
    ],
    ids=["outside", "behind", "seen", "comes", "between", "away", "beside", "between behind"],
)
def test_a_target_outside_the_picture_is_told(target, camera, motion, told):
    scene = scene_of(target, camera, motion)
    view = place_camera(scene.spec, mono(60, 40))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_if_unseen(scene.spec, view, 10_000)
    assert len(caught) == (told is not None)
    assert all(told in str(warning.message) for warning in caught)


def test_the_warning_comes_before_rendering_and_names_the_file(tmp_path, capsys):
    (tmp_path / "scene.yaml").write_text(
        "schema_version: 1\nname: away\ndescription: looks past its target\n"
        "target: {type: flat, position_m: [7, 0, 0]}\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {fit: target}\n"
    )
    scene = hr.load_scene(tmp_path / "scene.yaml")
    with pytest.warns(HesimWarning, match=r"scene\.yaml: no part of the target"):
        hr.simulate(scene, mono(8, 8), duration_s=0.002)
    with pytest.raises(SystemExit) as caught:
        cli.main(["simulate", str(tmp_path / "scene.yaml"), "--sensor", "reference-mono", "--roi", "8x8",
                  "--duration", "0.002", "--out", str(tmp_path / "out")])  # fmt: skip
    err = capsys.readouterr().err
    assert caught.value.code == 0 and "hesim-render: note:" in err and "no part of the target is in the picture" in err


def test_the_picture_shows_the_surfaces_and_the_region():
    ball = {"name": "ball", "shape": "sphere", "size_m": [0.1] * 3, "position_m": [0, 0, 0.06], "reflectance": 0.0}
    scene = scene_of({**CARD, "reflectance": 0.5}, {"fit": "target", "fit_margin": 0.5}, objects=[ball])
    found = look(scene, mono(60, 40))
    rows, cols, _ = found.picture.shape
    assert (cols, rows) == (640, round(640 / 1.25 * 40 / 60 + 128))
    left, top, right, bottom = found.region
    np.testing.assert_allclose([left, top, right - left, bottom - top], [64, 64, 512, 512 * 2 / 3], rtol=1e-9)
    middle = rows // 2, cols // 2
    assert found.picture[middle].max() < 30  # the ball is black
    card = found.picture[middle[0], int(left + 0.3 * 512)]
    assert np.ptp(card) <= 2 and 170 < card[0] < 195  # reflectance 0.5 near the axis: sRGB 188 times the shade
    sky = found.picture[int(top) + 4, int(left) + 4].astype(int)
    assert sky[2] > sky[0] + 20
    outside = found.picture[int(top) - 8, int(left) - 8]
    assert np.all(outside < sky)
    assert tuple(found.picture[int(top) - 1, cols // 2]) == (255, 255, 255)  # the region's outline


@pytest.mark.parametrize("material", ["dielectric", "conductor", "diffuse"])
def test_glass_and_metal_are_shown_in_grey(material):
    """A ball that is seen, before a black card; a diffuse ball keeps its own reflectance."""
    ball = {"name": "ball", "shape": "sphere", "size_m": [0.1] * 3, "position_m": [0, 0, 0.06], "material": material}
    scene = scene_of({**CARD, "reflectance": 0.0}, {"fit": "target", "fit_margin": 0.5}, objects=[ball])
    picture = look(scene, mono(60, 40)).picture
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
    # sRGB of a reflectance of 0.3 (149), or of Mitsuba's own 0.5 (188), towards the camera
    assert np.all(np.abs(middle - (188.0 if material == "diffuse" else 149.0)) < 6)


def test_an_option_shows_darkness_and_moved_cameras_and_writes_one_picture(tmp_path, capsys):
    def run(*options):
        with pytest.raises(SystemExit) as caught:
            cli.main(
                ["simulate", "dark", "--sensor", "davis346", "--framing", "--out", str(tmp_path / "dark"), *options]
            )
        return caught.value.code, capsys.readouterr()

    code, printed = run()
    assert code == 0 and "of the target is in the picture" in printed.out and "framing in" in printed.out
    assert [path.name for path in tmp_path.iterdir()] == ["dark.png"]
    image = np.asarray(Image.open(tmp_path / "dark.png"))
    assert image.shape[2] == 3 and image[len(image) // 2, 320].min() > 80  # an 18 % card, with no light at all
    code, printed = run()
    assert code == 2 and "--overwrite" in printed.err
    assert run("--overwrite", "--set", "target.position_m=[9,0,0]")[1].out.count(" 0% of the target is in") == 1


def test_a_look_at_a_full_sensor_takes_less_than_three_seconds():
    """Processor time of all threads, the better of two runs; importing and the backend come before."""
    sensor = hr.load_sensor("eiger")
    look(hr.load_scene("dark"), hr.load_sensor("davis346"))
    for name in ("colorchecker", "camera-sweep"):
        taken = []
        for _ in range(2):
            start = time.process_time()
            look(hr.load_scene(name), sensor)
            taken.append(time.process_time() - start)
        assert min(taken) < 3


def test_the_outline_of_a_target_is_its_rim_in_front_of_the_camera():
    """f = 20 px; a card of 0.2 × 0.1 m, 0.3 m to the right and 1.25 m in front of a camera 0.25 m behind its place."""
    camera = {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": 90}
    back = [{"object": "camera", "keyframes": [{"t_us": 0, "translation_m": [0, 0, 0.25]}, {"t_us": 9}]}]
    card = {**CARD, "width_m": 0.2, "height_m": 0.1, "position_m": [0.3, 0, 0]}

    def rim(position):
        scene = scene_of({**card, "position_m": position}, camera, back)
        return outline(scene.spec, place_camera(scene.spec, mono(40, 30)))

    found = rim([0.3, 0, 0])
    low, high = np.array([20 + 20 * 0.2 / 1.25, 15 - 20 * 0.05 / 1.25]), np.array([20 + 20 * 0.4 / 1.25, 15.8])
    np.testing.assert_allclose([found.min(axis=0), found.max(axis=0)], [low, high], rtol=1e-9)
    on_rim = np.isclose(found, low).any(axis=1) | np.isclose(found, high).any(axis=1)
    assert on_rim.all() and len(found) == 4 * 32 + 1
    np.testing.assert_allclose(found[0], found[-1])
    assert rim([0.3, 0, 1.3]) is None and rim([0.3, 0, 1.2]) is not None
    tilted = scene_of({**card, "position_m": [0, 0, 1.2], "rotation_deg": 0, "bend_radius_m": 0.05}, camera, back)
    assert outline(tilted.spec, place_camera(tilted.spec, mono(40, 30))) is None
    assert outline(scene_of(None, camera, objects=[{"name": "a", "shape": "box"}]).spec, None) is None
