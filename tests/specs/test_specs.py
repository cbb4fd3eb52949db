"""Sensor and scene files: what ships is complete, and every mistake names file, line and key."""

import math
import re
import typing
import warnings
from pathlib import Path

import pytest
from pydantic import BaseModel

from hesim_render.core import yaml_file
from hesim_render.core.errors import HesimWarning, RangeError, SpecError
from hesim_render.core.yaml_file import read_yaml
from hesim_render.mosaic.layout import Layout
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs import SceneSpec, SensorSpec, read_scene
from hesim_render.specs.event_pixels import EvsSpec
from hesim_render.specs.files import (
    Strict,
    apply_overrides,
    content_hash,
    data_folder,
    list_names,
    parse_override,
)
from hesim_render.specs.frame_pixels import ApsSpec

SENSOR = (data_folder("sensors") / "eiger.yaml").read_text()
SCENE = """schema_version: 1
name: mine
description: a grey field
target:
  type: flat
  width_m: 0.3
  reflectance: 0.18
light:
  type: uniform
  illuminance_lux: 1000
camera:
  fit: target
motion:
  - object: target
    keyframes:
      - {t_us: 0}
      - {t_us: 1000, rotation_deg: 5}
"""


def line_with(text, part):
    return next(number for number, line in enumerate(text.splitlines(), 1) if part in line)


def error_of(tmp_path, text, reader):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(SpecError) as caught:
        reader(file)
    error = caught.value
    assert "\n" not in str(error)
    assert str(error).startswith(f"{file}:{error.line}: ")
    assert error.key is None or error.key in str(error)
    return error


# what is replaced, by what; the key and the text that the message must hold
MISTAKES = [
    ("read_noise_e: 5.0", "reed_noise_e: 5.0", "aps.reed_noise_e", "unknown key"),
    ("device_seed: 3003", "device_sed: 3003", "device_sed", "unknown key"),
    ("bit_depth: 10", "bit_depth: ten", "aps.bit_depth", "integer"),
    ("bit_depth: 10", "bit_depth: 17", "aps.bit_depth", "16"),
    ("exposure_us: 10000", "exposure_us: -5", "aps.exposure_us", "greater than 0"),
    ("exposure_us: 10000", "exposure_us: 10.5", "aps.exposure_us", "integer"),
    ("exposure_us: 10000", "exposure_us: 200000", "aps.exposure_us", "longer than a frame period"),
    ("read_noise_e: 5.0", "read_noise_e: .nan", "aps.read_noise_e", "finite"),
    ("line_time_us: 14.2", "line_time_us: 0", "aps.line_time_us", "rolling shutter"),
    ("black_level_dn: 64", "black_level_dn: 1023", "aps.black_level_dn", "10 bits"),
    ("  R r G g", "  R r G X", "tile", "'X' is not defined"),
    ("  R r G g", "  R r G", "tile", "same number of letters"),
    ("rows: 2448", "rows: 2447", "geometry", "whole number"),
    ("b: {filter: blue,", "b: {filter: bleu,", "pixels.b.filter", "no filter 'bleu'"),
    ("R: {filter: red, roles: [aps]}", "R: {filter: red, roles: [apps]}", "pixels.R.roles.0", "'aps' or 'evs'"),
    ("rows_per_tile: 2", "rows_per_tile: 3", "evs_grid", "4 event pixels"),
    ("channel: green", "channel: gren", "filters.green.camera", "no channel 'gren'"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: 1.7", "quantum_efficiency", "[0, 1]"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: nowhere.csv", "quantum_efficiency", "nowhere.csv"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: D66", "quantum_efficiency", "unknown illuminant 'D66'"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: {flat: 1, colour: 2}", "quantum_efficiency.colour", "unknown key"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: {wavelength_nm: [500, 400], value: [1, 1]}", "quantum_efficiency",
     "increase strictly"),
    ("quantum_efficiency: 0.7", "quantum_efficiency: {flat: 0.5, band_nm: [900, 1000]}", "filters.red",
     "do not overlap"),
    ("f_number: 2.0", "f_number: 0", "lens.f_number", "greater than or equal to 0.1"),
    ("relative_illumination: cos4", "relative_illumination: {image_height_mm: [0, 1], illumination_rel: [1, 2]}",
     "lens.relative_illumination", "[0, 1]"),
    ("window_us: 1000", "window_us: 2000", "evs.window_us", "longer than tick_us"),
    ("beta2: 5.0e-3", "beta2: 0", "evs.coefficients.0.beta2", "greater than or equal to"),
    ("filter: own", "filter: ultraviolet", "evs.signal_reference.filter", "no filter 'ultraviolet'"),
    ("  evs.shot_law:", "  evs.shoot_law:", "sources.evs.shoot_law", "no such key"),
    ("schema_version: 1", "schema_version: 2", "schema_version", "should be 1"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "key", "text"), MISTAKES)
