"""Generated scenes: pure functions of their numbers, within their ranges, and without parts that splits share."""

import itertools
import json
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from benchmarks import generated, small
from hesim_render.benchmark.draws import draws, shares
from hesim_render.benchmark.generator import Generator, _into_cube
from hesim_render.benchmark.materials import KINDS, texture
from hesim_render.benchmark.meshes import mesh
from hesim_render.benchmark.plan import BenchmarkPlan, shared_parts
from hesim_render.core.errors import HesimError, SpecError
from hesim_render.specs.benchmark import SharpSpec, read_benchmark
from hesim_render.specs.scene import SceneSpec, read_scene


@pytest.fixture(scope="module")
def many():
    """24 scenes without pictures, which take most of the time."""
    plan = BenchmarkPlan(generated(24, scenes={"textured": 0.1}))
    return plan, [plan.scene_files(clip) for clip in plan.clips]


def test_a_scene_depends_on_its_numbers_alone():
    few, more = (
        Generator(generated(2, scenes={"objects": [1, 3]})),
        Generator(generated(40, scenes={"objects": [1, 3]})),
    )
    assert few.scene(1, 0, 0).content["mitsuba"] != few.scene(0, 0, 0).content["mitsuba"]
    # the number of scenes decides splits, and splits the pools of measured reflectances; all else stays
    a, b = (g.scene(1, 2, 1).content for g in (few, more))
    assert a["motion"] == b["motion"] and a["mitsuba"]["inline"]["lamp0"] == b["mitsuba"]["inline"]["lamp0"]
    assert few.scene(1, 0, 0).content == Generator(generated(2, scenes={"objects": [1, 3]})).scene(1, 0, 0).content


def test_motion_and_light_change_alone():
    generator = Generator(generated(3))
    base, moved, relit = (generator.scene(2, *numbers).content for numbers in ((0, 0), (1, 0), (0, 1)))

    def solids(content):
        return {k: v for k, v in content["mitsuba"]["inline"].items() if not k.startswith("lamp")}

    assert solids(base) == solids(moved) == solids(relit)
    assert base["motion"] == relit["motion"] != moved["motion"]
    lamps = [{k: v for k, v in c["mitsuba"]["inline"].items() if k.startswith("lamp")} for c in (base, moved, relit)]
    assert lamps[0] == lamps[1] != lamps[2]


def test_every_scene_file_is_valid(many, tmp_path):
    _, scenes = many
    for number, scene in enumerate(scenes[:8]):
        file = scene.write(tmp_path / str(number))
        spec = read_scene(file)
        assert isinstance(spec, SceneSpec) and spec.motion
        named = [v for k, v in _items(scene.content["mitsuba"]) if k == "filename"]
        assert all((file.parent / name).is_file() for name in named)


def _items(node):
    if isinstance(node, dict):
        for key, value in node.items():
            yield key, value
            yield from _items(value)


def test_splits_share_no_part(many):
    plan, scenes = many
    parts = {clip.name: (clip.split, set(s.parts)) for clip, s in zip(plan.clips, scenes, strict=True)}
    assert shared_parts(parts) == []
    assert {split for split, _ in parts.values()} == {"train", "val", "test"}
    # the check sees a leak: the parts of a train scene in a test scene
    train = next(names for split, names in parts.values() if split == "train")
    assert {line[0] for line in shared_parts(parts | {"copy": ("test", train)})} == train


