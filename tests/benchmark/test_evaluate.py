"""Evaluation of small benchmarks: which scores come, and that they mean what they say."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from steps import Steps

from benchmarks import small
from hesim_render.benchmark import Benchmark, build_benchmark, evaluate_benchmark, tasks
from hesim_render.benchmark.evaluate import NOTHING, score_summary, score_table, verdicts
from hesim_render.benchmark.pictures import ClipDevelopment
from hesim_render.benchmark.predictions import Predictions
from hesim_render.benchmark.tasks import ClipTasks, Score
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.pixels.evs.events import Label
from hesim_render.specs.files import data_folder


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A turning star seen by event pixels of a hybrid mosaic, which leak."""
    keys = {"aps.frame_rate_hz": 60, "evs.leak_rate_hz": 200}
    spec = small(
        scenes={"given": [{"scene": "rotating-star", "split": "test"}]}, duration_s=0.048,
        sensors=[{"sensor": "mipi-hybridevs", "roi": "24x16", "set": keys}],
        exposures_us=[12_000], sharp={"times_us": [6000, 22667, 39333], "window_us": 500}, truth=["events", "flow"],
    )  # fmt: skip
    return build_benchmark(spec, tmp_path_factory.mktemp("evaluated") / "b", estimate=False)


def test_every_task_has_scores(built, tmp_path):
    told = Steps()
    result = evaluate_benchmark(built.root, out=tmp_path / "r.json", progress=told)
    told.count()
    assert len(told) == 1
    found = result["summary"]
    assert set(found["deblur"]) == {"blurred", "double-integral"}
    assert set(found["interpolate"]) == {"hold", "average", "double-integral"}
    assert set(found["denoise"]) == set(found["fidelity"]) == {"none", "nearest-neighbour", "background-activity"}
    assert {"zero", "plane-fit"} <= set(found["flow"]) and "hdr" not in found and "intensity" not in found
    stored = next(built.clips()).recording.stored_truth
    length = np.linalg.norm(stored.read("frames/flow_forward_px", 0), axis=-1)
    seen = stored.read("frames/visible_forward", 0) & np.isfinite(length)
    zero = next(s for s in result["scores"] if (s["task"], s["method"], s["item"]) == ("flow", "zero", 0))
    assert zero["values"]["epe_px"] == pytest.approx(length[seen].mean()) and length[seen].max() > 0.1
    assert found["flow"]["zero"]["density"]["mean"] == 1
    assert found["denoise"]["none"]["noise_kept"]["mean"] == 1
    assert found["fidelity"]["none"]["count_error"]["count"] + found["denoise"]["none"]["noise_kept"]["count"] >= 1
    blurred = found["deblur"]["blurred"]
    assert 10 < blurred["psnr_db"]["mean"] < 60 and 0 < blurred["ssim"]["mean"] < 1 and blurred["delta_e"]["mean"] > 0
    assert blurred["psnr_db"]["count"] == len(next(built.clips()).recording.frames)
    stored = json.loads((tmp_path / "r.json").read_text())
    assert stored["summary"]["deblur"]["blurred"] == blurred and stored["digest"] == result["digest"]
    assert "double-integral" in score_table(found)
    losers = {text.partition(" loses")[0] for text in result["verdicts"]}
    for task, (nothing, measure, way) in NOTHING.items():
        for method in set(found.get(task, ())) - {nothing}:
            pair = [found[task][name][measure] for name in (method, nothing)]
            if pair[0]["count"] == pair[1]["count"] > 0:
                assert (f"{task}: {method}" in losers) == (way * (pair[0]["mean"] - pair[1]["mean"]) < 0)
    assert losers and stored["verdicts"] == result["verdicts"]


