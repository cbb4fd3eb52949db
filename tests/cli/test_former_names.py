"""Commands and options of drafts: one line says what they are called now, and what it says is right."""

import shlex

import pytest
from test_cli import fails

from hesim_render.cli.commands import program
from hesim_render.cli.former_names import _COMMANDS, _OPTIONS, name_now
from hesim_render.sources.cube import CubeOptions
from hesim_render.sources.video import VideoOptions


@pytest.mark.parametrize(("given", "now"), [
    (["video", "clip.mp4", "--sensor", "gen2", "--out", "o"], "hesim-render simulate VIDEO; its options are keys"),
    (["doctor"], "It is now: hesim-render info"),
    (["list", "scenes"], "hesim-render info KIND"),
    (["sensor", "describe", "gen2"], "hesim-render info SENSOR"),
    (["sensor", "new", "x.yaml"], "hesim-render new FILE"),
    (["study", "cfa", "five-cfas", "--out", "o"], "hesim-render study SPEC"),
    (["benchmark", "pack", "b", "--out", "o"], "hesim-render benchmark export --format webdataset"),
    (["simulate", "v.npy", "--sensor", "gen2", "--out", "o", "--fps", "100"], "now: --set fps=VALUE"),
    (["simulate", "c.npy", "--sensor", "gen2", "--out", "o", "--pan=3,0"], "now: --set pan_px_per_s=[X,Y]"),
])  # fmt: skip
def test_a_former_name_is_answered_with_the_present_one(given, now, capsys):
    assert now in fails(capsys, *given)


def test_a_plain_mistake_is_not_taken_for_a_former_name(capsys):
    assert "now" not in fails(capsys, "simulat")
    assert name_now(["view", "--wrong"]) is None


def test_what_is_named_exists():
    every = program().commands
    for text in _COMMANDS.values():
        word, *rest = shlex.split(text.partition(";")[0])
        below = getattr(every[word], "commands", None)
        assert below is None or rest[0] in below
    keys = set(VideoOptions.model_fields) | set(CubeOptions.model_fields)
    named = [text.removeprefix("--set ").partition("=")[0] for text in _OPTIONS.values() if text.startswith("--set ")]
    assert set(named) <= keys and len(named) == len(_OPTIONS) - 1
