"""Errors of functions name arguments; on the command line the same errors name options."""

import inspect
import typing

import pytest

import hesim_render as hr
from hesim_render.capture import lab
from hesim_render.cli import calibrate, measure, simulate
from hesim_render.cli.commands import program
from hesim_render.cli.options import in_options
from hesim_render.cli.terminal import parse_exposures
from hesim_render.core.errors import ConflictError, RangeError, SpecError
from hesim_render.measure import measure_mtf


@pytest.mark.parametrize(("given", "name", "option"), [
    (["measure", "mtf", "r"], "filter_name", "--filter"),  # begins with the option's name
    (["simulate", "v.mp4"], "duration_s", "--duration"),
    (["simulate", "c.npy"], "illuminance_lux", "illuminance_lux"),  # a key of --set keeps its name
    (["calibrate", "lab", "eiger"], "dark_exposures_us", "dark_exposures_us"),
    (["benchmark", "evaluate", "b"], "split", "--split"),  # of a group
    (["benchmark", "export", "b"], "format", "--format"),  # whose Python name has an underscore at its end
    (["simulate", "dark"], "truth_every_us", "--truth-every-us"),
    (["simulate", "dark"], "seed", "--seed"),
    (["simulate", "dark"], "scene", "scene"),  # an argument, no option
    (["simulate", "dark"], "shape of the RAW frame", "shape of the RAW frame"),
    (["calibrate", "recording", "a"], "target_contrast", "--contrast"),  # of --target and --contrast the longer one
    (["calibrate", "recording", "a"], "target_file", "--target"),
    (["view", "r"], "seed", "seed"),  # a command without it
    ([], "seed", "seed"),
])  # fmt: skip
def test_the_option_stands_for_the_argument(given, name, option):
    assert in_options(RangeError(name, 7, "0 to 5"), program(), given) == f"{option} is 7; expected 0 to 5"


def test_other_messages_stay_as_they_are():
    for error in (ConflictError("seed", 7, "give one or the other"), SpecError("seed is 7; expected 5", file="a.yaml")):
        assert in_options(error, program(), ["simulate", "dark"]) == str(error)


def every_command(group=None, names=()):
    group = program() if group is None else group
    for name, command in getattr(group, "commands", {}).items():
        if hasattr(command, "commands"):
            yield from every_command(command, (*names, name))
        else:
            yield " ".join((*names, name)), command.callback


def test_switches_are_off_until_they_are_given():
    """All of them but one, which has a form to switch it off; a command without its options does the least."""
    on, count = set(), 0
    for name, callback in every_command():
        function = inspect.unwrap(callback)
        hints = typing.get_type_hints(function)
        for option, parameter in inspect.signature(function).parameters.items():
            if hints[option] is bool:
                count += 1
                assert isinstance(parameter.default, bool), (name, option)
                if parameter.default:
                    on.add((name, option))
    assert on == {("benchmark build", "estimate")} and count > 60


@pytest.mark.parametrize(("command", "function", "names"), [
    (calibrate.lab, lab.write_captures, {"frames", "ticks", "trials", "seed", "parts", "illuminant"}),
    (simulate.simulate, hr.simulate, set()),
    (measure.measure, measure_mtf, {"frame", "signal"}),
])  # fmt: skip
def test_options_have_the_defaults_of_the_functions(command, function, names):
    told, own = (inspect.signature(inspect.unwrap(each)).parameters for each in (command, function))
    empty, both = inspect.Parameter.empty, told.keys() & own.keys()
    same = {
        name for name in both
        if told[name].default not in (empty, None) and own[name].default not in (empty, None)
        and not isinstance(told[name].default, bool)
    }  # fmt: skip
    assert same >= names
    for name in same:
        assert told[name].default == own[name].default, name
    if command is calibrate.lab:
        for name in ("dark", "lit"):
            exposures = parse_exposures(told[f"{name}_ms"].default)
            assert tuple(exposures) == own[f"{name}_exposures_us"].default