def test_users_parts_join_and_each_belongs_to_one_split(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    for number in range(6):
        pixels = np.full((4, 4, 3), 40 * number, np.uint8)
        Image.fromarray(pixels).save(folder / f"t{number}.png")
        # a mesh of another size and place, which must be brought into the view
        (folder / f"m{number}.obj").write_text(f"v 9 0 0\nv 9 {number + 4} 0\nv 9 0 {number + 5}\nf 1 2 3\n")
    spec = generated(30, scenes={"parts": "mine", "textured": 1.0}).model_copy(update={"folder": tmp_path})
    plan = BenchmarkPlan(spec)
    scenes = [plan.scene_files(clip) for clip in plan.clips[:12]]
    used = Counter(part for scene in scenes for part in scene.parts if part.startswith("file:"))
    assert len(used) >= 4
    parts = {clip.name: (clip.split, set(s.parts)) for clip, s in zip(plan.clips, scenes, strict=False)}
    assert shared_parts(parts) == []
    for scene in scenes:
        for name, shape in scene.content["mitsuba"]["inline"].items():
            if name.startswith("solid") and shape["type"] == "obj" and shape["filename"] in scene.pictures:
                text = scene.pictures[shape["filename"]].read_text()
                corners = np.array([line.split()[1:] for line in text.splitlines() if line[0] == "v"], float)
                world = np.array(shape["to_world"]) @ np.column_stack([corners, np.ones(3)]).T
                assert np.abs(world[:3]).max() < 0.42 + 0.5  # within the view, and at most as large as it


def test_a_folder_without_parts_is_refused(tmp_path):
    with pytest.raises(SpecError, match="no mesh"):
        Generator(generated(2, scenes={"parts": "none"}).model_copy(update={"folder": tmp_path})).check()


def test_contrast_bounds_the_reflectances():
    """All reflectances of a scene lie within mean·(1 ± contrast), but for colour, which may add as much again."""
    low = Generator(generated(6, scenes={"contrast": [0.01, 0.02], "materials": {"metal": 0}, "textured": 0}))
    for number in range(6):
        values = [
            value
            for key, spectrum in _items(low.scene(number, 0, 0).content["mitsuba"]["inline"])
            if key in ("reflectance", "diffuse_reflectance") and spectrum["type"] == "irregular"
            for value in [np.mean(spectrum["values"])]
        ]
        assert max(values) / min(values) < (1.02 / 0.98) * 1.05


def test_speeds_and_levels_span_their_ranges():
    """Of 200 motions and lights, drawn without their scenes: log-uniform within limits that bound every value."""
    from hesim_render.benchmark.lamps import lamps
    from hesim_render.benchmark.motions import tracks

    spec = generated(1, motions={"speed": [0.05, 5.0], "camera": 0.0}, lights={"lamps": [1, 1]})
    speeds, levels = [], []
    for number in range(200):
        for track in tracks(draws(1, 1, number), spec.motions, {"a": 0.2}, 1_000_000):
            keys = track["keyframes"]
            steps = [
                np.linalg.norm(np.subtract(b.get("translation_m", [0] * 3), a.get("translation_m", [0] * 3)))
                / ((b["t_us"] - a["t_us"]) * 1e-6)
                for a, b in zip(keys[:-1], keys[1:], strict=True)
            ]
            if max(steps) > 0:
                speeds.append(max(steps))
        found, _ = lamps(draws(1, 2, number), spec.lights)
        if found["lamp0"]["type"] == "constant":
            from hesim_render.spectral.spectrum import Spectrum, illuminance_lux

            radiance = found["lamp0"]["radiance"]
            levels.append(
                np.pi * illuminance_lux(Spectrum(np.array(radiance["wavelengths"]), np.array(radiance["values"])))
            )
    assert 0.05 * 0.99 < min(speeds) < 0.1 and 2.5 < max(speeds) < 5.0 * 1.01
    # 30 to 10 000 lx; spectra are sampled every 5 nm, which moves the level of line spectra by a few percent
    assert 30 * 0.9 < min(levels) < 120 and 2500 < max(levels) < 10_000 * 1.1


@pytest.mark.parametrize("duration_us", [20_000, 2_000_000])
def test_motions_have_their_speed(duration_us):
    """Every piece of every way, and the rim of what turns on the spot; 0.1 % for whole microseconds."""
    from hesim_render.benchmark.motions import camera_track, solid_track

    for number in range(80):
        rng = draws(7, 1, number)
        for track in (solid_track(rng, "a", 1.5, 0.2, duration_us), camera_track(rng, 1.5, duration_us)):
            keys = track["keyframes"]
            if "translation_m" not in keys[-1]:
                assert np.pi * 0.2 * 1e6 / keys[-1]["t_us"] == pytest.approx(1.5, rel=1e-3)
                continue
            for a, b in zip(keys[:-1], keys[1:], strict=True):
                way = np.linalg.norm(np.subtract(b["translation_m"], a["translation_m"]))
                assert way / (b["t_us"] - a["t_us"]) * 1e6 == pytest.approx(1.5, rel=1e-3)


def test_a_small_lamp_gives_its_illuminance():
    """A point, a sun, and a panel from the inverse-square law, written out again."""
    from hesim_render.benchmark.lamps import lamps

    spec = generated(1, lights={"lamps": [1, 1], "illuminance_lux": 500.0, "illuminants": ["D65"]}).lights
    from hesim_render.spectral.spectrum import Spectrum, illuminance_lux

    seen = set()
    for number in range(60):
        lamp = lamps(draws(3, 2, number), spec)[0]["lamp0"]

        def lux(node):
            return illuminance_lux(Spectrum(np.array(node["wavelengths"]), np.array(node["values"])))

        if lamp["type"] == "point":
            place = np.array(lamp["position"])
            level = lux(lamp["intensity"]) * place[2] / np.linalg.norm(place) ** 3
        elif lamp["type"] == "directional":
            way = np.array(lamp["direction"])
            level = lux(lamp["irradiance"]) * -way[2] / np.linalg.norm(way)
        elif lamp["type"] in ("rectangle", "sphere"):
            matrix = np.array(lamp["to_world"])
            place, size = matrix[:3, 3], 2 * np.linalg.norm(matrix[:3, 0])
            area = size**2 if lamp["type"] == "rectangle" else np.pi * size**2 / 4
            level = lux(lamp["emitter"]["radiance"]) * area * place[2] / np.linalg.norm(place) ** 3
        else:
            level = np.pi * lux(lamp["radiance"])
        seen.add(lamp["type"])
        assert level == pytest.approx(500, rel=2e-3)
    assert seen == {"point", "directional", "rectangle", "sphere", "constant"}


@pytest.mark.parametrize("kind", KINDS)
def test_textures_use_their_whole_scale(kind):
    value = KINDS[kind](np.random.default_rng(3))
    assert value.shape == (256, 256) and 0 <= value.min() < 0.15 and 0.85 < value.max() <= 1
    assert value.std() > 0.1


def test_textures_hold_their_range():
    for seed in range(6):
        picture = texture(np.random.default_rng(seed), 0.3, 0.32) / 255.0
        linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)
        # colours differ by at most half of the contrast, 0.016
        assert linear.min() > 0.29 and linear.max() < 0.33


