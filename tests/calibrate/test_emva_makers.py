"""EMVA 1288 sets in the forms of other makers: the same frames give the same figures, and the truth's."""

import dataclasses
import json
import subprocess
import sys

import emva_camera
import emva_makers
import numpy as np
import pytest
from emva_makers import MAKERS, NARROW, Maker

from hesim_render.calibrate.aps.calibration import calibrate_aps
from hesim_render.calibrate.aps.pair_levels import both_levels
from hesim_render.calibrate.aps.pairs import evaluate
from hesim_render.calibrate.aps.pairs_output import content
from hesim_render.calibration.file import read_calibration
from hesim_render.core.errors import SpecError
from hesim_render.recording.pair_set import is_pair_set, read_pair_set
from hesim_render.report.emva import frame_figures

CAMERA = emva_camera.Camera(rows=42, cols=58, long_frames=10)
NARROW_CAMERA = CAMERA.but(
    bits=8, gain=0.094, black=11.3, read_noise=11.2, row_noise=0.21, dark_current=3100.0,
    exposures_us=tuple(float(t) for t in np.linspace(300, 5400, 18).round()), long_us=2717.0,
)  # fmt: skip


def series_of(camera, seed):
    """Pairs at many exposures, and a long series, as makers list them."""
    frames = camera.bench(seed)
    listed = []
    for us in camera.exposures_us:
        listed += [(lit, us, camera.photons(us), frames(lit, us, 2)) for lit in (True, False)]
    return listed + [
        (lit, camera.long_us, camera.photons(camera.long_us), frames(lit, camera.long_us, camera.long_frames))
        for lit in (True, False)
    ]


def figures(folder):
    return content(evaluate(read_pair_set(folder)))


def holds(figure, true, errors=4.5):
    """Whether the truth is within so many standard errors."""
    return abs(figure["value"] - true) < errors * figure["standard_error"]


@pytest.fixture(scope="module")
def taken():
    return {"wide": series_of(CAMERA, 21), "narrow": series_of(NARROW_CAMERA, 22)}


@pytest.fixture(scope="module")
def expected(taken, tmp_path_factory):
    """Folder and figures of the sets in the standard's own form."""
    outcome = {}
    for name, camera in (("wide", CAMERA), ("narrow", NARROW_CAMERA)):
        folder = Maker().write(tmp_path_factory.mktemp("own") / name, taken[name], camera.bits, (42, 58))
        outcome[name] = folder, figures(folder)
    return outcome


@pytest.mark.parametrize("width,name", [("wide", name) for name in MAKERS] + [("narrow", name) for name in NARROW])
def test_the_form_of_a_set_does_not_change_its_figures(taken, expected, tmp_path, width, name):
    maker, camera = (
        MAKERS[name] if width == "wide" else NARROW[name],
        CAMERA if width == "wide" else NARROW_CAMERA,
    )
    folder = maker.write(tmp_path / "set", taken[width], camera.bits, (42, 58))
    assert is_pair_set(folder) and is_pair_set(folder / maker.name)
    found, wanted = figures(folder / maker.name), expected[width][1]
    # six digits of the photons are in every list
    for key in ("K", "dsnu_e", "prnu_percent", "read_noise_e", "row_noise_dn", "full_well_e"):
        assert found[key]["value"] == pytest.approx(wanted[key]["value"], rel=1e-7), key
    for key in ("quantum_efficiency", "responsivity", "dark_current_e_per_s"):
        assert found[key]["value"] == pytest.approx(wanted[key]["value"], rel=1e-6), key
    assert found["range"]["exposures_us"] == pytest.approx(wanted["range"]["exposures_us"])


