"""The frame noise model against the formulas, written out again here."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps.fixed_pattern import FixedPattern
from hesim_render.pixels.aps.model import APS_TERMS, ApsNoise
from hesim_render.sensor.reading import read_sensor

SIDE = 512
EXPOSURE_US = 10_000


def model(name="reference-mono", crop=None, **overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    if name == "reference-mono":
        changes = {"geometry.rows": SIDE, "geometry.cols": SIDE, **changes}
    spec = read_sensor(name, changes)
    layout = Layout.full(spec)
    return ApsNoise(spec.aps, layout.crop(*crop) if crop else layout, spec.device_seed)


def dn_law(noise, electrons, exposure_us=EXPOSURE_US):
    """Exact probabilities of every DN of one pixel without maps: a sum over counts of rounded Gaussians."""
    spec = noise.spec
    gain, full_scale = spec.system_gain_dn_per_e, 2**spec.bit_depth - 1
    mean = electrons + spec.dark_current_e_per_s * exposure_us * 1e-6
    if spec.law == "poisson":
        low, high = stats.poisson.ppf([1e-13, 1 - 1e-13], mean).astype(int)
        count = np.arange(low, high + 2)
        weight = stats.poisson.pmf(count, mean)
    else:
        z = np.linspace(-8, 8, 801)
        count, weight = mean + np.sqrt(mean) * z, stats.norm.pdf(z)
    level = gain * np.minimum(count, spec.full_well_e) + spec.black_level_dn
    edges = np.arange(full_scale) + 0.5
    below = stats.norm.cdf((edges[:, None] - level) / (gain * spec.read_noise_e)) @ (weight / weight.sum())
    return np.diff(np.concatenate([[0.0], below, [1.0]]))


def moments(law):
    dn = np.arange(len(law))
    mean = law @ dn
    return mean, law @ (dn - mean) ** 2, law @ (dn - mean) ** 4


LEVELS = (1.0, 5.0, 25.0, 500.0, 5000.0)


@pytest.mark.parametrize(
    ("term", "gone"), (("read", (0,)), ("shot", (1, 3, 4)), ("dark_current", (2, 5)), ("prnu", ()), ("dsnu", ()))
)
def test_a_term_takes_its_part_of_the_polynomial_along(term, gone):
    beta = [4.0, 0.3, 20.0, 1e-5, 0.2, 50.0]
    kept = [0.0 if k in gone else b for k, b in enumerate(beta)]
    for given in (beta, None):
        changes = {"aps.beta": [[given]]} if given else {"aps.dark_current_e_per_s": 300.0}
        spec = read_sensor("reference-mono", {"geometry.rows": 8, "geometry.cols": 8, **changes})
        noise = ApsNoise(spec.aps, Layout.full(spec), 1).without(term)
        if given:
            assert noise.to_polynomial() == [[kept]]
            dark, light = (float(noise.variance_dn2(e, 20_000)) for e in (0.0, 1000.0))
            signal, t = spec.aps.system_gain_dn_per_e * 1000.0, 0.02
            assert dark == pytest.approx(kept[0] + kept[2] * t + kept[5] * t**2, rel=1e-12)
            gain = kept[1] + kept[3] * signal + kept[4] * t
            assert light - dark == pytest.approx(gain * signal, rel=1e-12)
        else:
            physical = [(0.2 * spec.aps.read_noise_e) ** 2, 0.2, 0.04 * 300.0, 0.0, 0.0, 0.0]
            expected = [0.0 if k in gone else b for k, b in enumerate(physical)]
            assert noise.to_polynomial()[0][0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("law", ("poisson", "gaussian"))
@pytest.mark.parametrize("gain", (0.2, 0.9))
@pytest.mark.parametrize("electrons", (*LEVELS, 19_990.0, 40_000.0))
def test_mean_variance_and_law_of_samples(electrons, gain, law):
    """At 1 to 5000 e⁻, at the edge of full well (19990) and beyond full scale.

    84 comparisons (3 × 28) at 1e-8 each: a false alarm in a million runs.
    """
    noise = model(aps__law=law, aps__system_gain_dn_per_e=gain, aps__full_well_e=20_000.0)
    dn = noise.sample(electrons, EXPOSURE_US, seed=11).astype(float).ravel()
    exact = dn_law(noise, electrons)
    mean, variance, fourth = moments(exact)
    bound = stats.norm.isf(0.5e-8)
    assert abs(dn.mean() - mean) < bound * np.sqrt(variance / dn.size) + 1e-9
    # the variance of samples is near Gaussian only where it is made of many of them
    if variance * dn.size > 100:
        assert abs(dn.var() - variance) < bound * np.sqrt((fourth - variance**2) / dn.size)
    observed = np.bincount(dn.astype(int), minlength=len(exact))
    common = exact * dn.size > 20
    expected = np.append(exact[common], exact[~common].sum()) * dn.size
    found = np.append(observed[common], observed[~common].sum())
    kept = expected > 5
    statistic = np.sum((found - expected)[kept] ** 2 / expected[kept])
    if kept.sum() > 1:
        assert stats.chi2.sf(statistic, kept.sum() - 1) > 1e-8
    assert found[~kept].sum() <= 30


@pytest.mark.parametrize("law", ("poisson", "gaussian"))
@pytest.mark.parametrize("electrons", LEVELS)
def test_formulas_of_mean_and_variance(electrons, law):
    """K(I_e + D t) + black, and K²(I_e + D t + σ_r²) before the ADC; rounding then adds 1/12."""
    noise = model(
        aps__law=law, aps__system_gain_dn_per_e=0.5, aps__dark_current_e_per_s=300.0, aps__full_well_e=1e6,
        aps__read_noise_e=3.0,
    )  # fmt: skip
    mean = 0.5 * (electrons + 3.0) + 64
    variance = 0.25 * (electrons + 3.0 + 9.0)
    assert noise.mean_dn(electrons, EXPOSURE_US) == pytest.approx(mean, rel=1e-12)
    assert noise.variance_dn2(electrons, EXPOSURE_US) == pytest.approx(variance, rel=1e-12)
    assert noise.variance_dn2(electrons, EXPOSURE_US, adc=True) == pytest.approx(variance + 1 / 12, rel=1e-12)
    # the exact law agrees: Sheppard's correction holds from 0.24 DN² on
    exact_mean, exact_variance, _ = moments(dn_law(noise, electrons))
    assert exact_mean == pytest.approx(mean, abs=2e-4)
    assert exact_variance == pytest.approx(variance + 1 / 12, abs=2e-4)


def test_mean_and_variance_of_images_use_each_pixels_maps():
    noise = model(aps__prnu_rel=0.02, aps__dsnu_e=4.0, aps__row_offset_std_dn=1.7, aps__dark_current_e_per_s=530.0,
                  aps__dark_current_nonuniformity_rel=0.4)  # fmt: skip
    maps = noise.fixed_pattern
    electrons = np.linspace(0, 900, SIDE * SIDE).reshape(SIDE, SIDE)
    total = maps.response * electrons + maps.dark_e_per_s * 0.01
    np.testing.assert_allclose(noise.mean_dn(electrons, EXPOSURE_US), 0.2 * total + maps.offset_dn, rtol=1e-6)
    np.testing.assert_allclose(noise.variance_dn2(electrons, EXPOSURE_US), 0.04 * (total + 4.0), rtol=1e-6)
    # and so do samples: 80 frames, every pixel's mean; 262144 z-values at 7 (2.6e-12): 7e-7 in all
    stack = np.stack([noise.sample(electrons, EXPOSURE_US, seed=2, frame=k) for k in range(80)]).astype(float)
    z = (stack.mean(axis=0) - noise.mean_dn(electrons, EXPOSURE_US)) / np.sqrt(
        noise.variance_dn2(electrons, EXPOSURE_US, adc=True) / 80
    )
    lit = electrons > 25  # below, rounding biases the mean: K²·(25 + …) is above 0.24 DN² only from there on
    assert np.abs(z[lit]).max() < 7
    assert abs(z[lit].std() - 1) < 0.01


def numpy_sample(noise, electrons, exposure_us, rng):
    """The physical form once more, in NumPy."""
    spec, maps = noise.spec, noise.fixed_pattern
    mean = np.broadcast_to(maps.response * electrons + maps.dark_e_per_s * exposure_us * 1e-6, noise.layout.shape)
    if spec.law == "poisson":
        count = rng.poisson(mean).astype(float)
    else:
        count = rng.normal(mean, np.sqrt(mean))
    charge = np.minimum(count, spec.full_well_e) + rng.normal(0, spec.read_noise_e, mean.shape)
    signal = spec.system_gain_dn_per_e * charge + maps.offset_dn + rng.normal(0, spec.residual_noise_dn, mean.shape)
    return np.clip(np.rint(signal), 0, 2**spec.bit_depth - 1).astype(int)


@pytest.mark.parametrize("law", ("poisson", "gaussian"))
def test_numpy_version_agrees_in_distribution(law):
    """Two-sample χ² over all DN of a wedge from dark to beyond full well, all terms on; false alarm 1e-6 each."""
    noise = model("eiger", crop=(512, 512), aps__law=law, aps__residual_noise_dn=0.7)
    electrons = np.broadcast_to(np.geomspace(0.3, 9000, 512), (512, 512))
    rng = np.random.default_rng(4)
    ours = np.concatenate([noise.sample(electrons, EXPOSURE_US, 5, k).ravel() for k in range(4)]).astype(int)
    theirs = np.concatenate([numpy_sample(noise, electrons, EXPOSURE_US, rng).ravel() for _ in range(4)])
    a, b = (np.bincount(v, minlength=1024) for v in (ours, theirs))
    kept = a + b > 20
    statistic = np.sum((a - b)[kept] ** 2 / (a + b)[kept])
    assert stats.chi2.sf(statistic, kept.sum()) > 1e-6
    assert (a + b)[~kept].sum() < 2000


BETA = [
    [[0.5, 0.3, 2.0, 1e-4, 0.5, 10.0], [0.9, 0.2, 0.0, 0.0, 0.0, 0.0]],
    [[0.4, 0.5, 1.0, -1e-4, 0.0, 0.0], [1.2, 0.0, 5.0, 0.0, 0.0, 0.0]],
]  # fmt: skip


@pytest.mark.parametrize("law", ("poisson", "gaussian"))
def test_polynomial_form(law):
    """Mean and variance at each tile position; 16 comparisons at z = 5.5 (4e-8): a false alarm in a million runs."""
    t = EXPOSURE_US * 1e-6
    noise = model("reference-bayer", crop=(512, 512), aps__beta=BETA, aps__law=law, aps__dark_current_e_per_s=200.0)
    electrons = 800.0
    signal = 0.25 * electrons
    dn = noise.sample(electrons, EXPOSURE_US, seed=3).astype(float)
    for i in range(2):
        for j in range(2):
            b = BETA[i][j]
            variance = b[0] + b[1] * signal + b[2] * t + b[3] * signal**2 + b[4] * signal * t + b[5] * t * t
            mean = signal + 0.25 * 200.0 * t + 64
            assert noise.mean_dn(electrons, EXPOSURE_US, position=(i, j)) == pytest.approx(mean, rel=1e-12)
            assert noise.variance_dn2(electrons, EXPOSURE_US, position=(i, j)) == pytest.approx(variance, rel=1e-12)
            part = dn[i::2, j::2]
            assert abs(part.mean() - mean) < 5.5 * np.sqrt((variance + 1 / 12) / part.size)
            assert abs(part.var() / (variance + 1 / 12) - 1) < 5.5 * np.sqrt(2.1 / part.size)
    np.testing.assert_allclose(
        noise.variance_dn2(np.full((512, 512), electrons), EXPOSURE_US)[1, 1],
        noise.variance_dn2(electrons, EXPOSURE_US, position=(1, 1)),
    )


def test_polynomial_of_the_physical_form_is_exact():
    physical = model(aps__dark_current_e_per_s=300.0, aps__system_gain_dn_per_e=0.7, aps__full_well_e=5000.0)
    beta = physical.to_polynomial()
    np.testing.assert_allclose(beta[0][0], [0.49 * 4.0, 0.7, 0.49 * 300.0, 0, 0, 0], rtol=1e-12)
    polynomial = model(
        aps__dark_current_e_per_s=300.0, aps__system_gain_dn_per_e=0.7, aps__full_well_e=5000.0, aps__beta=beta
    )
    for electrons in (0.0, 3.0, 700.0):
        for exposure_us in (0, 100, 30_000):
            assert polynomial.mean_dn(electrons, exposure_us) == pytest.approx(physical.mean_dn(electrons, exposure_us))
            assert polynomial.variance_dn2(electrons, exposure_us) == pytest.approx(
                physical.variance_dn2(electrons, exposure_us)
            )
    assert polynomial.to_polynomial() == beta
    # the two samplers agree: 4 comparisons at z = 5.5
    a, b = (noise.sample(700.0, EXPOSURE_US, seed=s).astype(float) for s, noise in enumerate((physical, polynomial)))
    assert abs(a.mean() - b.mean()) < 5.5 * np.sqrt(2 * a.var() / a.size)
    assert abs(a.var() / b.var() - 1) < 5.5 * np.sqrt(4.0 / a.size)


@pytest.mark.parametrize(
    ("cell", "named"),
    (
        ([0.5, 0.1, 0, -1e-3, 0, 0], "β1"),  # negative at full scale
        ([0.5, -0.1, 0, 0, 0, 0], "β1"),
        ([0.5, 0.1, -100.0, 0, 0, 0], "β0"),  # negative at the exposure of the file
    ),
)
def test_negative_variance_is_refused_with_its_position(cell, named):
    good = [0.5, 0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(SpecError, match=rf"position \(1, 0\): {named}"):
        model("reference-bayer", aps__beta=[[good, good], [cell, good]])


def test_negative_variance_at_a_longer_exposure_is_refused():
    cell = [0.5, 0.1, -10.0, 0.0, 0.0, 0.0]
    noise = model(aps__beta=[[cell]])
    with pytest.raises(RangeError, match="exposure_us"):
        noise.sample(10.0, 100_000, seed=1)


def test_fixed_maps():
    """Spread of each map; 262144 pixels: relative standard error of a std is 0.14 % (z = 5.5: 0.8 %)."""
    noise = model(aps__prnu_rel=0.02, aps__dsnu_e=5.0, aps__row_offset_std_dn=2.0, aps__dark_current_e_per_s=40.0,
                  aps__dark_current_nonuniformity_rel=0.5)  # fmt: skip
    maps = noise.fixed_pattern
    assert abs(maps.response.mean() - 1) < 5.5 * 0.02 / SIDE
    assert maps.response.std() == pytest.approx(0.02, rel=0.008)
    rows = maps.offset_dn.mean(axis=1)
    assert (maps.offset_dn - rows[:, None]).std() == pytest.approx(0.2 * 5.0, rel=0.01)
    assert rows.std() == pytest.approx(2.0, rel=5.5 / np.sqrt(2 * SIDE))
    assert abs(rows.mean() - 64) < 5.5 * 2.0 / np.sqrt(SIDE)
    dark = maps.dark_e_per_s
    assert dark.min() >= 0
    assert abs(dark.mean() / 40 - 1) < 5.5 * 0.5 / SIDE
    # gamma law of shape 1/0.5² = 4
    assert stats.kstest(dark.ravel()[::7], stats.gamma(4, scale=10.0).cdf).pvalue > 1e-6
    assert np.corrcoef(maps.response.ravel(), dark.ravel())[0, 1] == pytest.approx(0, abs=5.5 / SIDE)
    again = ApsNoise(noise.spec, noise.layout, noise.device_seed).fixed_pattern
    np.testing.assert_array_equal(again.response, maps.response)
    other = ApsNoise(noise.spec, noise.layout, noise.device_seed + 1).fixed_pattern
    assert np.corrcoef(other.response.ravel(), maps.response.ravel())[0, 1] == pytest.approx(0, abs=5.5 / SIDE)


@pytest.mark.parametrize("temperature_c", (-20.0, 25.0, 41.5, 60.0))
def test_dark_current_follows_temperature(temperature_c):
    """D·2^((T − T_ref)/doubling) in the formulas, the map and the samples; 4 × 2 comparisons at z = 5.5."""
    at_reference = {"aps__dark_current_e_per_s": 800.0, "aps__dark_current_nonuniformity_rel": 0.4}
    noise = model(
        **at_reference, aps__temperature_c=temperature_c, aps__dark_current_reference_c=25.0,
        aps__dark_current_doubling_c=7.0, aps__system_gain_dn_per_e=0.5, aps__bit_depth=14,
    )  # fmt: skip
    dark = 800.0 * np.exp2((temperature_c - 25.0) / 7.0) * EXPOSURE_US * 1e-6
    assert noise.mean_dn(30.0, EXPOSURE_US) == pytest.approx(64 + 0.5 * (30.0 + dark), rel=1e-12)
    assert noise.variance_dn2(30.0, EXPOSURE_US) == pytest.approx(0.25 * (30.0 + dark + 4.0), rel=1e-12)
    assert noise.to_polynomial()[0][0][2] == pytest.approx(0.25 * dark / (EXPOSURE_US * 1e-6), rel=1e-12)
    # the same device: its map is scaled
    np.testing.assert_allclose(
        noise.fixed_pattern.dark_e_per_s,
        model(**at_reference).fixed_pattern.dark_e_per_s * np.exp2((temperature_c - 25.0) / 7.0),
        rtol=1e-6,
    )
    dn = noise.sample(30.0, EXPOSURE_US, seed=9).astype(float)
    own = 30.0 + noise.fixed_pattern.dark_e_per_s.astype(float) * EXPOSURE_US * 1e-6
    residual = dn - (64 + 0.5 * own)
    variance = 0.25 * (30.0 + dark + 4.0) + 1 / 12
    assert abs(residual.mean()) < 5.5 * np.sqrt(variance / dn.size)
    spread = stats.kurtosis(residual, axis=None) + 2
    assert abs(residual.var() / variance - 1) < 5.5 * np.sqrt((spread + (0.4 * 0.25 * dark / variance) ** 2) / dn.size)


def test_temperature_alone_changes_nothing():
    for changes in (
        {"aps__temperature_c": 60.0},
        {"aps__dark_current_reference_c": 25.0, "aps__dark_current_doubling_c": 7.0},
        {"aps__temperature_c": 25.0, "aps__dark_current_reference_c": 25.0},
    ):
        assert model(aps__dark_current_e_per_s=800.0, **changes).mean_dn(0.0, 10_000) == pytest.approx(64 + 0.2 * 8)
    warm = {"aps__temperature_c": 60.0, "aps__dark_current_reference_c": 25.0}
    with pytest.raises(SpecError, match="dark_current_doubling_c is needed"):
        model(**warm)
    with pytest.raises(SpecError, match="beta holds at the temperature"):
        model(**warm, aps__dark_current_doubling_c=7.0, aps__beta=[[[0.5, 0.1, 0.0, 0.0, 0.0, 0.0]]])


def test_bits_follow_from_the_seed_alone():
    full = model("eiger")
    crop = ApsNoise(full.spec, full.layout.crop(512, 384), full.device_seed)
    row, col = crop.layout.row0, crop.layout.col0
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 800, full.layout.shape).astype(np.float32)
    band = ApsNoise(full.spec, full.layout.crop(full.layout.cols, 24, 0, 100), full.device_seed)  # needs no table
    lines = full.sample(image, EXPOSURE_US, seed=7, frame=3)[100:124]
    np.testing.assert_array_equal(band.sample(image[100:124], EXPOSURE_US, seed=7, frame=3), lines)
    part = image[row : row + 384, col : col + 512]
    whole = full.sample(image, EXPOSURE_US, seed=7, frame=3)
    ours = crop.sample(part, EXPOSURE_US, seed=7, frame=3)
    np.testing.assert_array_equal(ours, whole[row : row + 384, col : col + 512])
    np.testing.assert_array_equal(ours, crop.sample(part, EXPOSURE_US, seed=7, frame=3))
    # pieces of any size
    types = jit()
    flat = part.ravel()
    for size in (1, 4097, 100_000):
        first = 0 if size > 1 else 777
        pieces = [
            np.array(crop.sample_dn(from_host(types.Float, flat[k : k + size]), EXPOSURE_US, 7, 3, first_pixel=k))
            for k in range(first, len(flat) if size > 1 else first + 1, size)
        ]
        joined = np.concatenate(pieces)
        np.testing.assert_array_equal(joined, ours.ravel()[first : first + len(joined)])
    assert np.mean(crop.sample(part, EXPOSURE_US, seed=7, frame=4) != ours) > 0.5
    assert np.mean(crop.sample(part, EXPOSURE_US, seed=8, frame=3) != ours) > 0.5


def test_sampling_accepts_numbers_images_and_device_arrays():
    noise = model()
    types = jit()
    image = np.full((SIDE, SIDE), 70.0)
    expected = noise.sample(70.0, EXPOSURE_US, seed=1)
    assert expected.dtype == np.uint16 and expected.shape == (SIDE, SIDE)
    np.testing.assert_array_equal(noise.sample(image, EXPOSURE_US, seed=1), expected)
    np.testing.assert_array_equal(noise.sample(dr.full(types.Float, 70.0, SIDE * SIDE), EXPOSURE_US, seed=1), expected)


NOISY = {
    "aps__prnu_rel": 0.05, "aps__dsnu_e": 20.0, "aps__row_offset_std_dn": 5.0, "aps__dark_current_e_per_s": 4000.0,
    "aps__dark_current_nonuniformity_rel": 0.3, "aps__residual_noise_dn": 3.0, "aps__read_noise_e": 20.0,
    "aps__system_gain_dn_per_e": 1.0, "aps__row_noise_dn": 4.0, "aps__column_offset_std_dn": 4.5,
    "aps__column_noise_dn": 2.6, "aps__read_noise_correlation": -0.23,
    "aps__interference": [{"cycles_per_row": 0.25, "cycles_per_col": 0.4, "rms_dn": 3.7}],
    "aps__telegraph": {"share": 0.25, "amplitude_e": 8.0, "amplitude_law": "equal", "high_s": 1e-3, "low_s": 1e-3},
}  # fmt: skip


@pytest.mark.parametrize("law", ("poisson", "gaussian"))
@pytest.mark.parametrize("form", ("physical", "polynomial"))
def test_clean_is_exact(law, form):
    beta = {"aps__beta": [[[400.0, 1.0, 4000.0, 1e-4, 0.1, 1.0]]]} if form == "polynomial" else {}
    noise = model(aps__law=law, **NOISY, **beta).clean()
    electrons = np.linspace(0, 30_000, SIDE * SIDE).reshape(SIDE, SIDE).astype(np.float32)
    expected = np.clip(np.rint(np.minimum(electrons, np.float32(20_000)) + np.float32(64)), 0, 4095)
    np.testing.assert_array_equal(noise.sample(electrons, EXPOSURE_US, seed=1), expected)
    assert noise.variance_dn2(100.0, EXPOSURE_US) == 0
    assert noise.mean_dn(100.0, EXPOSURE_US) == 164


@pytest.mark.parametrize(
    "term",
    [
        pytest.param(term, marks=() if term == "read" else pytest.mark.slow)
        for term in APS_TERMS
        if term != "crosstalk"  # that one acts on the flux
    ],
)
def test_each_term_can_be_switched_off(term):
    """Temporal and spatial variance of 60 frames fall by the term's own; relative standard error about 0.05."""
    noise = model(crop=(128, 128), **NOISY)
    maps = noise.fixed_pattern
    electrons, t = 1000.0, EXPOSURE_US * 1e-6
    temporal = {"shot": maps.response.mean() * electrons, "dark_current": maps.dark_e_per_s.mean() * t,
                "read": 400.0, "row_noise": 16.0, "residual": 9.0, "column_noise": 2.6**2, "interference": 3.7**2,
                "telegraph": noise.telegraph.place.size / 128**2 * 16.0}  # fmt: skip
    without_pixels = noise.without("dsnu").fixed_pattern.offset_dn
    spatial = {"prnu": (electrons * maps.response).var(), "row": without_pixels.mean(axis=1).var(),
               "column": without_pixels.mean(axis=0).var(), "dsnu": (maps.offset_dn - without_pixels).var(),
               "dark_current": (maps.dark_e_per_s * t).var()}  # fmt: skip
    assert set(temporal) | set(spatial) == set(APS_TERMS) - {"crosstalk"}
    less = noise.without(term)
    stack = np.stack([less.sample(electrons, EXPOSURE_US, seed=5, frame=k) for k in range(60)]).astype(float)
    left = sum(v for k, v in temporal.items() if k != term)
    # 60·16384 samples: 0.15 % standard error of a variance; z = 5.5; of row noise 60·128 ones, 1.6 % of 16 DN²
    rows = 5.5 * (16 + 2.6**2) * 0.016
    assert stack.var(axis=0, ddof=1).mean() == pytest.approx(left + 1 / 12, abs=5.5 * 0.0015 * float(left) + rows)
    assert less.variance_dn2(np.full((128, 128), electrons), EXPOSURE_US).mean() == pytest.approx(left, rel=1e-5)
    fixed = stack.mean(axis=0).var() - left / 60
    # rows are 128 draws that columns share; their empirical variance is used, so only pixel noise is left
    assert fixed == pytest.approx(sum(v for k, v in spatial.items() if k != term), rel=0.1)


