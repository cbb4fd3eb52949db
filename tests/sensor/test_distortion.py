"""Distortion against OpenCV's own functions, its inverse, and models that fold."""

import cv2
import numpy as np
import pytest
import rendering

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sensor.distortion import Distortion
from hesim_render.specs.lens import FisheyeDistortion, OpenCvDistortion

MODELS = {
    "radial": OpenCvDistortion(model="opencv", k1=-0.3, k2=0.09, k3=-0.01),
    "tangential": OpenCvDistortion(model="opencv", k1=-0.22, k2=0.04, p1=2e-3, p2=-1e-3),
    "rational": OpenCvDistortion(model="opencv", k1=0.4, k2=-0.1, p1=1e-3, k3=0.02, k4=0.5, k5=0.03, k6=0.01),
    "pincushion": OpenCvDistortion(model="opencv", k1=0.2, k2=0.02),
    "fisheye": FisheyeDistortion(model="fisheye", k1=-0.04, k2=0.006, k3=-0.001, k4=1e-4),
}
FARTHEST = 0.7


def by_opencv(spec, tangent):
    """Places of tangents [n, 2] by OpenCV, with K the identity."""
    points = np.column_stack([tangent, np.ones(len(tangent))]).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if spec.model == "fisheye" else cv2.projectPoints
    places, _ = project(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(spec.coefficients))
    return places.reshape(-1, 2)