def test_a_wrong_sensor_file_names_file_line_and_key(old, new, key, text, tmp_path):
    assert SENSOR.count(old) >= 1
    error = error_of(tmp_path, SENSOR.replace(old, new, 1), read_sensor)
    assert error.key is not None and (error.key == key or error.key.startswith(f"{key}."))
    assert text in str(error)
    # checks of a whole section report its first line, all others the very line
    section = {"tile": "tile:", "filters.red": "  red:"}.get(key, old)
    assert error.line == line_with(SENSOR, section)


@pytest.mark.parametrize(
    ("old", "new", "key", "line_of", "text"),
    [
        ("type: flat", "type: flatt", "target.type", "type:", "flatt"),
        ("width_m: 0.3", "width: 0.3", "target.width", "width_m", "unknown key"),
        ("width_m: 0.3", "width_m: -1", "target.width_m", "width_m", "greater than or equal to"),
        ("  illuminance_lux: 1000\n", "", "light", "light:", "exactly one of"),
        ("illuminance_lux: 1000", "illuminance_lux: -1", "light.illuminance_lux", "illuminance_lux", "or equal to 0"),
        ("fit: target", "fit: all", "camera.fit", "fit:", "should be 'target'"),
        ("object: target", "object: ball", "motion", "motion:", "no object 'ball'"),
        ("t_us: 1000", "t_us: 0", "motion.0.keyframes", "keyframes:", "in order of time"),
        ("reflectance: 0.18", "reflectance: {colorchecker: Babel, patch: 1}", "target.reflectance", "reflectance",
         "Babel"),
    ],
)  # fmt: skip
def test_a_wrong_scene_file_names_file_line_and_key(old, new, key, line_of, text, tmp_path):
    assert old in SCENE
    error = error_of(tmp_path, SCENE.replace(old, new, 1), read_scene)
    assert error.key is not None and error.key.startswith(key) and text in str(error)
    assert error.line == line_with(SCENE, line_of)


def test_missing_keys_and_sections(tmp_path):
    assert error_of(tmp_path, SENSOR.replace("  full_well_e: 6000\n", ""), read_sensor).key == "aps.full_well_e"
    assert error_of(tmp_path, SENSOR.replace("name: eiger\n", ""), read_sensor).key == "name"
    error = error_of(tmp_path, SENSOR.replace("evs_grid: {rows_per_tile: 2, cols_per_tile: 2}\n", ""), read_sensor)
    assert error.key == "evs_grid" and "required" in str(error)
    error = error_of(tmp_path, SCENE.replace("camera:\n  fit: target\n", ""), read_scene)
    assert error.key == "camera"


def test_broken_yaml_names_the_line(tmp_path):
    error = error_of(tmp_path, SENSOR.replace("name: eiger", "name: [eiger"), read_sensor)
    assert "not valid YAML" in str(error)
    error = error_of(tmp_path, SENSOR.replace("name: eiger", "name: eiger\nname: again"), read_sensor)
    assert error.line == line_with(SENSOR, "name: eiger") + 1 and "duplicate" in str(error)
    assert "mapping" in str(error_of(tmp_path, "- 1\n", read_sensor))


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(SpecError, match=r"nowhere\.yaml: no such file"):
        read_sensor(tmp_path / "nowhere.yaml")
    with pytest.raises(SpecError, match=r"no sensor named 'eigr'; shipped are .*eiger"):
        read_sensor("eigr")
    with pytest.raises(SpecError, match="no scene named 'x'"):
        read_scene("x")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SpecError, match="not a UTF-8 text file"):
        read_sensor(tmp_path / "b.yaml")