def test_terms_are_known_by_name():
    noise = model(crop=(128, 128), **NOISY)
    with pytest.raises(RangeError, match="shot, dark_current, read, prnu, dsnu, row, row_noise, residual"):
        noise.without("photon")
    np.testing.assert_allclose(noise.without("read").to_polynomial()[0][0][:3], [0, 1.0, 4000.0])
    np.testing.assert_allclose(noise.without("shot", "dark_current").to_polynomial()[0][0][:3], [400.0, 0, 0])


def test_temporal_row_noise_is_shared_by_a_row_and_by_nothing_else():
    """4 DN over 300 frames of 64 rows: bounds of 5 standard errors, five comparisons, a false alarm in 3e-6."""
    noise = model("eiger", crop=(128, 64), aps__row_noise_dn=4.0)
    frames, electrons = 300, 500.0
    stack = np.stack([noise.sample(electrons, EXPOSURE_US, seed=9, frame=k) for k in range(frames)]).astype(float)
    left, right = stack[:, :, :64].mean(axis=2), stack[:, :, 64:].mean(axis=2)
    left, right = left - left.mean(axis=0), right - right.mean(axis=0)
    n = frames * 64
    # halves of a row share nothing else: their covariance is N_tr's variance
    assert abs((left * right).sum() / (n - 64) - 16) < 5 * 17 * np.sqrt(2 / n)
    for other in (np.roll(right, 1, axis=1), np.roll(right, 1, axis=0), np.roll(right, 2, axis=1)):
        assert abs(np.mean(left * other)) < 5 * 17 / np.sqrt(n)
    pixel = noise.without("row_noise")
    assert noise.variance_dn2(electrons, EXPOSURE_US) - pixel.variance_dn2(electrons, EXPOSURE_US) == pytest.approx(16)
    assert noise.noise_equivalent_e(np.array([0.0]), 1000.0) > pixel.noise_equivalent_e(np.array([0.0]), 1000.0)
    assert noise.to_polynomial() == pixel.to_polynomial()
    # a crop and a piece have the rows' own numbers
    crop = ApsNoise(noise.spec, noise.layout.crop(16, 8), noise.device_seed)
    row, col = crop.layout.row0 - noise.layout.row0, crop.layout.col0 - noise.layout.col0
    cut = np.s_[row : row + crop.layout.rows, col : col + crop.layout.cols]
    np.testing.assert_array_equal(crop.sample(electrons, EXPOSURE_US, 9, 3), stack[3][cut])
    types, first = jit(), 7 * 64 + 3
    piece = noise.sample_dn(dr.full(types.Float, electrons, 500), EXPOSURE_US, 9, 3, first_pixel=first)
    np.testing.assert_array_equal(piece.numpy(), stack[3].ravel()[first : first + 500])