@pytest.mark.parametrize("bright", [0.0, 0.37])
def test_grey_pairs_have_the_exposure_of_the_first_picture(bright):
    """Of colours 0.2126, 0.7152, 0.0722; the brightest half percent of the first becomes 0.95, black stays black."""
    colours = np.random.default_rng(3).random((2, 20, 30, 3)).astype(np.float32) * np.float32(bright)
    luma = colours.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    gain = 0.95 / np.percentile(luma[0], 99.5) if bright else 1.0
    light = np.clip(luma * gain, 0, 1)
    wanted = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    made = ClipDevelopment(None)
    made.linear = lambda raw: colours[raw]
    for found, expected in zip(made.grey_pair(0, 1), wanted, strict=True):
        assert found.dtype == np.uint8 and np.abs(found - expected).max() < 0.51


def test_a_method_that_loses_to_doing_nothing_is_named_with_the_reason():
    def of(task, method, measure, *values):
        return [Score(f"c{k % 2}", task, method, k, {measure: value}) for k, value in enumerate(values)]

    scores = of("deblur", "blurred", "raw_psnr_db", 40.0, 46.0, 30.0, np.inf)
    scores += of("deblur", "double-integral", "raw_psnr_db", 41.0, 41.0, 25.0, 90.0)
    scores += of("deblur", "prediction", "raw_psnr_db", 45.0, 46.5, 25.5)
    scores += of("flow", "zero", "epe_px", 1.5, 2.5) + of("flow", "dis", "epe_px", 1.75, 2.5)
    scores += of("flow", "farneback", "epe_px", 1.25, 2.5)
    first, second = verdicts(scores, {"c0"})
    assert first.startswith(
        "deblur: double-integral loses to doing nothing (blurred): raw_psnr_db 35.67 in place of 38.67, worse in 2 of "
        "3 items. Why: doing nothing has 38.7 dB because little blurs"
    )
    assert "; 2 of the items are of pixels with a fixed tick" in first
    assert second.startswith(
        "flow: dis loses to doing nothing (zero): epe_px 2.125 in place of 2, worse in 1 of 2 items"
    )
    assert "pixels move by 2 px in the mean" in second and "tick" not in second
    assert "tick" not in verdicts(scores)[0] and not verdicts(scores[:4])


@pytest.mark.parametrize(("task", "nothing", "measure", "idle", "reason"), [
    ("deblur", "blurred", "raw_psnr_db", 30.5, "because little blurs"),
    ("deblur", "blurred", "raw_psnr_db", 29.5, "blur leaves 29.5 dB, which leaves much to gain"),
    ("interpolate", "hold", "raw_psnr_db", 30.5, "because little changes"),
    ("interpolate", "hold", "raw_psnr_db", 29.5, "the frame before has 29.5 dB, which leaves much to gain"),
    ("denoise", "none", "f1", 2 * 0.52 / 1.52, "so many events are signal"),
    ("denoise", "none", "f1", 2 * 0.48 / 1.48, "most events are noise"),
])  # fmt: skip
def test_the_reason_is_that_of_the_value(task, nothing, measure, idle, reason):
    """F1 without a filter is 2p/(1 + p), where p is the part of the signal."""
    scores = [Score("c", task, nothing, 0, {measure: idle}), Score("c", task, "mine", 0, {measure: 0.5 * idle})]
    (text,) = verdicts(scores)
    assert reason in text.partition("Why: ")[2]


def test_a_perfect_answer_scores_perfectly(built):
    clip = next(built.clips())
    truth = clip.sharp.raw_dn(1).astype(float)
    found = ClipDevelopment(clip).scores(truth, truth)
    assert found["psnr_db"] == found["raw_psnr_db"] == np.inf and found["ssim"] == 1 and found["delta_e"] == 0
    # twice as far off: 6.02 dB
    step = np.where(np.indices(truth.shape).sum(axis=0) % 2, 8.0, -8.0)
    near, far = (ClipDevelopment(clip).scores(truth + k * step, truth)["raw_psnr_db"] for k in (1, 2))
    assert near - far == pytest.approx(20 * np.log10(2), abs=0.05)


