"""`simulate` knows a scene, a video, a cube, a run file and a recording by what they are; help has two levels."""

import json

import numpy as np
import pytest
from test_cli import call, fails

import hesim_render as hr
from hesim_render.cli.commands import program
from hesim_render.cli.inputs import _CUBES, InputKind, check_options, input_kind, with_values
from hesim_render.core.errors import ConflictError, RangeError
from hesim_render.targets.cube_file import READERS

RUN = (
    "schema_version: 1\nname: r\nscene: dark\nsensor: reference-mono\nroi: 8x8\nduration_s: 0.003\nsamples: 2\n"
    "set: {sensor.geometry.pitch_um: 37.5}\n"
)
SCENE = "schema_version: 1\nname: s\ndescription: d\nlight: {type: uniform}\ncamera: {fit: target}\n"


def test_the_kind_of_an_input(tmp_path):
    for name, text in (("run.yaml", RUN), ("scene.yaml", SCENE), ("misspelt.yaml", RUN.replace("scene:", "scne:"))):
        (tmp_path / name).write_text(text)
    for folder, file in (("pictures", "0001.png"), ("cave", "toys_ms_07.png"), ("recording", "recording.json")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).touch()

    def kind(name, *keys):
        return input_kind(str(tmp_path / name), keys)

    assert [kind(name) for name in ("run.yaml", "misspelt.yaml", "scene.yaml")] == [
        InputKind.run, InputKind.run, InputKind.scene,
    ]  # fmt: skip
    assert [kind(name) for name in ("pictures", "cave", "recording")] == [
        InputKind.video, InputKind.cube, InputKind.recording,
    ]  # fmt: skip
    assert kind("x.npy") is InputKind.video and kind("x.npy", "fps", "wavelength_nm") is InputKind.cube
    assert kind("clip.MP4") is InputKind.video and kind("scene.MAT") is InputKind.cube
    assert input_kind("dark", ()) is input_kind("nowhere", ()) is input_kind("nowhere.yaml", ()) is InputKind.scene


def test_a_folder_does_not_hide_a_shipped_scene(tmp_path, monkeypatch):
    (tmp_path / "dark").mkdir()
    monkeypatch.chdir(tmp_path)
    assert input_kind("dark", ()) is InputKind.scene


def test_the_ends_of_cubes_are_those_that_can_be_read():
    assert {*_CUBES, ".npy"} == set(READERS)


@pytest.mark.parametrize(("kind", "option"), [
    (InputKind.video, "--quality"), (InputKind.cube, "--truth"), (InputKind.run, "--framing"),
    (InputKind.video, "--look"), (InputKind.run, "--live"),
    (InputKind.recording, "--seed"), (InputKind.recording, "--set"), (InputKind.scene, "--scene"),
])  # fmt: skip
def test_an_option_of_another_kind_is_refused(kind, option):
    for value in (3, 0, 0.0):
        with pytest.raises(ConflictError, match=f"^{option}: the input is {kind.value}; only "):
            check_options(kind, {"--out": None, option: value})
    check_options(kind, {option: None, "--clean": False, "--without": []})


def test_a_value_of_0_is_a_value(capsys, tmp_path):
    """0 equals False: ``--seed 0`` must not become the default seed, nor ``--quality 0`` the default quality."""
    given = ["simulate", "dark", "--sensor", "dvs128", "--roi", "8x8", "--out", tmp_path / "o"]
    for option in ("--quality", "--samples", "--truth-every-us"):
        assert option in fails(capsys, *given, option, "0", "--truth", "ids")
    status, *_ = call(capsys, *given, "--seed", "0", "--duration", "0.002", "--quiet")
    assert status == 0 and hr.Recording.load(tmp_path / "o").manifest["seed"] == 0


def test_options_change_the_keys_of_a_run_file(capsys, tmp_path):
    (tmp_path / "run.yaml").write_text(RUN)
    given = ["simulate", tmp_path / "run.yaml", "--out", tmp_path / "o", "--duration", "0.002", "--seed", "11"]
    given += ["--set", "sensor=dvs128", "--set", "sensor.lens.f_number=3.5", "--clean", "--json"]
    status, out, _ = call(capsys, *given)
    made = hr.Recording.load(tmp_path / "o" / "recording")
    assert status == 0 and json.loads(out)["duration_us"] == 2000 and made.manifest["seed"] == 11
    assert made.manifest["sensor"]["name"] == "dvs128" and made.manifest["settings"]["clean"] is True
    spec = made.manifest["sensor"]["spec"]  # a key of the sensor is added to those of the file
    assert (spec["lens"]["f_number"], spec["geometry"]["pitch_um"]) == (3.5, 37.5)
    assert made.manifest["roi"]["width_px"] == 8 and made.manifest["settings"]["samples"] == 2
    assert "sensor" in fails(capsys, "simulate", tmp_path / "run.yaml", "--out", tmp_path / "p", "--sensor", "nothing")


def test_values_that_are_files_or_ranges(tmp_path):
    made = with_values({"wavelength_nm": "400:420:10", "fit": "pixel"})
    assert made == {"wavelength_nm": [400, 410, 420], "fit": "pixel"}
    with pytest.raises(RangeError, match=r"^wavelength_nm is 'x'; expected FIRST:LAST:STEP"):
        with_values({"wavelength_nm": "x"})


def test_unknown_keys_of_videos_and_cubes_are_named(capsys, tmp_path):
    np.save(tmp_path / "v.npy", np.full((3, 8, 8), 9, np.uint8))
    base = ["simulate", tmp_path / "v.npy", "--sensor", "reference-mono", "--roi", "8x8", "--out", tmp_path / "o"]
    assert "fsp: unknown key (did you mean 'fps'?)" in fails(capsys, *base, "--set", "fsp=9")
    assert "pan_px" in fails(capsys, *base, "--set", "wavelength_nm=400:700:100", "--set", "pan_px=3")
    assert not (tmp_path / "o").exists()


def commands(name="", command=None):
    command = command or program()
    if below := getattr(command, "commands", None):
        for word, each in below.items():
            yield from commands(f"{name} {word}".strip(), each)
    else:
        yield name, command


@pytest.mark.parametrize(("name", "command"), list(commands()))
def test_the_help_of_a_command_is_short_and_all_options_are_one_step_away(name, command, capsys):
    status, out, _ = call(capsys, *name.split(), "--help")
    _, _, shown = out.partition("Options:\n")
    assert status == 0 and sum(line.startswith("  --") for line in shown.splitlines()) <= 12
    hidden = [option for option in command.params if getattr(option, "hidden", False)]
    assert not any(f"  {option.opts[-1]} " in shown for option in hidden)
    if not hidden:
        return
    status, out, _ = call(capsys, *name.split(), "--help-all")
    assert status == 0 and all(f"  {option.opts[-1]} " in out for option in hidden)
    assert call(capsys, *name.split(), "--help")[1].endswith(shown)  # the full help changes nothing


def test_there_are_few_commands_and_their_lists_are_not_cut(capsys):
    assert len(program().commands) <= 15
    for name, command in program().commands.items():
        if getattr(command, "commands", None):
            assert "..." not in call(capsys, name, "--help")[1].partition("Commands:")[2]
