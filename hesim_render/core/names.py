"""Names that become files or folders: one checked type for all names that come from files of others."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from hesim_render.core.errors import SpecError

#: Room for endings and for the names of temporary files; file systems take 255.
_LONGEST_BYTES = 180
#: Characters that separate folders, here or elsewhere, or a name from what follows it in a message.
_SEPARATORS = frozenset("/\\:")
_EXPECTED = (
    f"the name of a file or folder: one line of 1 to {_LONGEST_BYTES} bytes, that has no '/', '\\' or ':' and does not "
    "begin with '.'"
)


def file_name(text: str) -> str:
    """The text, if it can be the name of a file or a folder, and of none outside of the folder that it is joined to.

    Raises
    ------
    ValueError
        If it cannot.
    """
    is_plain = text.isprintable() and text.strip() == text and not _SEPARATORS & set(text)
    if not text or not is_plain or text.startswith(".") or len(text.encode()) > _LONGEST_BYTES:
        raise ValueError(f"{text[:60]!r} is not {_EXPECTED}")
    return text


def path_below(text: str) -> str:
    """The text, if it is the path of a file below a folder: names (`file_name`) with ``/`` between them.

    Raises
    ------
    ValueError
        If it is not.
    """
    for part in text.split("/"):
        file_name(part)
    return text


#: Types of keys in files.
FileName = Annotated[str, AfterValidator(file_name)]
PathBelow = Annotated[str, AfterValidator(path_below)]


def require_file_name(text: str, file: str | Path) -> str:
    """`file_name`, for a name that is not part of a model.

    Parameters
    ----------
    text : the name.
    file : where it stands, for the error.

    Raises
    ------
    SpecError
        If it cannot be the name of a file.
    """
    try:
        return file_name(text)
    except ValueError as error:
        raise SpecError(str(error), file=file) from None
