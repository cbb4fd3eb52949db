"""What stands in the place of a file: each of these must cost one clear error, or be read as what it is."""

import os
import shutil

#: Names of the kinds.
PLACES = ("pipe", "device", "folder", "nowhere", "large")
#: Subjects whose files may be of any size, and are read or hashed to their end.
LONG = ("video", "exchange", "calibration", "built", "shards")
#: Size of a file of which the end is not stored; no reader may take so much memory.
_LARGE = 6 << 30


def put(kind, file):
    """Replace a file, which `put_back` restores."""
    if kind == "large":
        os.truncate(file, _LARGE)
        return
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    elif kind == "folder":
        file.mkdir()
    else:
        file.symlink_to("nowhere")


def put_back(file, whole):
    """Remove what is there, and write the file as it was."""
    if file.is_dir() and not file.is_symlink():
        shutil.rmtree(file)
    elif file.is_symlink() or file.exists():
        file.unlink()
    file.write_bytes(whole)
