"""The main job from end to end: scene to recording."""

import gc

import numpy as np
import pytest
from scipy import constants, stats

import hesim_render as hr
from hesim_render.core.errors import RangeError
from hesim_render.sources.render.scene.builder import BuiltScene


def run(scene, sensor, size, **options):
    overrides = options.pop("overrides", None)
    return hr.simulate(hr.load_scene(scene), hr.load_sensor(sensor, overrides).crop(*size), **options)


def assert_same(one, other):
    assert len(one.frames) == len(other.frames)
    for a, b in zip(one.frames, other.frames, strict=True):
        np.testing.assert_array_equal(a.raw, b.raw)
        np.testing.assert_array_equal(a.electrons_mean, b.electrons_mean)
    np.testing.assert_array_equal(one.events, other.events)


def test_grey_card_electrons_by_hand():
    """18 % grey under 1000 lux of D65, f/4, 5 µm, 400-700 nm: the whole chain written out once more."""
    import colour

    rec = run("flat-field", "reference-mono", (64, 64), duration_s=0.02, samples=256, clean=True)
    d65 = colour.SDS_ILLUMINANTS["D65"]
    photopic = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    nm = np.arange(360.0, 830.01, 0.1)
    shape = np.interp(nm, d65.wavelengths, d65.values)
    irradiance = (
        1000 * shape / (683.002 * np.trapezoid(shape * np.interp(nm, photopic.wavelengths, photopic.values), nm))
    )
    scene = hr.load_scene("flat-field").spec
    assert scene.light.illuminance_lux == 1000 and scene.target.reflectance.flat == 0.18
    band = (nm >= 400) & (nm <= 700)
    photons = nm * 1e-9 / (constants.h * constants.c)
    per_second = 25e-12 * np.pi / 65 * np.trapezoid((0.18 / np.pi * irradiance * photons)[band], nm[band])
    assert rec.frames[0].electrons_mean.mean() == pytest.approx(per_second * 0.010, rel=1e-3)
    expected_dn = np.rint(64 + 0.2 * per_second * 0.010)
    assert abs(np.median(rec.frames[0].raw) - expected_dn) <= 1
    assert len(rec.events) == 0


def test_raw_frames_scatter_about_their_own_truth():
    """z of every pixel against mean and variance of the model; false alarm 1e-6 for each of the two."""
    rec = run("colorchecker", "eiger", (256, 192), duration_s=0.02, samples=64, seed=3)
    sensor = hr.load_sensor("eiger").crop(256, 192)
    frame = rec.frames[0]
    valid = frame.valid
    electrons = np.where(valid, frame.electrons_mean, 0)
    mean = sensor.aps.mean_dn(electrons, frame.exposure_us)
    variance = sensor.aps.variance_dn2(electrons, frame.exposure_us) + 1 / 12
    z = ((frame.raw - mean) / np.sqrt(variance))[valid]
    assert abs(z.mean()) < stats.norm.isf(5e-7) / np.sqrt(z.size)
    # Var(z²) is 2 plus the Poisson's own excess of at most 1/mean electrons; 3 covers it at every pixel here
    assert abs(np.mean(z**2) - 1) < stats.norm.isf(5e-7) * np.sqrt(3 / z.size)
    assert (frame.raw[~valid] == 0).all()


def test_same_seed_same_bits_and_another_seed_other_noise(tmp_path):
    options = {"duration_s": 0.02, "samples": 4}
    one = run("rotating-star", "gen2", (64, 48), seed=1, **options)
    folder = run("rotating-star", "gen2", (64, 48), seed=1, out=tmp_path / "rec", **options)
    assert_same(one, folder)
    assert_same(one, hr.Recording.load(tmp_path / "rec"))
    other = run("rotating-star", "gen2", (64, 48), seed=2, **options)
    assert (one.frames[0].raw != other.frames[0].raw).mean() > 0.5
    assert len(one.events) > 50


@pytest.mark.parametrize("sensor", ["eiger", "gen2", "mipi-hybridevs", "davis346", "reference-mono"])
def test_static_scene_is_silent_when_clean_at_any_sample_count(sensor):
    for samples in (2, 16):
        rec = run("siemens-star", sensor, (64, 64), duration_s=0.05, samples=samples, clean=True)
        assert len(rec.events) == 0


def test_asynchronous_sensor_sees_the_motion():
    rec = run("rotating-star", "davis346", (64, 48), duration_s=0.02, samples=4, clean=True)
    assert len(rec.events) > 500 and {1, -1} == set(rec.events["polarity"].tolist())
    assert (np.diff(rec.events["t_us"]) >= 0).all()
    # continuous time stamps: no more than a few percent share any one microsecond
    _, counts = np.unique(rec.events["t_us"], return_counts=True)
    assert counts.max() < 0.05 * len(rec.events)
    assert rec.event_truth.flux_mean_e_per_s.min() > 0
    relative = rec.event_truth.flux_stderr_e_per_s / rec.event_truth.flux_mean_e_per_s
    assert 0 < np.median(relative) < 0.03  # two rays a half: large on edges, small elsewhere


def test_exposures_times_and_settings_are_recorded():
    rec = run("dark", "gen2", (16, 16), duration_s=0.1, without=["aps.read"], overrides={"aps.exposure_us": 5000})
    assert [f.t_us for f in rec.frames] == [5000, 55_000]
    assert rec.manifest["settings"]["without"] == ["aps.read"] and rec.manifest["settings"]["backend"]
    assert (rec.frames[0].electrons_mean[rec.frames[0].valid] == 0).all()


@pytest.mark.parametrize(
    "options",
    [
        {"duration_s": 0},
        {"duration_s": float("nan")},
        {"seed": -1},
        {"samples": 5},
        {"samples": 0},
        {"without": ["read"]},
    ],
)
def test_arguments_out_of_range(options):
    with pytest.raises(RangeError):
        run("dark", "gen2", (16, 16), **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "how"),
    [
        ("rotating-star", {}),
        ("led-grid", {}),
        ("camera-sweep", {"exact": True}),
        pytest.param("pendulum", {"truth": ["flow"]}, marks=pytest.mark.slow),
    ],
    ids=["default", "flicker", "exact", "truth"],
)
def test_a_run_leaves_no_surfaces_behind(scene, how):
    """Each kernel lists the surfaces of all scenes that are alive: runs would become slower, one after another."""
    mono = hr.load_sensor("reference-mono").crop(8, 6)

    def alive():
        return sum(isinstance(value, BuiltScene) for value in gc.get_objects())

    gc.collect()
    before = alive()
    gc.disable()
    try:
        hr.simulate(hr.load_scene(scene), mono, duration_s=0.003, max_minutes=None, **how)
        assert alive() == before
    finally:
        gc.enable()
