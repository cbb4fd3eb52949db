"""Values that can be simulated but are hardly meant are told in one line; what ships, and what cameras have, is not."""

import warnings

import pytest
import recordings

from hesim_render.core.errors import HesimWarning, SpecError, closest
from hesim_render.recording.recording import warn_of_exposure
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs import read_scene
from hesim_render.specs.files import data_folder, list_names

ODD = [  # override, and what is said of it; the value before the last is just not odd
    ({"aps.exposure_us": 4}, 20, "aps.exposure_us: 4 µs is shorter than any camera's shutter"),
    ({"aps.exposure_us": 14}, 15, "aps.exposure_us: 14 µs is shorter than line_time_us, 14.2 µs"),
    ({"aps.full_well_e": 100}, 700, "aps.full_well_e: pixels clip at 100 e⁻ of the 5994 e⁻ that the ADC reaches: "
                                    "RAW stays below 80 of 1023 DN"),
    ({"aps.system_gain_dn_per_e": 4.0}, 0.8, "aps.system_gain_dn_per_e: the ADC clips at 240 e⁻ of a full well"),
    ({"aps.read_noise_e": 700}, 500, "aps.read_noise_e: 700 e⁻ is a large part of the full well, 6000 e⁻"),
    ({"aps.dark_current_e_per_s": 4e5}, 2.9e5, "aps.dark_current_e_per_s: dark current alone gives 4e+03 e⁻"),
    ({"aps.black_level_dn": 600}, 500, "aps.black_level_dn: 600 DN takes most of the ADC's 1023 DN"),
    ({"evs.contrast_threshold_on": 20}, 2.3, "evs.contrast_threshold_on: 20 is an event for a contrast of 4.85e+10 %"),
    ({"evs.contrast_threshold_off": 0.001}, 0.011, "evs.contrast_threshold_off: 0.001 is an event for a contrast of"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "usual", "told"), ODD)
def test_a_value_that_is_hardly_meant_is_told_in_one_line(change, usual, told):
    with pytest.warns(HesimWarning) as caught:
        read_sensor("eiger", change)
    (text,) = [str(each.message) for each in caught]
    assert told in text and "\n" not in text and "eiger.yaml" in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_sensor("eiger", dict.fromkeys(change, usual))


def test_a_file_of_its_own_is_told_with_its_line(tmp_path):
    text = (data_folder("sensors") / "eiger.yaml").read_text().replace("exposure_us: 10000", "exposure_us: 4")
    (tmp_path / "mine.yaml").write_text(text)
    line = next(k for k, each in enumerate(text.splitlines(), 1) if "exposure_us: 4" in each)
    with pytest.warns(HesimWarning, match=rf"mine\.yaml:{line}: aps\.exposure_us: 4 µs"):
        read_sensor(tmp_path / "mine.yaml")


def test_no_shipped_sensor_is_doubted():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in list_names("sensors"):
            read_sensor(name)


def test_dark_and_overexposed_frames_are_told():
    recording = recordings.make("eiger", frames=3)
    frame, valid = recording.frames[1], recording.frames[1].valid
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert warn_of_exposure(recording) is recording
    mean = frame.electrons_mean.copy()
    frame.electrons_mean[valid] = 3.0
    frame.electrons_mean[tuple(axis[0] for axis in valid.nonzero())] = 0.0  # of one pixel: no light is that of all
    with pytest.warns(HesimWarning, match=r"frame 1, .*nearly dark: 99 % .* fewer than 3 e⁻, at a read noise of 5 e⁻"):
        warn_of_exposure(recording)
    for electrons in (5.1, 0.0):  # more than the read noise; no light at all is meant
        frame.electrons_mean[valid] = electrons
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_of_exposure(recording)
    frame.electrons_mean[:] = mean
    places = valid.nonzero()
    count = places[0].size * 2 // 3
    frame.raw[places[0][:count], places[1][:count]] = 1023
    with pytest.warns(HesimWarning, match=r"frame 1, .*overexposed: \d\d % of its pixels are saturated"):
        warn_of_exposure(recording)


def test_a_key_without_its_unit_or_section_is_found():
    assert closest("illuminance", ["illuminant", "illuminance_lux"]) == "illuminance_lux"
    assert closest("fov", ["f_number", "horizontal_fov_deg"]) == "horizontal_fov_deg"
    assert closest("deg", ["angle_deg", "horizontal_fov_deg"]) is None
    assert closest("illuminent", ["illuminant", "illuminance_lux"]) == "illuminant"
    for read, name, key, meant in (
        (read_scene, "colorchecker", "light.illuminance", "illuminance_lux"),
        (read_scene, "colorchecker", "fit", "camera.fit"),
        (read_sensor, "eiger", "exposure_us", "aps.exposure_us"),
    ):
        with pytest.raises(SpecError, match=rf"{key}: unknown key \(did you mean '{meant}'\?\)"):
            read(name, {key: 1})
    with pytest.raises(SpecError, match=r"bogus: unknown key; set by an override"):
        read_sensor("eiger", {"bogus": 1})


def test_a_file_of_the_other_kind_is_told():
    for read, kind, name in ((read_scene, "sensor", "eiger"), (read_sensor, "scene", "rotating-star")):
        other = "scene" if kind == "sensor" else "sensor"
        with pytest.raises(SpecError, match=rf"{name}\.yaml: is a {kind} file; expected a {other} file"):
            read(data_folder(f"{kind}s") / f"{name}.yaml")