@pytest.mark.parametrize("width,camera", [("wide", CAMERA), ("narrow", NARROW_CAMERA)])
def test_figures_are_those_of_the_camera(expected, width, camera):
    found = expected[width][1]
    assert holds(found["K"], camera.gain) and holds(found["quantum_efficiency"], camera.efficiency)
    assert holds(found["read_noise_e"], camera.read_noise) and holds(found["row_noise_dn"], camera.row_noise)
    assert holds(found["dsnu_e"], np.sqrt(sum(part**2 for part in camera.dsnu)))
    assert holds(found["prnu_percent"], 100 * np.sqrt(sum(part**2 for part in camera.prnu)))
    assert holds(found["dark_current_e_per_s"], camera.dark_current)
    assert found["black_dn"] == pytest.approx(camera.black, abs=0.6)


#: The reference implementation, in a process of its own: it sets up logging, and needs a function that NumPy has lost.
REFERENCE = """if True:
    import sys, json, numpy as np
    np.asfarray = lambda a: np.asarray(a, float)
    from emva1288 import process
    info = process.ParseEmvaDescriptorFile(sys.argv[1])
    r = process.Results1288(process.Data1288(process.LoadImageData(info.images).data).data)
    print(json.dumps([r.K, r.QE / 100, r.sigma_d, r.DSNU1288, r.PRNU1288, r.u_p_sat]))
"""


