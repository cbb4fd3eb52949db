"""All errors that a user can cause, one class per kind of cause.

The command line prints the message of a `HesimError` on one line and exits with status 2.
Any other exception that escapes is a bug of this package and keeps its traceback.
"""

import re
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path


def closest(given: str, known: Iterable[str]) -> str | None:
    """The known name that is most similar to an unknown one; None if no name is similar.

    A name that the given one begins, as ``illuminance_lux`` by ``illuminance``, comes first: only its unit is missing.
    A name that has the given one as a word, as ``horizontal_fov_deg`` has ``fov``, comes last, if there is one alone.
    """
    import difflib

    names = sorted(known)
    begun = [name for name in names if name.startswith(f"{given}_")]
    holding = [name for name in names if given in name.split("_")]
    similar = begun or difflib.get_close_matches(given, names, n=1)
    return next(iter(similar or (holding if len(holding) == 1 else [])), None)


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Text to append to a message about an unknown name."""
    result = closest(given, known)
    return f" (did you mean {result!r}?)" if result is not None else ""


class HesimError(Exception):
    """Base of all errors with a message meant for the user.

    Examples
    --------
    >>> import hesim_render as hr
    >>> try:
    ...     hr.load_sensor("eiger").crop(3, 4)
    ... except hr.HesimError as error:
    ...     print(error)
    roi width_px is 3; expected a multiple of the tile's 4 pixels
    """


class HesimWarning(UserWarning):
    """A warning about input that is probably a mistake, but may be intended.

    Examples
    --------
    Turn such warnings into errors in a script that nobody watches:

    >>> import warnings
    >>> import hesim_render as hr
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", hr.HesimWarning)
    ...     sensor = hr.load_sensor("davis346")
    """


class SpecError(HesimError, ValueError):
    """A sensor file, scene file, spectrum or override is wrong.

    Parameters
    ----------
    message : what is wrong and what was expected.
    file : the file, if there is one.
    line : 1-based line in that file, if known.
    key : dotted key inside the file (``aps.read_noise_e``), if known.

    Attributes
    ----------
    problems : all errors of the file, if there are several; `file`, `line` and `key` belong to the first.
    """

    problems: "tuple[SpecError, ...]" = ()

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        key: str | None = None,
    ) -> None:
        self.file, self.line, self.key = file, line, key
        where = str(file) if file is not None else ""
        if where and line is not None:
            where += f":{line}"
        parts = [part for part in (where, key) if part]
        super().__init__(": ".join([*parts, message]))

    @classmethod
    def together(cls, problems: "Sequence[SpecError]") -> "SpecError":
        """One error for all problems of a file, one per line; a single problem is returned unchanged."""
        if len(problems) == 1:
            return problems[0]
        joined = cls("\n".join(map(str, problems)))
        first = problems[0]
        joined.file, joined.line, joined.key, joined.problems = first.file, first.line, first.key, tuple(problems)
        return joined


class RangeError(HesimError, ValueError):
    """An argument lies outside the range in which the model is valid."""

    def __init__(self, name: str, value: object, expected: str) -> None:
        self.name, self.value, self.expected = name, value, expected
        super().__init__(f"{name} is {value!r}; expected {expected}")


class ConflictError(RangeError):
    """Arguments that exclude each other were given together, or one without another that it requires."""

    def __init__(self, name: str, value: object, message: str) -> None:
        self.name, self.value = name, value
        HesimError.__init__(self, message)


class TooLongError(ConflictError):
    """A run would take longer than allowed; the message states the time and ways to reduce it."""


class BackendError(HesimError, RuntimeError):
    """No Dr.Jit backend can run here; the message says what to install."""


class OutputError(HesimError, OSError):
    """A result could not be written. No partial output is left behind."""


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, by their own names: this works without a release as well.

    Parameters
    ----------
    extra : name of the extra in ``pyproject.toml``.
    """
    try:
        stated = requires("hesim_render") or []
    except PackageNotFoundError:  # run from a source tree that was never installed
        stated = []
    own = re.compile(rf"""extra\s*==\s*["']{re.escape(extra)}["']""")
    result = [line.partition(";")[0].strip() for line in stated if own.search(line)]
    packages = [re.sub(r"^([\w.-]+(?:\[[^\]]*\])?)\s*\(?([^)]*)\)?$", r"\1\2", text) for text in result] or [
        f".[{extra}]"
    ]
    return "pip install " + " ".join(f"'{name}'" for name in packages)