@pytest.mark.parametrize("size", [(3268, 2448), (0, 4), (6, 4), (-4, 4)])
def test_roi_that_does_not_fit(size):
    with pytest.raises(RangeError, match="roi"):
        Layout.full(read_sensor("eiger")).crop(*size)


def test_overrides_are_validated_and_named():
    assert read_sensor("eiger", {"aps.read_noise_e": 1.5}).aps.read_noise_e == 1.5
    assert read_sensor("eiger", {"evs.coefficients.0.beta4": 0.5}).evs.coefficients[0].beta4 == 0.5
    for key, value in (("aps.read_noise_e", -1), ("aps.nothing", 1), ("nothing.at.all", 1), ("filters.red", "D66")):
        with pytest.raises(SpecError) as caught:
            read_sensor("eiger", {key: value})
        assert caught.value.key.split(".")[0] == key.split(".")[0] and "set by an override" in str(caught.value)
    with pytest.raises(SpecError, match="items 0 to 0"):
        read_sensor("eiger", {"evs.coefficients.7.beta4": 1})


def test_parse_override_reads_yaml_values():
    assert parse_override("a.b=4") == ("a.b", 4)
    assert parse_override("a=[1, 2.5]") == ("a", [1, 2.5])
    assert parse_override("a=x=y") == ("a", "x=y")
    for text in ("a", "=3", "a=[1"):
        with pytest.raises(SpecError, match="--set"):
            parse_override(text)


def test_hash_is_of_the_content_only(tmp_path):
    original = content_hash(read_sensor("eiger"))
    (tmp_path / "copy.yaml").write_text("# another comment\n" + SENSOR)
    assert content_hash(read_sensor(tmp_path / "copy.yaml")) == original
    assert content_hash(read_sensor("eiger", {"aps.read_noise_e": 5.1})) != original


@pytest.mark.parametrize("name", list_names("sensors"))
def test_shipped_sensor_files_say_where_every_number_is_from(name):
    spec = read_sensor(name)
    assert spec.name == name and spec.description
    data = read_yaml(data_folder("sensors") / f"{name}.yaml")
    told = {*spec.sources, *spec.assumptions}
    untold = [
        key
        for section in ("geometry", "lens", "aps", "evs")
        for key in numbers(data.get(section), section)
        if not any(key == prefix or key.startswith(f"{prefix}.") for prefix in told)
    ]
    # a term that is switched off with 0 claims nothing
    untold = [key for key in untold if value_at(data, key) != 0]
    assert not untold
    for section in ("filters", "quantum_efficiency"):
        assert section in told


def numbers(node, prefix):
    if isinstance(node, dict):
        return [key for name, value in node.items() for key in numbers(value, f"{prefix}.{name}")]
    if isinstance(node, list):
        return [key for number, value in enumerate(node) for key in numbers(value, f"{prefix}.{number}")]
    return [prefix] if isinstance(node, int | float) and not isinstance(node, bool) else []


def value_at(node, key):
    for part in key.split("."):
        node = node[int(part)] if isinstance(node, list) else node[part]
    return node


def test_the_six_sensors_ship():
    names = {"eiger", "gen2", "mipi-hybridevs", "davis346", "reference-mono", "reference-bayer"}
    assert names <= set(list_names("sensors"))


@pytest.mark.parametrize("name", list_names("scenes"))
def test_shipped_scene_files_load(name):
    spec = read_scene(name)
    assert spec.name == name and spec.description


def keys_of(model, within=()):
    """Every key that a file can hold, through lists, alternatives and dictionaries."""
    found = set()
    if model in within:  # a product of spectra holds spectra
        return found
    for name, field in model.model_fields.items():
        if not field.exclude:
            found.add(name)
            for inner in models_in(field.annotation):
                found |= keys_of(inner, (*within, model))
    return found


def models_in(annotation):
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in typing.get_args(annotation) for model in models_in(part)]


