"""All commands together, in the order of the help."""

from functools import cache
from typing import Annotated, Any

import typer

from hesim_render import __version__
from hesim_render.cli import (
    benchmark,
    calibrate,
    cube,
    exchange,
    info,
    measure,
    simulate,
    study,
    view,
)
from hesim_render.cli.terminal import say

app = typer.Typer(
    name="hesim-render",
    help="Render a scene, or turn a video, into RAW frames and events of a hybrid event-frame sensor.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        say(f"hesim-render {__version__}")
        raise typer.Exit


@app.callback()
def _app(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


for _command in (
    simulate.simulate, view.view, view.isp, exchange.export, exchange.import_, measure.measure, measure.compare,
    measure.report, cube.cube, study.study, simulate.demo, info.info, info.new,
):  # fmt: skip
    app.command(_command.__name__.rstrip("_"))(_command)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(benchmark.app, name="benchmark")


@cache
def program() -> Any:
    """All commands as one that can be called; building it takes longer than reading a command line."""
    return typer.main.get_command(app)