def test_position_of_numbers():
    noise = model("eiger", crop=(16, 16))
    assert noise.mean_dn(0.0, 0) == 64
    with pytest.raises(RangeError, match="position"):
        noise.mean_dn(0.0, 0, position=(1, 1))  # an event pixel
    with pytest.raises(RangeError, match="position"):
        noise.mean_dn(0.0, 0, position=(4, 0))
    with pytest.raises(RangeError, match="position"):
        noise.mean_dn(np.zeros((16, 16)), 0, position=(0, 0))


@pytest.mark.parametrize("electrons", (-1.0, np.nan, np.inf, np.zeros((3, 3))))
def test_wrong_electrons(electrons):
    noise = model()
    for call in (noise.mean_dn, noise.variance_dn2):
        with pytest.raises(RangeError, match="electrons"):
            call(electrons, EXPOSURE_US)
    with pytest.raises(RangeError, match="electrons"):
        noise.sample(electrons, EXPOSURE_US, seed=1)


@pytest.mark.parametrize("exposure_us", (-1, np.nan))
def test_wrong_exposure(exposure_us):
    with pytest.raises(RangeError, match="exposure_us"):
        model().sample(1.0, exposure_us, seed=1)


@pytest.mark.parametrize("law", ["poisson", "gaussian"])
def test_columns_neighbours_and_interference_share_what_they_say(law):
    """500 frames of 64×96 px without light: bounds of 5 standard errors, 14 comparisons, a false alarm in 8e-6."""
    line = {"cycles_per_row": 0.25, "cycles_per_col": -0.375, "rms_dn": 1.7}
    noise = model(
        "eiger", crop=(96, 64), aps__law=law, aps__column_noise_dn=1.3, aps__read_noise_correlation=-0.31,
        aps__interference=[line],
        aps__dark_current_e_per_s=0.0, aps__read_noise_e=3.1, aps__system_gain_dn_per_e=2.3, aps__beta=None,
        aps__row_noise_dn=0.0, aps__telegraph=None, aps__residual_noise_dn=0.0,
    )  # fmt: skip
    frames = 500
    stack = np.stack([noise.sample(0.0, EXPOSURE_US, seed=4, frame=k) for k in range(frames)]).astype(float)
    change = (stack - stack.mean(axis=0)) * np.sqrt(frames / (frames - 1))
    read = (2.3 * 3.1) ** 2
    # a wave's amplitude over the picture: its mean square is that of a line, 1/√500 of itself
    rows, cols = np.mgrid[:64, :96] + np.array([noise.layout.row0, noise.layout.col0])[:, None, None]
    wave = np.exp(2j * np.pi * (0.25 * rows - 0.375 * cols))
    power = np.mean(np.abs((change * wave).mean(axis=(1, 2))) ** 2) * 2
    assert power == pytest.approx(1.7**2, rel=0.05)  # of a constant amplitude only noise scatters
    phases = np.angle((change * wave).mean(axis=(1, 2)))
    assert abs(np.exp(1j * phases).mean()) < 5 / np.sqrt(frames)
    left = change[:, :32].mean(axis=1), change[:, 32:].mean(axis=1)
    n = frames * 96
    # a quarter of a period a row: whole periods in 32 rows, so that the wave is not in their means
    assert abs(np.mean(left[0] * left[1]) - 1.3**2) < 5 * (1.3**2 + read / 32) * np.sqrt(2 / n)
    rest = change - change.mean(axis=1, keepdims=True)
    lag = np.mean(rest[:, :, 1:] * rest[:, :, :-1]) * 64 / 63 - 1.7**2 * np.cos(2 * np.pi * 0.375)
    assert abs(lag - (-0.31 * read)) < 5 * read / np.sqrt(rest.size)
    two = np.mean(rest[:, :, 2:] * rest[:, :, :-2]) * 64 / 63 - 1.7**2 * np.cos(4 * np.pi * 0.375)
    assert abs(two) < 5 * read * 1.1 / np.sqrt(rest.size)
    total = read + 1.3**2 + 1.7**2
    assert noise.variance_dn2(0.0, EXPOSURE_US) == pytest.approx(total)
    assert change.var() == pytest.approx(total + 1 / 12, rel=0.01)
    # a crop has the numbers of the whole
    crop = ApsNoise(noise.spec, noise.layout.crop(24, 16), noise.device_seed)
    row, col = crop.layout.row0 - noise.layout.row0, crop.layout.col0 - noise.layout.col0
    part = crop.sample(0.0, EXPOSURE_US, seed=4, frame=3)
    np.testing.assert_array_equal(part, stack[3][row : row + crop.layout.rows, col : col + crop.layout.cols])


