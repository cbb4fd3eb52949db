"""Common parts of commands: options, completion of names, and checks before any work.

Names of options in errors that the Python API raised with the names of its arguments.
"""

import tempfile
from collections.abc import Callable, Sequence
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from uuid import uuid4

import typer

from hesim_render.cli.terminal import say
from hesim_render.core.errors import ConflictError, HesimError, RangeError
from hesim_render.core.output import check_target
from hesim_render.core.region import parse_roi

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor


def names_of(kind: str) -> Callable[[str], list[str]]:
    """Completion of the names of shipped files of a kind, ``scenes`` or ``sensors``."""

    def complete(incomplete: str) -> list[str]:
        from hesim_render.core.shipped import list_names

        return [name for name in list_names(kind) if name.startswith(incomplete)]

    return complete


def _noise_terms(incomplete: str) -> list[str]:
    from hesim_render.capture.run_settings import TERMS

    return [name for name in TERMS if name.startswith(incomplete)]


def full_help(context: Any) -> str:
    """The help of a command with its rare options, as `--help-all` prints it."""
    command = copy(context.command)
    command.params = [copy(each) for each in command.params]
    for each in command.params:
        each.hidden = False
    return command.get_help(context)


def _print_full_help(context: typer.Context, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        say(full_help(context))
        raise typer.Exit


#: Rare options have ``hidden=True``; a command that has some takes this one as its last.
HelpAll = Annotated[
    bool,
    typer.Option(
        "--help-all", is_eager=True, callback=_print_full_help, help="Show all options, also rare ones, and exit."
    ),
]

SENSOR_HELP = "a name (see 'info sensors') or the path of a sensor file"

#: Options that several commands share.
SensorFile = Annotated[str, typer.Option(help=SENSOR_HELP, autocompletion=names_of("sensors"))]
Region = Annotated[str | None, typer.Option(help="part of the sensor read out: WIDTHxHEIGHT or ...+X+Y, px")]
SensorKeys = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="sensor.KEY=VALUE", help="change a key of the sensor file; repeatable"),
]
FileKeys = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a key of the file; repeatable")
]
Clean = Annotated[bool, typer.Option("--clean", help="no noise at all")]
Without = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TERM",
        help="switch one noise term or effect of the lens off, as aps.read (see 'info noise', 'info lens'); repeatable",
        hidden=True,
        autocompletion=_noise_terms,
    ),
]
Truth = Annotated[
    str | None,
    typer.Option(metavar="KIND,KIND…", help="ground truth to write: depth, flow, poses, … or all (see 'info truth')"),
]
#: Runs with a longer estimate need a confirmation.
LONG_MINUTES = 30
Yes = Annotated[bool, typer.Option("--yes", help=f"also if it takes more than {LONG_MINUTES} minutes", hidden=True)]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="let the scene name files outside of its folder", hidden=True)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace an existing output")]


def check_duration(duration_s: float) -> None:
    if not 0 < duration_s < float("inf"):
        raise RangeError("--duration", duration_s, "a time above 0, in seconds")


def listed(names: str | None) -> list[str]:
    """The names of a list with commas."""
    return [name.strip() for name in (names or "").split(",") if name.strip()]


def check_output(out: Path, overwrite: bool) -> None:
    """Refuse a bad output folder before anything is rendered."""
    from hesim_render.recording.manifest import MANIFEST_NAME

    check_target(out, MANIFEST_NAME, overwrite)


def place_of(out: Path | None, dry_run: bool) -> Path:
    """The place of `--out`. A dry run, which writes nothing, also works without: its place is one that nothing has.

    Raises
    ------
    ConflictError
        If there is no place, and the run is not a dry one.
    """
    if out is not None:
        return out
    if not dry_run:
        raise ConflictError("--out", None, "Missing option '--out': the folder to write to (or --dry-run)")
    return Path(tempfile.gettempdir()) / f"dry-run-{uuid4().hex}"


def sensor_keys_only(scene_changes: dict[str, object], example: str) -> None:
    """Refuse ``--set`` of anything but a sensor file where there is no scene file."""
    for key in scene_changes:
        raise RangeError("--set", key, f"a key of the sensor file, as {example}")


def cropped(sensor: "Sensor", roi: str | None) -> "Sensor":
    """The sensor with the region of ``--roi``."""
    return sensor if roi is None else sensor.crop(*parse_roi(roi))


def in_options(error: HesimError, program: Any, given: Sequence[str]) -> str:
    """The message of an error, with the option of the command in place of the argument of a function.

    Parameters
    ----------
    error : what was raised.
    program : all commands.
    given : the command line.

    Returns
    -------
    ``--filter is 'rde'; …`` for ``filter_name is 'rde'; …``. An argument without an option of its name, or with one as
    its begin or end, as ``duration_s``, keeps its name.
    """
    name, text = getattr(error, "name", None), str(error)
    if not isinstance(name, str) or not text.startswith(f"{name} is "):
        return text
    command = program
    for word in given:
        command = getattr(command, "commands", {}).get(word, command)
    options = {param.name.rstrip("_"): max(param.opts, key=len) for param in command.params if param.opts}
    fitting = [option for own, option in options.items() if own == name]
    # of a target and of its contrast the latter: the longer name says more
    parts = [own for own in options if name.startswith(f"{own}_") or name.endswith(f"_{own}")]
    fitting += [options[own] for own in sorted(parts, key=len, reverse=True)]
    return next((f"{option}{text[len(name) :]}" for option in fitting if option.startswith("--")), text)