def test_meshes_are_closed_and_fill_the_cube():
    for seed in range(8):
        lines = mesh(np.random.default_rng(seed)).splitlines()
        points = np.array([line.split()[1:] for line in lines if line[0] == "v"], dtype=float)
        faces = np.array([line.split()[1:] for line in lines if line[0] == "f"], dtype=int) - 1
        assert np.ptp(points, axis=0).max() == pytest.approx(1, abs=1e-5) and np.abs(points).max() < 0.5 + 1e-5
        _, point = np.unique(points.round(5), axis=0, return_inverse=True)
        faces = point.ravel()[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
        edges = Counter(tuple(e) for f in faces for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0])))
        # every edge is walked once in each direction: closed, and all faces look to the same side
        assert all(edges[b, a] == count == 1 for (a, b), count in edges.items())


def test_meshes_of_files_are_moved_and_scaled_alike_in_all_directions(tmp_path):
    """Corners of a box of 4 x 6 x 40 about (3, 5, 10): its longest side becomes 1."""
    corners = np.array(list(itertools.product((1, 5), (2, 8), (-10, 30))), dtype=float)
    lines = ["o box", *(f"v {x} {y} {z}" for x, y, z in corners), "vn 0 0 90", "f 1 2 3"]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    matrix = _into_cube(tmp_path / "box.obj")
    placed = corners @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(placed, (corners - [3, 5, 10]) / 40, atol=1e-12)


def test_shares_give_each_item_to_one_split():
    found = shares(range(20), [0.7, 0.15, 0.15], "key")
    assert sorted(item for part in found for item in part) == list(range(20))
    assert [len(part) for part in found] == [14, 3, 3]
    assert [len(part) for part in shares(range(3), [0.7, 0.15, 0.15], "k")] == [1, 1, 1]
    assert [len(part) for part in shares(range(5), [1.0, 0.0, 0.0], "k")] == [5, 0, 0]
    # what is left over goes to the largest remainders: of 13.8, 5.75 and 3.45
    assert [len(part) for part in shares(range(23), [0.6, 0.25, 0.15], "k")] == [14, 6, 3]
    assert shares(range(20), [0.5, 0.5], "a") != shares(range(20), [0.5, 0.5], "b")


# ---- the plan -----------------------------------------------------------------------------------------


def test_the_plan_has_every_combination():
    spec = generated(
        3, motions={"count": 2}, lights={"count": 2}, exposures_us=[1000, [2000, 4000]], seeds=[1, 2],
        noise=[{"name": "standard"}, {"name": "clean", "clean": True}],
        sensors=[{"sensor": "gen2", "roi": "32x24"}, {"sensor": "reference-mono", "roi": "32x24"}],
    )  # fmt: skip
    clips = BenchmarkPlan(spec).clips
    assert len(clips) == spec.combinations == 3 * 2 * 2 * 2 * 2 * 2 * 2
    assert len({clip.name for clip in clips}) == len(clips)
    assert {clip.exposure_us for clip in clips if clip.exposure == 0} == {1000}
    drawn = {clip.exposure_us for clip in clips if clip.exposure == 1}
    assert len(drawn) > 20 and min(drawn) >= 2000 and max(drawn) <= 4000
    assert all(len({c.split for c in clips if c.scene == scene}) == 1 for scene in range(3))