@pytest.mark.parametrize(("model", "document"), [(SensorSpec, "sensors.md"), (SceneSpec, "scenes.md")])
def test_the_documentation_names_every_key(model, document):
    docs = Path(__file__).parents[2] / "docs"
    # how a spectrum is written is told once, in sensors.md, and targets have a page of their own
    text = "".join((docs / name).read_text() for name in (document, "sensors.md", "targets.md"))
    untold = [key for key in keys_of(model) if not re.search(rf"(?<![\w]){key}(?![\w])", text)]
    assert untold == []


def test_all_mistakes_of_a_file_are_told_at_once_in_order_of_lines(tmp_path):
    text = (data_folder("sensors") / "eiger.yaml").read_text()
    for old, new in (
        ("read_noise_e:", "reed_noise_e:"),
        ("f_number: 2.0", "f_number: 0"),
        ("shutter: rolling", "shutter: roling"),
    ):
        assert text.count(old) >= 1
        text = text.replace(old, new, 1)
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        read_sensor(tmp_path / "mine.yaml")
    lines = str(caught.value).splitlines()
    assert len(lines) == len(caught.value.problems) == 3
    places = [int(line.split(":")[1]) for line in lines]
    assert places == sorted(places) == [problem.line for problem in caught.value.problems]
    assert [problem.key for problem in caught.value.problems] == ["lens.f_number", "aps.reed_noise_e", "aps.shutter"]
    assert "unknown key (did you mean 'read_noise_e'?)" in lines[1]  # and not that read_noise_e is missing as well
    assert "'rolling' or 'global'" in lines[2]
    assert caught.value.line == places[0] and caught.value.key == "lens.f_number"


def test_a_mistake_in_one_of_several_alternatives_is_told_once(tmp_path):
    with pytest.raises(SpecError, match="image_height_mm must start") as caught:
        read_sensor("eiger", {"lens.relative_illumination": {"image_height_mm": [2, 1], "illumination_rel": [1, 1]}})
    assert caught.value.problems == ()
    with pytest.raises(SpecError, match=r"image_height: unknown key \(did you mean 'image_height_mm'\?\)") as caught:
        read_sensor("eiger", {"lens.relative_illumination": {"image_height": [0, 1], "illumination_rel": [1, 1]}})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("aps.read_noise_e", "5"),
        ("aps.read_noise_e", True),
        ("aps.bit_depth", "10"),
        ("aps.bit_depth", True),
        ("device_seed", False),
        ("lens.magnification", "0.1"),
        ("lens.magnification", True),
        ("filters.red", {"wavelength_nm": [400, "700"], "value": [1, 1]}),
        ("filters.red", {"flat": "0.5", "band_nm": [400, 700]}),
    ],
)
def test_texts_and_booleans_are_no_numbers(key, value):
    with pytest.raises(SpecError, match="expected a number, not"):
        read_sensor("eiger", {key: value})


def test_whole_floats_are_still_whole_numbers_and_texts_no_booleans():
    assert read_sensor("eiger", {"aps.exposure_us": 2e3}).aps.exposure_us == 2000
    with pytest.raises(SpecError, match=r"motion\.0\.repeat: .*boolean"):
        read_scene("rotating-star", {"motion.0.repeat": "no"})


def test_what_no_pixel_uses_is_an_error_of_a_file_and_a_warning_of_an_override(tmp_path):
    spare = "filters:\n  spare: {flat: 0.5, band_nm: [400, 700]}\n"
    text = SENSOR.replace("filters:\n", spare).replace("pixels:\n", "pixels:\n  W: {filter: green, roles: [aps]}\n")
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        read_sensor(tmp_path / "mine.yaml")
    told = [(problem.key, problem.line) for problem in caught.value.problems]
    assert sorted(told) == [("filters.spare", line_with(text, "spare:")), ("pixels.W", line_with(text, "W: {filter"))]
    # a comparison that defines a new white pixel, and leaves the tile as it was
    with pytest.warns(HesimWarning, match=r"pixels\.W: no pixel of the tile has this letter"):
        read_sensor("eiger", {"pixels.W": {"filter": "green", "roles": ["aps"]}})
    with pytest.warns(HesimWarning, match=r"filters\.spare: no pixel has this filter"):
        read_sensor("eiger", {"filters.spare": {"flat": 0.5, "band_nm": [400, 700]}})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # a filter that is only the reference of the events' signal is used
        change = {"filters.spare": {"flat": 0.5, "band_nm": [400, 700]}, "evs.signal_reference.filter": "spare"}
        assert "spare" in read_sensor("eiger", change).filters
        for name in list_names("sensors"):
            read_sensor(name)