def test_interferences_have_phases_of_their_own():
    """Two lines with whole periods in 32×64 px, 300 frames without other noise: 5 standard errors of a mean phasor."""
    lines = [
        {"cycles_per_row": 0.25, "cycles_per_col": -0.375, "rms_dn": 7.0},
        {"cycles_per_row": 0.125, "cycles_per_col": 0.4375, "rms_dn": 11.0},
    ]
    noise = model("eiger", crop=(64, 32), aps__interference=lines, aps__beta=None).without("read", "shot", "row")
    frames = 300
    stack = np.stack([noise.sample(0.0, EXPOSURE_US, seed=4, frame=k) for k in range(frames)]).astype(float)
    rows, cols = np.mgrid[:32, :64] + np.array([noise.layout.row0, noise.layout.col0])[:, None, None]
    turns = [line["cycles_per_row"] * rows + line["cycles_per_col"] * cols for line in lines]
    phasors = [((stack - stack.mean(axis=0)) * np.exp(2j * np.pi * turn)).mean(axis=(1, 2)) for turn in turns]
    for line, phasor in zip(lines, phasors, strict=True):
        assert np.sqrt(2 * np.mean(np.abs(phasor) ** 2)) == pytest.approx(line["rms_dn"], rel=0.03)
    one, two = (phasor / np.abs(phasor) for phasor in phasors)
    for together in (one * two, one * np.conj(two), one, two):
        assert abs(together.mean()) < 5 / np.sqrt(frames)