def test_fewer_clips_are_drawn_from_all_scenes():
    spec = generated(10, motions={"count": 5}, clips=20)
    clips = BenchmarkPlan(spec).clips
    assert len(clips) == 20 and Counter(clip.scene for clip in clips) == dict.fromkeys(range(10), 2)


def test_a_given_scene_in_two_splits_is_refused():
    given = [{"scene": "rotating-star", "split": "train"}, {"scene": "rotating-star", "split": "test"}]
    with pytest.raises(SpecError, match="must not leak"):
        BenchmarkPlan(small(scenes={"given": given})).check()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": [{"sensor": "gen3"}]}, "no sensor named 'gen3'"),
        ({"scenes": {"given": [{"scene": "roating-star", "split": "val"}]}}, "did you mean 'rotating-star'"),
        ({"exposures_us": [900_000]}, "longer than a frame period"),
        ({"noise": [{"name": "x", "without": ["aps.raed"]}]}, "aps.read"),
        ({"truth": ["flwo"]}, "flow"),
        ({"lights": {"illuminants": ["D99"]}}, "D99"),
    ],
)
def test_what_cannot_be_built_is_refused_before_the_start(changes, message):
    with pytest.raises(HesimError, match=message):
        BenchmarkPlan(small(**changes)).check()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scenes: {count: 0}", "count above 0"),
        ("scenes: {count: 1, size: [0.5, 0.1]}", "is above 0.1"),
        ("scenes: {count: 1, objects: [1.5, 2]}", "whole numbers"),
        ("scenes: {count: 1}\nexposures_us: [[9, 3]]", "smallest, largest"),
        ("scenes: {count: 1}\nsplits: {train: 0.9, val: 0.2, test: 0}", "add up to 1.1"),
        ("scenes: {count: 1}\nsharp: {every_us: 10, times_us: [5]}", "every_us or times_us"),
        ("scenes: {count: 1}\nsharp: {times_us: [5], window_us: 900}", "no window"),
        ("scenes: {count: 1000000}\nseeds: [1, 2]", "at most"),
        ("scenes: {count: 1}\nseeds: [3, 3]", "each name once"),
        ("scenes: {count: 1}\nnoise: [{name: a, clean: true, without: [aps.read]}]", "no noise at all"),
        ("scenes: {count: 1, materials: {diffuse: 0, plastic: 0, rough_plastic: 0, metal: 0}}", "at least one"),
        ("scenes: {count: 1}\nmotion: {}", "motions"),
    ],
)
def test_a_wrong_specification_is_one_clear_error(tmp_path, text, message):
    file = tmp_path / "b.yaml"
    file.write_text(f"schema_version: 1\nname: b\ndescription: d\nsensors: [{{sensor: gen2}}]\n{text}\n")
    with pytest.raises(SpecError, match=message) as error:
        read_benchmark(file)
    assert str(file) in str(error.value)


def test_sharp_times_lie_within_the_run():
    assert SharpSpec(every_us=1000, window_us=500).middles_us(3000) == [1000, 2000]
    assert SharpSpec(every_us=1000, window_us=500).middles_us(3000, readout_us=800) == [1000]
    assert SharpSpec(times_us=(100, 250, 2750, 2900), window_us=500).middles_us(3000) == [250, 2750]


def test_the_specification_survives_its_own_text(tmp_path):
    spec = generated(2, exposures_us=[[1000, 2000]])
    assert type(spec).model_validate(json.loads(json.dumps(spec.model_dump(mode="json")))) == spec


def test_no_lamp_of_some_extent_stands_in_the_view():
    """Points of panels and balls, projected: the camera at z = 2 m sees 1 m across at z = 0, and moves a little."""
    from hesim_render.benchmark.lamps import lamps

    spec = generated(1, lights={"lamps": 3}).lights
    unit = np.array(list(itertools.product((-1, 0, 1), repeat=3)), dtype=float)
    seen, count = [], 0
    for number in range(600):
        for emitter in lamps(np.random.default_rng(number), spec)[0].values():
            if emitter["type"] not in ("rectangle", "sphere"):
                continue
            count += 1
            of_ball = unit / np.maximum(1, np.linalg.norm(unit, axis=1))[:, None]
            corners = unit * [1, 1, 0] if emitter["type"] == "rectangle" else of_ball
            matrix = np.array(emitter["to_world"])
            points = corners @ matrix[:3, :3].T + matrix[:3, 3]
            for step in (-0.1, 0, 0.1):  # of the camera, along each axis
                depth = 2 - points[:, 2]
                inside = (depth > 0) & (np.abs(points[:, :2] - step) < 0.25 * depth[:, None]).all(axis=1)
                seen.append(bool(inside.any()))
    assert count > 600 and not any(seen)