@pytest.mark.parametrize(
    ("band_nm", "cut"),
    [
        ((300, 700), "add an ultraviolet cut"),
        ((400, 1000), "add an infrared cut"),
        ((300, 1000), "add an ultraviolet and an infrared cut"),
    ],
)
def test_the_cut_that_is_missing_is_named(band_nm, cut):
    with pytest.raises(SpecError) as caught:
        read_sensor("reference-mono", {"filters": {"clear": {"flat": 0.9, "band_nm": list(band_nm)}},
                                       "pixels": {"M": {"filter": "clear", "roles": ["aps", "evs"]}}, "tile": "M",
                                       "quantum_efficiency": 0.5})  # fmt: skip
    assert str(caught.value).partition("rendered; ")[2].startswith(cut + ";")


@pytest.mark.parametrize("key", ["geometry.pitch_um", "lens.f_number", "lens.focal_length_mm"])
@pytest.mark.parametrize("value", [1e-300, 1e300])
def test_absurd_sizes_are_refused(key, value):
    with pytest.raises(SpecError, match=r"Input should be (greater|less) than"):
        read_sensor("eiger", {key: value})


def _required(model, prefix=""):
    """Keys that a sensor file must have, those of optional sections where the section is there."""
    for name, field in model.model_fields.items():
        if field.is_required():
            yield prefix + name
        inner = [a for a in (field.annotation, *typing.get_args(field.annotation)) if isinstance(a, type)]
        for each in inner:
            if issubclass(each, Strict) and name in ("geometry", "lens", "aps", "evs", "signal_reference"):
                yield from _required(each, f"{prefix}{name}.")


def test_the_docs_mark_the_required_keys():
    text = (data_folder("sensors").parent / "docs" / "sensors.md").read_text()
    section, marked, named = "", set(), set()
    for line in text[text.index("## Keys") :].splitlines():
        if match := re.match(r"`(aps|evs)` describes", line):
            section = f"{match[1]}."
        if line.startswith("## ") and line != "## Keys":
            break
        if line.startswith("| `"):
            first, last = line.split("|")[1], line.split("|")[3]
            for key, star in re.findall(r"`([\w.]+)`(\\\*)?", first):
                named.add(section + key)
                if star:
                    marked.add(section + key)
            if "`signal_reference`" in first:
                marked |= {f"evs.signal_reference.{key}" for key in re.findall(r"`(\w+)`\\\*", last)}
    required = set(_required(SensorSpec)) - {"geometry", "lens"}
    assert marked == required
    for group, model in (("", SensorSpec), ("aps.", ApsSpec), ("evs.", EvsSpec)):
        own = {group + name for name in model.model_fields}
        assert own - named <= {"geometry", "lens", "aps", "evs", "noise", "sources", "assumptions"}


def test_a_threshold_that_would_make_billions_of_events_is_refused():
    with pytest.raises(SpecError, match=r"evs\.contrast_threshold_off.*at least 0.0001 with reference 'last_event'"):
        read_sensor("davis346", {"evs.contrast_threshold_off": 1e-6})
    assert read_sensor("eiger", {"evs.contrast_threshold_off": 1e-6}).evs.contrast_threshold_off == 1e-6


def every_section(kind=Strict):
    for child in kind.__subclasses__():
        yield child
        yield from every_section(child)


def test_what_must_be_more_than_a_limit_must_be_more_than_nothing():
    """Strict lower limits of numbers in files are 0, but for angles above -45° and relative figures above -1.

    Defaults lie within their limits.
    """
    strict, count = set(), 0
    for section in set(every_section()):
        for name, field in section.model_fields.items():
            limits = {key: getattr(part, key) for part in field.metadata for key in ("gt", "ge", "lt", "le")
                      if hasattr(part, key)}  # fmt: skip
            strict |= {limits["gt"]} if "gt" in limits else set()
            if limits and isinstance(field.default, (int, float)):
                count += 1
                where = f"{section.__name__}.{name}"
                assert limits.get("gt", -math.inf) < field.default < limits.get("lt", math.inf), where
                assert limits.get("ge", -math.inf) <= field.default <= limits.get("le", math.inf), where
    assert strict <= {0, -1, -45} and 0 in strict and count > 60