@pytest.mark.parametrize("name", MODELS)
def test_places_are_those_of_opencv_and_the_inverse_returns(name):
    spec = MODELS[name]
    model = Distortion.of(spec, FARTHEST)
    around = np.random.default_rng(1).uniform(-0.5, 0.5, (5000, 2))
    place = around[np.hypot(*around.T) < FARTHEST]
    tangent = model.undistorted(place)
    assert np.abs(model.distorted(tangent) - place).max() < 1e-12
    assert np.abs(by_opencv(spec, tangent) - place).max() < 1e-12
    assert np.abs(model.undistorted(np.zeros(2))).max() == 0
    # the derivatives that Newton's method uses, against differences
    step = 1e-6
    x, y = tangent.T
    u, v, xx, xy, yy = model._formula(x, y)
    right, down = model._formula(x + step, y), model._formula(x, y + step)
    for exact, ahead, here in ((xx, right[0], u), (xy, right[1], v), (xy, down[0], u), (yy, down[1], v)):
        np.testing.assert_allclose((ahead - here) / step, exact, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_the_inverse_converges_as_newtons_method_does(name, monkeypatch):
    """Quadratically, from starts that are right for the radial part; a wrong determinant takes 5 to 10 steps."""
    model, formula, steps = Distortion.of(MODELS[name], FARTHEST), Distortion._formula, []
    assert model.starts
    monkeypatch.setattr(Distortion, "_formula", lambda self, x, y: steps.append(x.size) or formula(self, x, y))
    around = np.random.default_rng(2).uniform(-0.5, 0.5, (3000, 2))
    model.undistorted(around[np.hypot(*around.T) < FARTHEST])
    assert len(steps) <= 4


@pytest.mark.parametrize("name", MODELS)
def test_no_direction_outside_the_image_is_imaged_into_it(name):
    """OpenCV's polynomials come back to the centre beyond their fold; here places go on outwards."""
    model = Distortion.of(MODELS[name], FARTHEST)
    angle = np.radians(np.linspace(0, 89.9, 400))
    for around in np.linspace(0, 2 * np.pi, 7):
        way = np.stack([np.tan(angle) * np.cos(around), np.tan(angle) * np.sin(around)], axis=-1)
        place = np.hypot(*model.distorted(way).T)
        assert np.all(np.diff(place) > 0) and place[-1] > FARTHEST
    beyond = np.array([[1.9, 0.3], [-5.0, 4.0], [0.0, -30.0]])
    np.testing.assert_allclose(model.distorted(model.undistorted(beyond)), beyond, rtol=1e-9, atol=1e-12)


def test_models_that_fold_in_the_image_are_refused():
    """x (1 − 0.4 x²) has its maximum at x = (1/1.2)^½, 42.4°, where it is 2/3 of that: 0.6086."""
    folding = OpenCvDistortion(model="opencv", k1=-0.4)
    Distortion.of(folding, 0.60)
    with pytest.raises(SpecError, match=r"folds at 42\.4° off the axis, where the image is 0\.608"):
        Distortion.of(folding, 0.62)
    pole = OpenCvDistortion(model="opencv", k4=-1.0)  # 1/(1 − r²)
    with pytest.raises(SpecError, match="folds at 45° off the axis"):
        Distortion.of(pole, 60_000.0)
    with pytest.raises(SpecError, match=r"more than 89° to the axis: the image is 1\.553"):
        Distortion.of(FisheyeDistortion(model="fisheye"), 1.56)


def test_the_model_is_used_beyond_the_image_but_not_to_its_fold():
    folding = OpenCvDistortion(model="opencv", k1=-0.4)
    seen, fold = Distortion.of(folding, 0.6).undistorted(np.array([0.6, 0.0]))[0], (1 / 1.2) ** 0.5
    assert seen < Distortion.of(folding, 0.6).limit < fold - 0.01 * (fold - seen)
    wide = Distortion.of(folding, 0.2)
    np.testing.assert_allclose(wide.limit, 1.3 * wide.undistorted(np.array([0.2, 0.0]))[0], rtol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_no_direction_moves_faster_in_the_image_than_told(name):
    """Differences of places for tangents, for shifts over the depth, and for turns of the camera."""
    spec = MODELS[name]
    model = Distortion.of(spec, FARTHEST)
    rng, step = np.random.default_rng(5), 1e-6
    around = rng.uniform(0, 2 * np.pi, 40_000)
    tangent = (np.sqrt(rng.uniform(0, 1, 40_000)) * model.limit)[:, None] * np.stack(
        [np.cos(around), np.sin(around)], 1
    )
    here = by_opencv(spec, tangent)
    way = rng.normal(size=(40_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    point = np.column_stack([tangent, np.ones(40_000)])
    across = way[:, :2] / np.linalg.norm(way[:, :2], axis=1, keepdims=True)
    moved = {
        0: point + step * np.column_stack([across, np.zeros(40_000)]),
        1: point + step * way,
        2: point + step * np.cross(way, point),
    }
    for kind, told in enumerate(model.steepest):
        there = by_opencv(spec, moved[kind][:, :2] / moved[kind][:, 2:])
        speed = np.linalg.norm(there - here, axis=1) / step
        assert speed.max() <= told * 1.001
        assert speed.max() > 0.5 * told  # bounds of the parts are multiplied
    assert np.linalg.norm(by_opencv(spec, moved[0][:, :2]) - here, axis=1).max() / step > 0.98 * model.steepest[0]


def test_the_error_names_file_line_and_key(tmp_path):
    text = (hr.specs.files.data_folder("sensors") / "reference-mono.yaml").read_text(encoding="utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("lens:\n", "lens:\n  distortion: {model: opencv, k1: -20}\n"), encoding="utf-8")
    line = file.read_text(encoding="utf-8").splitlines().index("  distortion: {model: opencv, k1: -20}") + 1
    sensor = hr.load_sensor(file)
    with pytest.raises(SpecError, match="folds") as caught:
        hr.simulate(hr.load_scene("flat-field"), sensor, duration_s=0.03, samples=4)
    assert str(caught.value).startswith(f"{file}:{line}: lens.distortion: the model folds at 7.")
    off = hr.simulate(
        hr.load_scene("flat-field"), sensor.crop(32, 24), duration_s=0.03, samples=4, without=["lens.distortion"]
    )
    assert "distortion" not in off.manifest["lens"]["effects"]
    assert off.truth.camera().distortion_model == "none"


def test_a_field_of_view_is_that_of_the_lens_with_its_distortion():
    for name, spec in MODELS.items():
        sensor = rendering.mono(64, 48, lens__distortion=spec.model_dump())
        camera = {"origin_m": [0, 0, 1], "horizontal_fov_deg": 50}
        scene = rendering.make_scene(light=rendering.FURNACE, camera=camera, objects=[
            {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}])  # fmt: skip
        k = hr.SceneTruth(scene, sensor).camera().k
        edge = by_opencv(spec, np.array([[np.tan(np.radians(25)), 0.0]]))[0, 0]
        np.testing.assert_allclose(k[0, 0] * edge, 32, rtol=1e-9, err_msg=name)
    folding = rendering.mono(64, 48, lens__distortion={"model": "opencv", "k1": -0.4})
    wide = rendering.make_scene(light=rendering.FURNACE, camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": 90},
                                objects=[{"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}])  # fmt: skip
    with pytest.raises(SpecError, match="asks for 45° off the axis, and the model folds at 42"):
        hr.SceneTruth(wide, folding)