def test_values_of_the_event_grid_reach_the_right_pixels(built):
    """A map that is linear in the place of the event pixels is the same function at all pixels between."""
    development = ClipDevelopment(next(built.clips()))
    layout = development.layout
    cols = layout.shape[1]
    places = layout.evs_pixel.reshape(layout.evs_shape)
    row, col = places // cols, places % cols
    on_mosaic = development.on_mosaic(2.0 * row + 0.5 * col)
    # in every row there are event pixels on both sides of these columns
    r, c = np.mgrid[row.min() : row.max() + 1, col.min(axis=1).max() : col.max(axis=1).min() + 1]
    assert r.size > 100 and on_mosaic[r, c] == pytest.approx(2.0 * r + 0.5 * c)
    assert development.on_mosaic(np.ones(layout.evs_shape)) == pytest.approx(1)


def test_results_of_a_user_are_scored_beside_the_baselines(built, tmp_path):
    """The truth as a result has no error; a file without an item is told."""
    clip = next(built.clips())
    recording = clip.recording
    signal = np.isin(recording.event_labels.label, [Label.SIGNAL, Label.MISMATCH])
    given = {
        "deblur/{}/000000": clip.sharp.raw_dn(0), "interpolate/{}/000001": clip.sharp.raw_dn(1),
        "denoise/{}/000000": signal, "fidelity/{}/000000": signal, "deblur/{}/000077": np.zeros(3),
        "flow/{}/000000": recording.stored_truth.read("frames/flow_forward_px", 0),
    }  # fmt: skip
    for name, values in given.items():
        file = tmp_path / f"{name.format(clip.name)}.npy"
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, values)
    result = evaluate_benchmark(built.root, predictions=tmp_path)
    assert result["unused"] == [f"deblur/{clip.name}/000077.npy"]
    scores = {s["task"]: s["values"] for s in result["scores"] if s["method"] == "prediction"}
    assert scores["deblur"]["raw_psnr_db"] == scores["interpolate"]["raw_psnr_db"] == np.inf
    assert scores["denoise"]["noise_kept"] == 0 and scores["flow"]["epe_px"] == 0
    assert not signal.any() and scores["fidelity"]["count_error"] == 0  # these few pixels see no edge pass


