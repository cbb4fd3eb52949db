"""What a command prints: text for people, one JSON object for programs, or nothing (``--json``, ``--quiet``)."""

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hesim_render.cli.exit_status import ExitStatus
from hesim_render.cli.terminal import say
from hesim_render.core.guard import printable
from hesim_render.core.progress import SOON_S, ProgressReport, progress_report, silent_report

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording

#: Options of every command that makes something; `--help-all` shows them.
Json = Annotated[bool, typer.Option("--json", help="print only the result, as one JSON object, on stdout", hidden=True)]
Quiet = Annotated[bool, typer.Option("--quiet", help="print only errors and notes", hidden=True)]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="check everything and print the estimate; write nothing", hidden=True)
]


class OnlyEstimated(Exception):
    """Ends a run at its estimate, before anything is written: ``--dry-run``."""


@dataclass
class Console:
    """How one command speaks.

    Parameters
    ----------
    as_json : one object on stdout at the end, in place of text.
    quiet : no text and no progress.
    dry_run : stop at the estimate.
    """

    as_json: bool = False
    quiet: bool = False
    dry_run: bool = False
    _estimate: dict[str, Any] | None = None

    def progress(self, title: str) -> ProgressReport:
        """A display of the progress, to be used in a with statement."""
        return silent_report() if self.quiet else progress_report(title, first_s=SOON_S if self.dry_run else None)

    def text(self, text: str) -> None:
        """Print a line for people."""
        if text and not (self.quiet or self.as_json):
            say("\n".join(map(printable, text.split("\n"))))

    def estimated(self, progress: ProgressReport) -> Callable[[object], None]:
        """A function that takes the estimate of a run: prints it, keeps it for the result, and ends a dry run."""

        def take(expected: object) -> None:
            self._estimate = facts_of(expected)
            with progress.paused():
                self.text(f"estimate: {expected}")
            if self.dry_run:
                raise OnlyEstimated

        return take

    def result(self, text: str, facts: Mapping[str, Any], status: ExitStatus = ExitStatus.DONE) -> None:
        """Print the result, and end the command where its status is not 0.

        Parameters
        ----------
        text : for people.
        facts : for programs; plain values, mappings and lists of them, or paths.
        status : exit status.
        """
        self.text(text)
        if self.as_json:
            from hesim_render.core.plain import as_plain

            known = {} if self._estimate is None else {"estimate": self._estimate}
            say(json.dumps(as_plain({"status": int(status), **known, **facts}), indent=2))
        if status:
            raise typer.Exit(int(status))

    def stop_at_estimate(self) -> AbstractContextManager[None]:
        """A context that a dry run leaves at its estimate, with that as its result."""
        return _StopAtEstimate(self)


class _StopAtEstimate(AbstractContextManager[None]):
    def __init__(self, console: Console) -> None:
        self._console = console

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is OnlyEstimated:
            self._console.result("nothing was written (--dry-run)", {"dry_run": True})
            raise typer.Exit


def facts_of(expected: object) -> dict[str, Any]:
    """The fields of an estimate, and its text."""
    fields = asdict(expected) if is_dataclass(expected) and not isinstance(expected, type) else {}
    return {"text": str(expected), **fields}


def recording_facts(recording: "Recording") -> dict[str, Any]:
    """A recording for programs: its place, origin, region, counts, times and the error that its render has reached."""
    manifest = recording.manifest
    scene = manifest.get("scene") or {}
    return {
        "recording": recording.path,
        "scene": scene.get("name"),
        "sensor": manifest["sensor"]["name"],
        "seed": manifest["seed"],
        "duration_us": recording.duration_us,
        "roi": manifest["roi"],
        "event_grid": manifest["event_grid"],
        "counts": manifest["counts"],
        "render": manifest["settings"].get("render"),
    }
