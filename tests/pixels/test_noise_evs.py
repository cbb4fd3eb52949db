"""The event noise model against the formulas, written out again here."""

import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs.model import EVS_TERMS, LEAST_THRESHOLD_REL, EvsNoise
from hesim_render.sensor.reading import read_sensor

COEFFICIENTS = {"beta1": 0.8, "beta2": 3.0, "beta3": 0.1, "beta4": 0.05, "beta5": -0.3}


def model(name="reference-mono", crop=None, scale=None, **overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    spec = read_sensor(name, changes)
    layout = Layout.full(spec)
    positions = len(spec.positions("evs"))
    scale = np.ones(positions) if scale is None else np.asarray(scale, dtype=float)
    return EvsNoise(spec.evs, layout.crop(*crop) if crop else layout, spec.device_seed, scale)


def level_and_variance(electrons, b, law, k=0.2, t_ref=10_000, t_evs=1000, scale=1.0):
    """x and s² as in the design's section 4.2."""
    signal = k * (electrons / t_evs) * t_ref * scale
    x = b["beta1"] * signal + b["beta2"]
    if law == "linear":
        variance = (b["beta3"] * signal) ** 2 + b["beta4"] ** 2 + 2 * b["beta5"] * b["beta3"] * b["beta4"] * signal
    else:
        variance = b["beta3"] ** 2 * signal + b["beta4"] ** 2
        variance += 2 * b["beta5"] * b["beta3"] * b["beta4"] * np.sqrt(signal)
    return x, variance


def test_thresholds_are_the_deviates_of_each_polaritys_own_stream_on_the_full_sensor():
    """Keys and signs too: a device of a seed stays that device, whatever region of it is read."""
    noise = model("eiger", crop=(24, 16), scale=np.ones(4), evs__threshold_mismatch_rel=0.07,
                  evs__contrast_threshold_on=0.21, evs__contrast_threshold_off=0.34)  # fmt: skip
    region, spec = noise.layout, noise.layout.spec
    assert region.row0 > 0 and region.col0 > 0 and region.row0 != region.col0
    row, col = np.divmod(region.evs_pixel, region.cols)
    pixel = ((row + region.row0) * spec.geometry.cols + col + region.col0).astype(np.uint32)
    for own, nominal, stream in (
        (noise.threshold_on_map, 0.21, Stream.THRESHOLD_ON), (noise.threshold_off_map, 0.34, Stream.THRESHOLD_OFF),
    ):  # fmt: skip
        expected = nominal * (1 + 0.07 * device_normal(noise.device_seed, stream, pixel).astype(float))
        np.testing.assert_allclose(own, expected, rtol=1e-6)


PAIRS = [(0.0, 0.0), (0.0, 2.0), (2.0, 0.0), (10.0, 10.0), (10.0, 11.0), (30.0, 27.0), (100.0, 100.0), (100.0, 104.0),
         (3000.0, 3000.0), (3000.0, 3100.0)]  # fmt: skip


@pytest.mark.parametrize("law", ("linear", "sqrt"))
def test_probabilities_against_q(law):
    noise = model(evs__coefficients=[COEFFICIENTS], evs__shot_law=law, evs__contrast_threshold_on=0.12,
                  evs__contrast_threshold_off=0.15)  # fmt: skip
    for before, after in PAIRS:
        (x0, s0), (x1, s1) = (level_and_variance(e, COEFFICIENTS, law) for e in (before, after))
        change, sigma = np.log(x1 / x0), np.sqrt(s0 / x0**2 + s1 / x1**2)
        p_on, p_off = noise.event_probability(before, after)
        assert p_on == pytest.approx(stats.norm.sf(0.12, change, sigma), rel=1e-9)
        assert p_off == pytest.approx(stats.norm.cdf(-0.15, change, sigma), rel=1e-9)


@pytest.mark.parametrize("law", ("linear", "sqrt"))
def test_device_level_matches(law):
    table = [
        {**COEFFICIENTS, "beta1": 0.8 + 0.1 * p, "beta3": 0.1 + 0.02 * p, "beta5": -1.0 + 0.6 * p} for p in range(4)
    ]
    noise = model("eiger", crop=(64, 64), scale=[1.0, 0.5, 2.0, 1.5], evs__shot_law=law, evs__coefficients=table)
    electrons = np.random.default_rng(0).uniform(0, 500, noise.layout.evs_shape)
    log, relative = noise.log_level(from_host(jit().Float, electrons))
    position = noise.layout.evs_position
    reference = noise.spec.signal_reference
    for p, scale in enumerate((1.0, 0.5, 2.0, 1.5)):
        b = {name: getattr(noise.spec.coefficients[p], name) for name in COEFFICIENTS}
        x, s2 = level_and_variance(
            electrons[position == p], b, law, reference.k_dn_per_e, reference.t_ref_us, noise.spec.window_us, scale
        )
        here = (position == p).ravel()
        np.testing.assert_allclose(np.array(log)[here], np.log(x), rtol=0, atol=2e-6)
        # where correlation −1 makes s² a difference of near equals, single precision shows
        np.testing.assert_allclose(np.array(relative)[here], s2 / x**2, rtol=1e-5, atol=1e-9)


def test_positions():
    noise = model("eiger", crop=(64, 64), scale=[1.0, 0.5, 2.0, 1.5], evs__threshold_mismatch_rel=0.0)
    known = noise.layout.spec.positions("evs")
    assert len(known) == 4
    by_number = [noise.event_probability(20.0, 22.0, position=p) for p in range(4)]
    by_place = [noise.event_probability(20.0, 22.0, position=tuple(p)) for p in known]
    assert by_number == by_place
    assert by_number[0] == noise.event_probability(20.0, 22.0)
    assert len({float(p_on) for p_on, _ in by_number}) == 4
    image_on, image_off = noise.event_probability(np.full((32, 32), 20.0), 22.0)
    for p in range(4):
        here = noise.layout.evs_position == p
        np.testing.assert_allclose(image_on[here], by_number[p][0], rtol=1e-12)
        np.testing.assert_allclose(image_off[here], by_number[p][1], rtol=1e-12)
    for wrong in (4, -1, (0, 0)):
        with pytest.raises(RangeError, match="position"):
            noise.event_probability(1.0, 1.0, position=wrong)
    with pytest.raises(RangeError, match="position"):
        noise.event_probability(np.zeros((32, 32)), 1.0, position=0)


def test_parameters_of_some_pixels():
    """Those of listed pixels, in their order; positions, thresholds and corners differ."""
    table = [{**COEFFICIENTS, "beta1": 0.8 + 0.1 * p} for p in range(4)]
    corner = {"cutoff_hz": 300.0, "signal_dn": 200.0, "min_cutoff_hz": 3.0}
    noise = model("eiger", crop=(64, 64), scale=[1.0, 0.5, 2.0, 1.5], evs__coefficients=table,
                  evs__threshold_mismatch_rel=0.1, evs__photoreceptor=corner)  # fmt: skip
    every, chosen = noise.on_device, np.array([700, 3, 4, 98, 1023], np.uint32)
    some = every.at(from_host(jit().UInt32, chosen))
    log = np.random.default_rng(0).uniform(2.0, 6.0, 32 * 32).astype(np.float32)
    for own, all_ in (
        (some.key, every.key),
        (some.thresholds[0], every.thresholds[0]),
        (some.thresholds[1], every.thresholds[1]),
        (some.log_of_largest_corner, every.log_of_largest_corner),
        (
            some.corner_hz(from_host(jit().Float, log[chosen]), noise.photoreceptor),
            every.corner_hz(from_host(jit().Float, log), noise.photoreceptor),
        ),
    ):
        expected = np.array(all_)[chosen]
        np.testing.assert_array_equal(np.array(own), expected)
        assert len(np.unique(expected)) > 1


def test_images_use_each_pixels_thresholds():
    noise = model("gen2", crop=(256, 256), evs__threshold_mismatch_rel=0.1)
    image = np.full((64, 64), 5.0)
    p_on, p_off = noise.event_probability(image, image)
    b = noise.spec.coefficients[0]
    x, s2 = level_and_variance(5.0, b.model_dump(), "linear", 0.16)
    sigma = np.sqrt(2 * s2) / x
    np.testing.assert_allclose(p_on, stats.norm.sf(noise.threshold_on_map / sigma), rtol=1e-9)
    np.testing.assert_allclose(p_off, stats.norm.sf(noise.threshold_off_map / sigma), rtol=1e-9)


def test_threshold_maps():
    """1048576 pixels; z = 5.5 each."""
    noise = model(evs__threshold_mismatch_rel=0.1, evs__contrast_threshold_on=0.2, evs__contrast_threshold_off=0.3)
    on, off = noise.threshold_on_map / 0.2, noise.threshold_off_map / 0.3
    for relative in (on, off):
        assert abs(relative.mean() - 1) < 5.5 * 0.1 / 1024
        assert relative.std() == pytest.approx(0.1, rel=5.5 / 1024 / np.sqrt(2))
    assert abs(np.corrcoef(on.ravel(), off.ravel())[0, 1]) < 5.5 / 1024
    crop = EvsNoise(noise.spec, noise.layout.crop(100, 50), noise.device_seed, np.ones(1))
    top, left = crop.layout.row0, crop.layout.col0
    np.testing.assert_array_equal(crop.threshold_on_map, noise.threshold_on_map[top : top + 50, left : left + 100])
    other = EvsNoise(noise.spec, noise.layout, noise.device_seed + 1, np.ones(1))
    assert abs(np.corrcoef(other.threshold_on_map.ravel(), noise.threshold_on_map.ravel())[0, 1]) < 5.5 / 1024
    wide = model(evs__threshold_mismatch_rel=0.45)
    assert wide.threshold_on_map.min() == pytest.approx(LEAST_THRESHOLD_REL * wide.spec.contrast_threshold_on)
    assert model(evs__threshold_mismatch_rel=0.0).threshold_on_map == 0.1


def test_terms():
    noise = model(evs__coefficients=[{**COEFFICIENTS, "beta5": 0.0}], evs__threshold_mismatch_rel=0.1,
                  evs__leak_rate_hz=2.0, evs__shot_law="sqrt")  # fmt: skip
    electrons = jit().Float(20.0)

    def relative_variance(changed):
        return float(changed.log_level(electrons)[1][0])

    x = 0.8 * 40 + 3.0
    assert relative_variance(noise.without("shot")) == pytest.approx(0.05**2 / x**2, rel=1e-5)
    assert relative_variance(noise.without("dark_current")) == pytest.approx(0.1**2 * 40 / x**2, rel=1e-5)
    assert noise.without("mismatch").threshold_on_map == noise.spec.contrast_threshold_on
    assert (noise.leak_rate_hz, noise.without("leak").leak_rate_hz) == (2.0, 0.0)
    clean = noise.clean()
    assert clean.off == frozenset(EVS_TERMS)
    assert clean.is_noiseless and not noise.is_noiseless
    assert relative_variance(clean) == 0
    # without noise a change either crosses or does not
    x1 = x * np.exp(0.1)
    electrons_1 = (x1 - 3.0) / 0.8 / 2
    assert clean.event_probability(20.0, electrons_1 * 1.001) == (1.0, 0.0)
    assert clean.event_probability(20.0, electrons_1 * 0.999) == (0.0, 0.0)
    assert clean.event_probability(electrons_1 * 1.001, 20.0) == (0.0, 1.0)
    assert clean.event_probability(0.0, 0.0) == (0.0, 0.0)
    with pytest.raises(RangeError, match="shot, dark_current, mismatch, leak"):
        noise.without("read")


def test_last_event_has_no_probability():
    with pytest.raises(RangeError, match="last_event"):
        model("davis346").event_probability(1.0, 1.0)


@pytest.mark.parametrize("electrons", (-1.0, np.nan, np.zeros((2, 2))))
def test_wrong_electrons(electrons):
    noise = model("gen2", crop=(256, 256))
    with pytest.raises(RangeError, match="electrons_1"):
        noise.event_probability(1.0, electrons)


def test_the_quiet_reference_shows_what_moves_and_no_noise():
    """In still light the whole sensor has less than one noise event in ten minutes; a change of 25 % is seen."""
    quiet = model("reference-quiet", crop=(96, 64))
    for electrons in (0.0, 3.0, 200.0, 20_000.0):
        on, off = quiet.event_probability(electrons, electrons)
        assert (on + off) * 1024**2 * 1000 * 600 < 1.0
        assert quiet.event_probability(electrons + 1, 1.25 * electrons + 2)[0] > 0.9
    # the other reference is mostly noise in light that both see well
    assert model("reference-mono", crop=(96, 64)).event_probability(200.0, 200.0)[0] > 0.05