def png(path, image):
    """A PNG of 8 or 16 bits by the encoder of Pillow, which is not that of the decoder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def test_pictures_hold_dn_or_parts_of_the_full_scale(tmp_path):
    rng = np.random.default_rng(1)
    wide, narrow = rng.integers(0, 4096, (5, 7)).astype(np.uint16), rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)
    png(tmp_path / "deblur" / "a" / "000000.png", wide)
    png(tmp_path / "demosaic" / "a" / "000003.png", narrow)
    png(tmp_path / "flow" / "a" / "000000.png", narrow)
    png(tmp_path / "deblur" / "a" / "000001.png", np.dstack([narrow, narrow[..., :1]]))
    png(tmp_path / "deblur" / "a" / "000002.png", wide)
    np.save(tmp_path / "deblur" / "a" / "000002.npy", wide)
    (tmp_path / "deblur" / "a" / "000004.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    given = Predictions(tmp_path, ["deblur", "demosaic", "flow"], ["a"])
    assert np.array_equal(given.read("deblur", "a", 0, (5, 7), 4095), wide)
    np.testing.assert_allclose(given.read("demosaic", "a", 3, (5, 7, 3), 1023), narrow / 255 * 1023)
    assert given.read("deblur", "a", 9, (5, 7), 4095) is None
    for task, item, shape, message in (
        ("deblur", 1, (5, 7), "format rgba; expected grey"), ("deblur", 2, (5, 7), "beside it"),
        ("deblur", 4, (5, 7), "PNG"),
    ):  # fmt: skip
        with pytest.raises(SpecError, match=message):
            given.read(task, "a", item, shape, 4095)
    with pytest.raises(SpecError, match="no unit"):
        given.read("flow", "a", 0, (5, 7, 3))
    again = Predictions(tmp_path, ["deblur", "demosaic", "flow"], ["a"])
    with pytest.raises(SpecError, match=r"expected grey of 8 or 16 bits, \[7, 5\]"):
        again.read("deblur", "a", 0, (7, 5), 4095)
    with pytest.raises(SpecError, match=r"holds float64 \[5, 7\]; expected numbers \[5, 7, 3\]"):
        again.read("deblur", "a", 0, (5, 7, 3), 4095)


def test_exposures_are_merged_at_the_middle_of_the_shortest(monkeypatch):
    """Three clips: the truth is the sharp image at that middle, if it is near in parts of the longest exposure."""
    flux = {300: 5.0, 3_000: 7.0, 20_000: 11.0}

    def clip(exposure_us, count):
        frames = [SimpleNamespace(exposure_start_us=9_000 * k, exposure_us=exposure_us, raw=k) for k in range(count)]
        return SimpleNamespace(name="c", recording=SimpleNamespace(frames=frames, mosaic=None))

    def exposure(raw, exposure_us, aps, mosaic):
        return SimpleNamespace(flux=flux[exposure_us] + raw)

    clips = [clip(300, 4), clip(3_000, 3), clip(20_000, 5)]
    times = np.array([150.0, 4_000.0, 9_000 + 150 + 5_001.0, 18_150.0])
    clips[0].sharp = SimpleNamespace(
        time_us=times, nearest=lambda t_us: int(np.argmin(np.abs(times - t_us))), flux_e_per_s=np.array
    )
    monkeypatch.setattr(tasks, "flux_of", exposure)
    monkeypatch.setattr(tasks, "merged_exposures", lambda given: tuple(each.flux for each in given))
    monkeypatch.setattr(tasks, "flux_scores", lambda value, truth, valid: {"value": value, "truth": truth})
    made = tasks.ClipTasks.__new__(tasks.ClipTasks)
    made._clip, made._longer, made._predictions = clips[0], clips[1:], None
    made._development = SimpleNamespace(sensor=SimpleNamespace(aps=1), layout=SimpleNamespace(aps_mask=None))
    # of the second frame no image is near: 5150 and 5001 µs away from 9150 of a longest exposure of 20000
    found = {(score.item, score.method): (score.values["value"], score.values["truth"]) for score in made.hdr()}
    assert found == {
        (item, method): (value, truth)
        for item, truth in ((0, 0), (2, 3))
        for method, value in (
            ("shortest", 5.0 + item), ("longest", 11.0 + item), ("merge", (5.0 + item, 7.0 + item, 11.0 + item))
        )
    }  # fmt: skip
    made._longer = ()
    assert list(made.hdr()) == []


@pytest.mark.slow
def test_exposures_of_a_still_scene_are_merged_and_light_comes_from_events(tmp_path):
    """Grey steps in 0.3, 3 and 20 ms; nothing moves, so the events are noise, and their sum knows nothing."""
    spec = small(
        scenes={"given": [{"scene": "step-wedge", "split": "test"}]}, truth=["events"], quality=1,
        exposures_us=[20_000, 300, 3000], sharp={"times_us": [250], "window_us": 200}, duration_s=0.021,
    )  # fmt: skip
    built = build_benchmark(spec, tmp_path / "b", estimate=False)
    found = evaluate_benchmark(built.root, tasks=["hdr", "intensity"])["summary"]
    print(found)
    assert found["hdr"]["merge"]["log2_rmse"]["count"] == 1  # one item of the shortest clip, not one of each
    assert found["hdr"]["merge"]["log2_rmse"]["mean"] < 0.5 * found["hdr"]["shortest"]["log2_rmse"]["mean"]
    assert found["hdr"]["merge"]["psnr_mu_db"]["mean"] > found["hdr"]["longest"]["psnr_mu_db"]["mean"]
    assert found["intensity"]["leaky-sum"]["log_rmse"]["mean"] > 0.5 and len(found["intensity"]) == 1


def test_flow_of_the_event_grid_is_in_pixels_of_the_mosaic(built):
    """A flow to the next event pixel ends at the place of that pixel, whatever their pitch."""
    development = ClipDevelopment(next(built.clips()))
    layout = development.layout
    rows, cols = layout.evs_shape
    flow = np.full((rows, cols, 2), [1.0, 2.0])
    flow[:, cols // 2 :] = np.nan
    found = development.flow_on_mosaic(flow)
    place = layout.evs_pixel.reshape(rows, cols).astype(int)
    row, col = np.divmod(place, layout.shape[1])
    to_right, down = (col[0, -1] - col[0, 0]) / (cols - 1), (row[-1, 0] - row[0, 0]) / (rows - 1)
    assert found[row[2, 0], col[2, 0]] == pytest.approx([to_right, 2 * down], rel=0.2)  # places alternate by a pixel
    assert np.isnan(found[row[2, -1], col[2, -1]]).all() and to_right >= 2


def test_means_are_over_finite_values():
    scores = [Score("a", "t", "m", k, {"v": value}) for k, value in enumerate((1.0, 3.0, np.inf))]
    assert score_summary(scores)["t"]["m"]["v"] == {"count": 2, "mean": 2.0, "std": 1.0}


def test_what_cannot_be_evaluated_is_refused(built, tmp_path):
    with pytest.raises(RangeError, match="did you mean 'deblur'"):
        evaluate_benchmark(built.root, tasks=["debblur"])
    with pytest.raises(RangeError, match="a split that has clips"):
        evaluate_benchmark(built.root, split="val")
    with pytest.raises(SpecError, match="no benchmark"):
        evaluate_benchmark(tmp_path)
    shutil.copytree(built.root, tmp_path / "changed")
    clip = next(Benchmark(tmp_path / "changed").clips())
    (clip.folder / "clip.json").write_text("{}")
    with pytest.raises(SpecError, match="was changed or removed"):
        evaluate_benchmark(tmp_path / "changed")


@pytest.mark.slow
def test_the_double_integral_gains_on_renders_and_noise_takes_it(tmp_path):
    """An asynchronous sensor before a star that turns by a spoke within the exposure."""
    text = (data_folder("scenes") / "rotating-star.yaml").read_text()
    text = text.replace("illuminance_lux: 2000", "illuminance_lux: 60").replace("t_us: 2000000", "t_us: 600000")
    (tmp_path / "star.yaml").write_text(text)
    levels = [{"name": "clean", "clean": True}, {"name": "standard"}, {"name": "noisy", "set": NOISY}]
    spec = small(
        scenes={"given": [{"scene": "star.yaml", "split": "test"}]}, duration_s=0.026,
        sensors=[{"sensor": "davis346", "roi": "64x48"}], exposures_us=[24_000], quality=1, noise=levels,
        sharp={"times_us": [12_000], "window_us": 500}, truth=[],
    ).model_copy(update={"folder": tmp_path})  # fmt: skip
    built = build_benchmark(spec, tmp_path / "b", estimate=False)
    gains = {}
    for clip in built.clips():
        scores = {score.method: score.values["raw_psnr_db"] for score in ClipTasks(clip).deblur()}
        gains[clip.content["noise"]] = scores["double-integral"] - scores["blurred"]
    print(gains)
    # docs/benchmarks.md states 11.1, 6.0 and 4.9 dB
    assert gains["clean"] > 8 and gains["clean"] > gains["standard"] + 3 and gains["noisy"] > 2, gains
    assert gains["standard"] > gains["noisy"] + 0.5, gains


NOISY = {"evs.leak_rate_hz": 50.0}