def test_columns_have_offsets_of_their_own():
    """512 columns: 3 % standard error of their spread; the same in every row, and in a crop."""
    noise = model(aps__column_offset_std_dn=2.7, aps__dsnu_e=0.0, aps__row_offset_std_dn=0.0)
    offset = noise.fixed_pattern.offset_dn
    assert np.all(offset == offset[:1]) and offset.std() == pytest.approx(2.7, rel=0.15)
    assert np.abs(np.corrcoef(offset[0, 1:], offset[0, :-1])[0, 1]) < 5 / np.sqrt(SIDE)
    crop = ApsNoise(noise.spec, noise.layout.crop(16, 8), noise.device_seed)
    col = crop.layout.col0 - noise.layout.col0
    np.testing.assert_array_equal(crop.fixed_pattern.offset_dn[0], offset[0, col : col + 16])
    assert np.ptp(noise.without("column").fixed_pattern.offset_dn) == 0


def test_each_map_is_the_deviates_of_its_own_stream_on_the_full_sensor():
    """Keys and signs too: a device of a seed stays that device. Rows and columns are those of the sensor."""
    noise = model("eiger", crop=(24, 16), aps__row_offset_std_dn=1.7, aps__column_offset_std_dn=0.6, aps__dsnu_e=3.0,
                  aps__prnu_rel=0.02)  # fmt: skip
    spec, region = noise.spec, noise.layout
    assert region.row0 > 0 and region.col0 > 0 and region.row0 != region.col0

    def deviates(stream, index):
        return device_normal(noise.device_seed, stream, np.asarray(index, np.uint32)).astype(float)

    row, col = np.arange(16)[:, None] + region.row0, np.arange(24)[None] + region.col0
    pixel = row * region.spec.geometry.cols + col
    offset = (
        spec.black_level_dn
        + 1.7 * deviates(Stream.ROW_OFFSET, row)
        + 0.6 * deviates(Stream.COLUMN_OFFSET, col)
        + spec.system_gain_dn_per_e * 3.0 * deviates(Stream.DSNU, pixel)
    )
    np.testing.assert_allclose(noise.fixed_pattern.offset_dn, offset, rtol=1e-6)
    np.testing.assert_allclose(noise.fixed_pattern.response, 1 + 0.02 * deviates(Stream.PRNU, pixel), rtol=1e-6)