def reference(file):
    run = subprocess.run([sys.executable, "-c", REFERENCE, str(file)], capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def close_to_reference(found, file):
    """K, efficiency and patterns are unweighted in both; the dark noise is a fit in one and a point in the other."""
    k, efficiency, dark, dsnu, prnu, saturation = reference(file)
    assert found["K"]["value"] == pytest.approx(k, rel=5e-3)
    assert found["quantum_efficiency"]["value"] == pytest.approx(efficiency, rel=5e-3)
    assert found["temporal_dark_noise_e"]["value"] == pytest.approx(dark, rel=0.04)
    assert found["dsnu_e"]["value"] == pytest.approx(dsnu, rel=0.03)
    assert found["prnu_percent"]["value"] == pytest.approx(prnu, rel=0.03)
    assert found["full_well_e"]["photons"] == pytest.approx(saturation)


@pytest.mark.parametrize("width", ("wide", "narrow"))
def test_the_reference_implementation_is_of_one_opinion(expected, width):
    pytest.importorskip("emva1288")
    folder, found = expected[width]
    close_to_reference(found, folder / "EMVA1288_Data.txt")


#: A set of the reference implementation's own camera and list; Pillow no longer writes its pictures above 8 bit.
GENERATED = """if True:
    import sys, random, numpy as np
    np.asfarray = lambda a: np.asarray(a, float)
    np.random.seed(5); random.seed(5)
    from emva1288.camera.dataset_generator import DatasetGenerator
    from PIL import Image

    class Generator(DatasetGenerator):
        def save_image(self, img, name):
            kind = np.uint8 if self.cam.bit_depth <= 8 else np.uint16
            Image.fromarray(img.astype(kind)).save(self.outdir + "/images/" + name)

    rng = np.random.default_rng(6)
    made = Generator(width=90, height=64, bit_depth=int(sys.argv[2]), dark_current_ref=40, steps=30, L=20,
                     u_esat=float(sys.argv[4]), dsnu=float(sys.argv[3]) * rng.standard_normal((64, 90)),
                     prnu=1 + 0.017 * rng.standard_normal((64, 90)), seed=7, outdir=sys.argv[1])
    print(made.cam.K)
"""


@pytest.mark.slow
@pytest.mark.parametrize("bits,dsnu_e", [(8, 6.1), (12, 4.3)])
def test_a_set_of_the_reference_implementations_own_generator(tmp_path, bits, dsnu_e):
    pytest.importorskip("emva1288")
    run = [sys.executable, "-c", GENERATED, str(tmp_path / "made"), str(bits), str(dsnu_e), "47000"]
    gain = float(subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()[0])
    found = figures(tmp_path / "made")
    assert holds(found["K"], gain) and holds(found["prnu_percent"], 1.7)
    # rounding of the mean of means that scatter by less than a step
    assert found["dsnu_e"]["value"] == pytest.approx(dsnu_e, rel=0.03)
    close_to_reference(found, tmp_path / "made" / "EMVA1288descriptor.txt")


def test_the_light_may_vary_at_one_exposure(tmp_path):
    """One dark pair for all; the photons are those of the list."""
    frames, us = CAMERA.bench(23), 7310.0
    rates = np.linspace(0.06, 3.4, 20)
    listed = [(True, us, rate * us, frames(True, us, 2, rate)) for rate in rates]
    listed.append((False, us, 0.0, frames(False, us, 2)))
    listed += [(lit, us, 1.7 * us, frames(lit, us, 12, 1.7)) for lit in (True, False)]
    found = figures(Maker().write(tmp_path / "set", listed, 12, (42, 58)))
    assert holds(found["K"], CAMERA.gain) and holds(found["quantum_efficiency"], CAMERA.efficiency)
    assert "one exposure tells no dark current" in found["dark_current_e_per_s"]["reason"]
    assert "dark frames" not in {f["check"] for f in found["findings"]}


@pytest.mark.parametrize("factor,is_one", [(1.0006, True), (0.9994, True), (1.004, False), (0.996, False)])
def test_exposures_of_light_and_dark_agree_within_a_thousandth(taken, tmp_path, factor, is_one):
    """As clocks of cameras round them; the next dark pair is far away."""
    listed = [(lit, us if lit else factor * us, photons, frames) for lit, us, photons, frames in taken["wide"]]
    folder = Maker().write(tmp_path / "set", listed, 12, (42, 58))
    if is_one:
        pairs = read_pair_set(folder)
        assert [d.exposure_s for d in pairs.dark] == pytest.approx([factor * s.exposure_s for s in pairs.lit], rel=1e-6)
        assert not pairs.is_dark_once
    else:
        with pytest.raises(SpecError, match=r"Data.txt:4: 452 photons, 400 µs: no dark pair of this exposure"):
            read_pair_set(folder)


@pytest.mark.parametrize("pair", (True, False))
def test_dark_frames_of_one_exposure_stand_for_all(taken, tmp_path, pair):
    """A pair of one exposure and the long series, or the long series alone; the dark current is too small to matter."""
    camera = CAMERA.but(dark_current=60.0)
    dark = [entry for entry in series_of(camera, 25) if not entry[0] and len(entry[3]) > 2]
    listed = [entry for entry in series_of(camera, 25) if entry[0]] + dark
    if pair:
        listed.append((False, camera.long_us, 0.0, dark[0][3][:2]))
    found = figures(Maker().write(tmp_path / "set", listed, 12, (42, 58)))
    assert holds(found["K"], camera.gain) and holds(found["quantum_efficiency"], camera.efficiency)
    texts = {f["check"]: f["text"] for f in found["findings"]}
    assert texts["dark frames"].startswith("dark frames of one exposure, 11400 µs, stand for those of all")


def test_of_several_long_series_that_at_half_of_saturation_is_used(tmp_path):
    """A fifth, half and nine tenths of saturation; only the second has this camera's response."""
    camera = CAMERA.but(exposures_us=tuple(float(t) for t in np.linspace(700, 47_000, 24).round()))
    listed = [entry for entry in series_of(camera, 24) if len(entry[3]) == 2]
    full_us = (4095 - camera.black) / camera.gain / camera.efficiency / camera.photons_per_us
    for part in (0.2, 0.93, 0.52):
        us = round(part * full_us)
        device = camera.bench(24) if part == 0.52 else camera.but(prnu=(0.03, 0.02, 0.09)).bench(7)
        listed += [(lit, us, camera.photons(us), device(lit, us, 9)) for lit in (True, False)]
    folder = Maker().write(tmp_path / "set", listed, 12, (42, 58))
    result = evaluate(read_pair_set(folder))
    assert result.pairs.spatial_lit.exposure_s == pytest.approx(1e-6 * round(0.52 * full_us))
    found = content(result)
    assert holds(found["prnu_percent"], 100 * np.sqrt(sum(part**2 for part in camera.prnu)))
    assert any(f["text"].startswith("of 3 long series in the light, that of ") for f in found["findings"])
    halves = [read_pair_set(folder).half(number).with_long_of(result.pairs) for number in (0, 1)]
    assert [len(half.spatial_lit.files) for half in halves] == [5, 4]
    assert {half.spatial_lit.exposure_s for half in halves} == {result.pairs.spatial_lit.exposure_s}


def test_rounding_that_hides_the_dark_noise_leaves_grey_values(tmp_path):
    """EMVA 1288 R4.0: below a measured variance of 0.24 DN² σ_d is below 0.49 DN; K and the efficiency are found. The
    chances of grey values tell the noise, 0.26 DN.
    """
    camera = NARROW_CAMERA.but(gain=0.041, read_noise=6.3, row_noise=0.02, dark_current=900.0)
    folder = Maker().write(tmp_path / "set", series_of(camera, 26), 8, (42, 58))
    result = evaluate(read_pair_set(folder))
    assert 1 / 12 < result.dark.variance.min() < 0.24
    found = content(result)
    assert holds(found["K"], camera.gain) and holds(found["quantum_efficiency"], camera.efficiency)
    for name in ("read_noise_e", "temporal_dark_noise_e"):
        assert holds(found[name], camera.read_noise) and found[name]["standard_error"] < 0.1 * camera.read_noise
        assert "grey values" in found[name]["note"]
    assert found["read_noise_e"]["value_dn"] == pytest.approx(0.258, rel=0.1)
    # one whose grey values change in no frame has a limit
    still = dataclasses.replace(result)
    still.__dict__["rounded_noise"] = None
    for name in ("read_noise_e", "temporal_dark_noise_e"):
        entry = content(still)[name]
        assert entry["value"] is None and entry["upper_limit"] == pytest.approx(0.49 / 0.041, rel=0.05)
        assert "at most 0.49 DN" in entry["reason"]
    assert any("rounding hides the dark noise" in f["text"] for f in found["findings"])
    entries = frame_figures(folder).entries
    # the standard's threshold has the ADC's 1/12 DN² and half an electron besides
    expected = np.hypot(found["temporal_dark_noise_e"]["value"], np.sqrt(1 / 12) / found["K"]["value"]) + 0.5
    assert entries["threshold_e"]["value"] == pytest.approx(expected)


def test_a_dark_variance_above_the_limit_of_the_standard_has_a_value(tmp_path):
    """0.28 to 0.33 DN² as measured, of which rounding is 1/12."""
    camera = NARROW_CAMERA.but(gain=0.041, read_noise=11.2, row_noise=0.02, dark_current=900.0)
    result = evaluate(read_pair_set(Maker().write(tmp_path / "set", series_of(camera, 27), 8, (42, 58))))
    assert 0.25 < result.dark.variance.min() < 0.32
    figure = content(result)["read_noise_e"]
    # the intercept of a line over exposures from 0.3 to 5.4 ms; rounding biases it by less than its error
    assert holds(figure, camera.read_noise)
    assert not any("rounding hides" in f["text"] for f in content(result)["findings"])


def test_a_full_well_below_the_adcs_range_is_no_gap_of_grey_values(tmp_path):
    """All but a few pixels are at the well, and none above: from there on the set is saturated, and no more."""
    camera = CAMERA.but(row_noise=0.1, long_us=5021.0)
    well = 1907
    listed = [
        (lit, us, photons, np.where(frames > well, well + (frames & 1), frames).astype(np.uint16))
        for lit, us, photons, frames in series_of(camera, 28)
    ]
    found = figures(Maker().write(tmp_path / "set", listed, 12, (42, 58)))
    assert found["full_well_e"]["limited_by"] == "full well" and holds(found["K"], camera.gain)
    # the standard takes the level of the largest variance, which is the last one that the well leaves whole
    step = camera.efficiency * camera.photons_per_us * np.diff(camera.exposures_us).max()
    assert -2 * step < found["full_well_e"]["value"] - (well - camera.black) / camera.gain < 0


def test_a_long_series_at_the_full_well_is_refused(taken, tmp_path):
    """Half of the pixels at the well, the others one above: no spread over pixels follows."""
    listed = [
        (lit, us, photons, np.where(frames > 1500, 1501 + (number % 3 == 0), frames).astype(np.uint16))
        for number, (lit, us, photons, frames) in enumerate(taken["wide"])
    ]
    folder = Maker().write(tmp_path / "set", listed, 12, (42, 58))
    with pytest.raises(
        SpecError, match=r"Data.txt:\d+: 12882 photons, 11400 µs: the long series is saturated, at 150. DN"
    ):
        evaluate(read_pair_set(folder))


def mosaic(series, rng):
    """Frames of a mosaic of 2 rows and 3 columns whose place (1, 2) holds a series; the others have other lights."""
    outcome = []
    for lit, us, photons, frames in series:
        count, rows, cols = frames.shape
        whole = rng.integers(60, 900, (count, 2 * rows, 3 * cols), np.uint16)
        whole[:, 1::2, 2::3] = frames
        outcome.append((lit, us, photons, whole))
    return outcome


def test_a_mosaic_is_refused_or_evaluated_at_one_place(taken, expected, tmp_path):
    listed = mosaic(taken["wide"], np.random.default_rng(2))
    text = "bit_depth: 12\ntile_rows: 2\ntile_cols: 3\n"
    folder = Maker(capture=text).write(tmp_path / "set", listed, 12, (84, 174))
    with pytest.raises(SpecError, match=r"capture.yaml: EMVA 1288 evaluates one colour at a time: state tile_position"):
        read_pair_set(folder)
    (folder / "capture.yaml").write_text(text + "tile_position: [1, 2]\n", encoding="utf-8")
    found = figures(folder)
    assert found["K"] == expected["wide"][1]["K"] and found["prnu_percent"] == expected["wide"][1]["prnu_percent"]
    # the file is of the pixels of this place, without a tile
    calibrate_aps(folder, tmp_path / "found.yaml")
    capture = read_calibration(tmp_path / "found.yaml")["capture"]
    assert (capture["tile_rows"], capture["tile_cols"]) == (1, 1) and "tile_position" not in capture
    (folder / "capture.yaml").write_text(text + "tile_position: [2, 0]\n", encoding="utf-8")
    with pytest.raises(SpecError, match=r"tile_position \[2, 0\] lies outside of the tile"):
        read_pair_set(folder)
    (folder / "capture.yaml").write_text("bit_depth: 12\ntile_rows: 3\ntile_cols: 4\ntile_position: [1, 2]\n", "utf-8")
    with pytest.raises(SpecError, match="frames of 174x84 px do not hold whole tiles of 4x3"):
        read_pair_set(folder)


def test_a_mosaic_that_is_not_stated_is_recognised(tmp_path):
    """Three colours, of 100, 71 and 52 % of the light; and rows of two gains, 5 % apart, are no colours."""
    share = {(0, 0): 0.71, (0, 1): 1.0, (1, 0): 1.0, (1, 1): 0.52}
    for number, apart in enumerate((True, False)):
        camera = CAMERA.but(rows=21, cols=29)
        whole = {}
        for place, part in share.items():
            own = camera.but(efficiency=camera.efficiency * (part if apart else 1 - 0.05 * place[0]))
            whole[place] = series_of(own, 40 + 2 * place[0] + place[1])
        listed = []
        for k, (lit, us, photons, frames) in enumerate(whole[0, 0]):
            mixed = np.empty((len(frames), 42, 58), np.uint16)
            for (row, col), series in whole.items():
                mixed[:, row::2, col::2] = series[k][3]
            listed.append((lit, us, photons, mixed))
        folder = Maker().write(tmp_path / str(number), listed, 12, (42, 58))
        if not apart:
            evaluate(read_pair_set(folder))
            continue
        with pytest.raises(SpecError, match=r"the places of a 2x2 tile have 7\d, (100|99), (100|99), 5\d % of the lar"):
            evaluate(read_pair_set(folder))
        (folder / "capture.yaml").write_text("bit_depth: 12\ntile_rows: 2\ntile_cols: 2\ntile_position: [1, 1]\n")
        found = figures(folder)
        assert holds(found["quantum_efficiency"], 0.52 * camera.efficiency) and holds(found["K"], camera.gain)


GREEN, GREY = [[0.17, 1.0], [0.96, 0.31]], [[1.0, 1.0], [1.0, 1.0]]
PLACES = r"452 photons, 400 µs: the places of a 2x2 tile have \d\d, 100, 9\d, \d\d % of the largest"


@pytest.mark.parametrize(
    ("tile", "bits", "message"),
    [(GREEN, 12, PLACES), (GREY, 16, "RAW frames; if they are 12 bits of an ADC, moved to the left, state 12 bits")],
    ids=("colours", "bits"),
)
def test_gaps_between_grey_values_are_not_always_those_of_scaled_frames(tmp_path, tile, bits, message):
    """A quiet sensor: no pixel has the values between those of its colours, or 12 bit stand at the upper end of 16."""
    share = np.tile(tile, (52, 67))
    rng, listed = np.random.default_rng(8), []
    for us, count in (*((400.0 + 300 * k, 2) for k in range(5)), (900.5, 3)):
        for lit in (True, False):
            electrons = rng.poisson(lit * CAMERA.efficiency * CAMERA.photons(us) * share, (count, *share.shape))
            value = CAMERA.black + CAMERA.gain * (electrons + 2.1 * rng.standard_normal(electrons.shape))
            listed.append((lit, us, CAMERA.photons(us), np.rint(value).astype(np.uint16) << (bits - 12)))
    folder = Maker().write(tmp_path / "set", listed, bits, share.shape)
    with pytest.raises(SpecError, match=message):
        both_levels(read_pair_set(folder))


def edited(expected, tmp_path, change):
    """A copy of the set of 12 bit whose list was edited."""
    import shutil

    folder = tmp_path / "set"
    shutil.copytree(expected["wide"][0], folder)
    file = folder / "EMVA1288_Data.txt"
    lines = file.read_text(encoding="utf-8").splitlines()
    change(lines, folder)
    file.write_text("\n".join(lines), encoding="utf-8")
    return folder


def colours(lines, folder):
    from PIL import Image

    Image.fromarray(np.random.default_rng(1).integers(0, 99, (42, 58, 3), np.uint8)).save(folder / "images" / "c.png")
    lines[4] = "i images\\c.png"


def twice_the_size(lines, folder):
    lines.insert(3, "n 12 58 42")


def both_marks(lines, folder):
    lines[3] = "b 1.234,5 77"


def light_in_the_dark(lines, folder):
    first = next(k for k, line in enumerate(lines) if line.startswith("d"))
    lines[first] += " 12,5"


def not_left(lines, folder):
    """The brightest frame is to the left of 16 bits, and the others are not."""
    from PIL import Image

    number = max(k for k, line in enumerate(lines) if line.startswith("b") and k < len(lines) - 24)
    for name in (lines[number + 1], lines[number + 2]):
        file = folder / name[2:].replace("\\", "/")
        Image.fromarray(np.asarray(Image.open(file)) << 4).save(file)


def outside(lines, folder):
    (folder.parent / "other.png").write_bytes((folder / "images" / "b_000_snap_000.png").read_bytes())
    lines[4] = f"i {folder.parent}/other.png"


def inverted(lines, folder):
    import tifffile

    values = np.random.default_rng(1).integers(0, 99, (42, 58), np.uint16)
    tifffile.imwrite(folder / "images" / "c.tif", values, photometric="miniswhite")
    lines[4] = "i images/c.tif"


def short_pgm(lines, folder):
    (folder / "images" / "c.pgm").write_bytes(b"P5 58 42 4095\n" + bytes(2 * 58 * 42 - 2))
    lines[4] = "i images/c.pgm"


def high_pgm(lines, folder):
    (folder / "images" / "c.pgm").write_bytes(b"P5 58 42 900\n" + bytes([3, 133]) + bytes(2 * 58 * 42 - 2))
    lines[4] = "i images/c.pgm"


BAD = {
    "a colour picture": (colours, r"c.png: is a colour picture; EMVA 1288 evaluates the values of the ADC"),
    "two sizes": (twice_the_size, r"EMVA1288_Data.txt:4: a second line 'n"),
    "a point and a comma in one number": (both_marks, r"EMVA1288_Data.txt:4: expected b <exposure ns> <photons>"),
    "light in the dark": (light_in_the_dark, r"EMVA1288_Data.txt:\d+: 12.5 photons in the dark"),
    "frames of two alignments": (not_left, r"EMVA1288_Data.txt:\d+: .* no multiples of 16, as the brightest frame has"),
    "an absolute path outside": (outside, r"EMVA1288_Data.txt:5: no such file"),
    "white is zero": (inverted, r"c.tif: is a picture whose values do not rise with the light"),
    "a short PGM": (short_pgm, r"c.pgm: holds 2435 values; expected 2436"),
    "a PGM above its largest value": (high_pgm, r"c.pgm: holds a value of 901, above its largest, 900"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_set_is_one_error(expected, tmp_path, name):
    change, message = BAD[name]
    with pytest.raises(SpecError, match=message) as error:
        evaluate(read_pair_set(edited(expected, tmp_path, change)))
    assert "\n" not in str(error.value)


def test_two_lists_in_a_folder_are_one_too_many(taken, tmp_path):
    folder = MAKERS["TIFF in tiles"].write(tmp_path / "set", taken["wide"], 12, (42, 58))
    (folder / "other.csv").write_bytes((folder / "Data.TXT").read_bytes())
    with pytest.raises(SpecError, match=r"holds 2 lists of EMVA 1288 pictures, Data.TXT and other.csv; name the one"):
        read_pair_set(folder)
    assert read_pair_set(folder / "other.csv").shape == (42, 58)


def test_a_list_in_utf_8_of_notes_alone_is_none(tmp_path):
    (tmp_path / "notes.txt").write_text("n of frames: 12 58 42\nb careful\n", encoding="utf-8")
    assert not is_pair_set(tmp_path) and not is_pair_set(tmp_path / "notes.txt")


@pytest.mark.parametrize("form,suffix", [("pgm", ".pgm"), ("ascii", ".pgm"), ("wide", ".tif"), ("", ".bmp")])
def test_a_plain_folder_may_hold_other_pictures(taken, expected, tmp_path, form, suffix):
    width, camera = ("narrow", NARROW_CAMERA) if suffix == ".bmp" else ("wide", CAMERA)
    folder = tmp_path / "plain"
    folder.mkdir()
    for lit, us, photons, frames in taken[width]:
        # the long series has a name of its own
        us = us + 0.01 * (len(frames) > 2)
        light = f"lit_{us}us_{photons}ph" if lit else f"dark_{us}us"
        for number, frame in enumerate(frames):
            emva_makers.save(folder / f"{light}_{number:02}{suffix}", frame, form, camera.bits)
    (folder / "capture.yaml").write_text(f"bit_depth: {camera.bits}\ntile_rows: 1\ntile_cols: 1\n", "utf-8")
    assert figures(folder)["K"]["value"] == pytest.approx(expected[width][1]["K"]["value"], rel=1e-9)


def test_a_frame_of_a_plain_folder_without_its_second_is_named(tmp_path):
    emva_makers.save(tmp_path / "dark_400us_00.pgm", np.full((4, 6), 90, np.uint16), "pgm", 12)
    (tmp_path / "capture.yaml").write_text("bit_depth: 12\ntile_rows: 1\ntile_cols: 1\n", "utf-8")
    with pytest.raises(SpecError, match=r"dark_400us_00\.pgm alone; a pair has two"):
        read_pair_set(tmp_path)