def is_round(value):
    """One digit and zeros, or a power of two, or one less."""
    digits = f"{abs(value):.15g}".replace(".", "").partition("e")[0].strip("0")
    whole = int(value) if float(value).is_integer() else None
    return len(digits) <= 1 or (whole is not None and (whole & (whole - 1) == 0 or whole & (whole + 1) == 0))


#: Limits that are no round numbers, and why: a half or a right angle, a fisheye's field, an hour and a minute, degrees
#: Celsius of electronics and ovens, wavelengths of visible light, a lens, a signal of a thin line.
OTHER_LIMITS = {90, 45, 170, 3600, 60, 125, 360, 830, 720, -45, 0.45, -0.45, 300, 200}


def test_limits_and_defaults_of_numbers_are_round():
    """So that a slip of a digit shows. Defaults have two digits at most, but for the sides of a ColorChecker, the
    refractive index of glass and a percentile near 100."""
    count = 0
    for section in set(every_section()):
        for name, field in section.model_fields.items():
            where = f"{section.__name__}.{name}"
            for part in field.metadata:
                for key in ("gt", "ge", "lt", "le"):
                    if hasattr(part, key):
                        count += 1
                        limit = getattr(part, key)
                        assert is_round(limit) or limit in OTHER_LIMITS, f"{where}: {limit}"
                        if name.endswith("_dn") and key == "le" and section.__name__ in ("ApsSpec", "InterferenceSpec"):
                            assert limit == 2**16 - 1, where
            if isinstance(field.default, float) and (section.__name__, name) not in (
                ("ColorCheckerTarget", "width_m"), ("ColorCheckerTarget", "height_m"), ("ThinFilmSpec", "substrate"),
                ("ToneExposure", "percentile"),
            ):  # fmt: skip
                digits = f"{abs(field.default):.15g}".replace(".", "").partition("e")[0].strip("0")
                assert len(digits) <= 2, f"{where}: {field.default}"
    assert count > 350


def test_items_of_lists_are_set_by_their_numbers(tmp_path):
    (tmp_path / "a.yaml").write_text("a:\n- {b: 1, c: [3, 4, 5]}\n- 7\nd: 2\n")
    data = read_yaml(tmp_path / "a.yaml")
    apply_overrides(data, {"a.0.c.1": 8, "a.1": {"e": 9}, "d": [1], "f.g": 6})
    assert data == {"a": [{"b": 1, "c": [3, 8, 5]}, {"e": 9}], "d": [1], "f": {"g": 6}}
    for key, most in (("a.2", 1), ("a.0.c.x", 2), ("a.0.c.3", 2)):
        with pytest.raises(SpecError, match=f"the list here has items 0 to {most}"):
            apply_overrides(data, {key: 1})


def test_a_file_is_parsed_once_and_its_readers_share_nothing(tmp_path, monkeypatch):
    text = "name: a\nevs: {tick_us: 3}\nlist: [1.5, 2]\n"
    (tmp_path / "a.yaml").write_text(text)
    (tmp_path / "long.yaml").write_text(text + "#" * (1 << 16))  # what is long is not kept
    for with_lines in (True, False):
        first = read_yaml(tmp_path / "a.yaml", with_lines)
        first["evs"]["tick_us"] = 99
        first["list"].append(7)
        read_yaml(tmp_path / "long.yaml", with_lines)
        with monkeypatch.context() as patch:
            patch.setattr(yaml_file, "YAML", lambda typ: pytest.fail("parsed again"))
            again = read_yaml(tmp_path / "a.yaml", with_lines)
            assert again == {"name": "a", "evs": {"tick_us": 3}, "list": [1.5, 2]}
            assert hasattr(again, "lc") == with_lines and (not with_lines or again["list"].lc.line == 2)
            with pytest.raises(pytest.fail.Exception):
                read_yaml(tmp_path / "long.yaml", with_lines)