@pytest.mark.parametrize("form", ("physical", "polynomial"))
def test_a_bent_signal_has_its_mean_and_variance(form):
    """Closed form: mean f(E), variance f'(E)² K E where the form is physical, the polynomial in f(E) otherwise."""
    gain, curve = 0.37, [0.02, -0.08, 0.03]
    keys = {"aps__system_gain_dn_per_e": gain, "aps__nonlinearity": curve, "aps__dark_current_e_per_s": 0.0}
    if form == "polynomial":
        keys["aps__beta"] = [[[3.3, 0.31, 0.0, -2e-6, 0.0, 0.0]]]
    noise = model(aps__read_noise_e=4.2, **keys)
    for electrons in (150.0, 4000.0, 9000.0):
        e, u = gain * electrons, gain * electrons / 4095
        signal = e * (1 + curve[0] + curve[1] * u + curve[2] * u * u)
        slope = 1 + curve[0] + 2 * curve[1] * u + 3 * curve[2] * u * u
        expected = slope**2 * gain * e + (gain * 4.2) ** 2
        if form == "polynomial":
            expected = 3.3 + 0.31 * signal - 2e-6 * signal**2
        assert noise.mean_dn(electrons, EXPOSURE_US) - noise.spec.black_level_dn == pytest.approx(signal, rel=1e-6)
        assert noise.variance_dn2(electrons, EXPOSURE_US) == pytest.approx(expected, rel=1e-6)
        stack = np.stack([noise.sample(electrons, EXPOSURE_US, seed=6, frame=k) for k in range(4)]).astype(float)
        offset = noise.fixed_pattern.offset_dn
        values = stack - offset
        error = np.sqrt(expected / stack.size)
        assert abs(values.mean() - signal) < 5 * error
        assert np.mean((values - signal) ** 2) == pytest.approx(expected + 1 / 12, rel=5 * np.sqrt(2.2 / stack.size))


