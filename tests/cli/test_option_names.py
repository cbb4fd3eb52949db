"""Errors of functions name arguments; on the command line the same errors name options."""

import pytest

from hesim_render.cli.commands import program
from hesim_render.cli.options import in_options
from hesim_render.core.errors import ConflictError, RangeError, SpecError


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
    (["view", "r"], "seed", "seed"),  # a command without it
    ([], "seed", "seed"),
])  # fmt: skip
def test_the_option_stands_for_the_argument(given, name, option):
    assert in_options(RangeError(name, 7, "0 to 5"), program(), given) == f"{option} is 7; expected 0 to 5"


def test_other_messages_stay_as_they_are():
    for error in (ConflictError("seed", 7, "give one or the other"), SpecError("seed is 7; expected 5", file="a.yaml")):
        assert in_options(error, program(), ["simulate", "dark"]) == str(error)