@pytest.mark.parametrize("curve", ([0.0, -0.6], [-0.96], [0.0, -2.0, 1.4], []))
def test_a_signal_that_does_not_rise_is_refused(curve):
    """At full scale, everywhere, between the ends, and no curve at all."""
    with pytest.raises(SpecError, match=r"slope of at least 0.05|at least 1 item"):
        model(aps__nonlinearity=curve)
    assert model(aps__nonlinearity=[0.0, -1.8, 1.4]).mean_dn(1.0, EXPOSURE_US) > 0


@pytest.mark.parametrize("beta", [None, (1.0,)])
def test_a_measured_dark_current_grows_with_the_temperature(beta):
    """DN/s over DN/e⁻ times the growth; a count has no mean below 0, the variance of a polynomial may."""
    measured = {"n_dp": np.array([[3.0, -0.4]], np.float32)}
    spec = SimpleNamespace(system_gain_dn_per_e=0.25, dark_current_growth=1.7, beta=beta)
    pattern = SimpleNamespace(spec=spec, off=(), _measured=measured)
    expected = np.array([[20.4, -2.72 if beta else 0.0]])
    np.testing.assert_allclose(FixedPattern.dark_e_per_s.func(pattern), expected, rtol=1e-6)
    pattern.off = ("dark_current",)
    assert FixedPattern.dark_e_per_s.func(pattern) == 0
