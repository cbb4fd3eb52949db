"""Which GPU a worker uses: each process on a machine takes one of its own, as long as there are enough."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Mapping, MutableMapping
from pathlib import Path

VISIBLE = "CUDA_VISIBLE_DEVICES"
_NVIDIA = Path("/proc/driver/nvidia/gpus")
#: Locks that this process holds, for as long as it lives.
_held: list[int] = []


def devices_of(environment: Mapping[str, str], gpus: Path = _NVIDIA) -> list[str]:
    """Names of the GPUs that a process may use: those that the environment lists, else all of the machine.

    Parameters
    ----------
    environment : with ``CUDA_VISIBLE_DEVICES``, where that is set.
    gpus : folder in which the driver has an entry for each GPU.
    """
    given = environment.get(VISIBLE)
    if given is not None:
        return [name.strip() for name in given.split(",") if name.strip()]
    return [str(k) for k in range(len(list(gpus.iterdir())))] if gpus.is_dir() else []


def claim_device(
    environment: MutableMapping[str, str] = os.environ, gpus: Path = _NVIDIA, locks: Path | None = None
) -> str | None:
    """Take a GPU that no other worker of this machine has, and make it the only visible one.

    It must be called before anything has looked for GPUs. A lock on a file marks a GPU as taken and ends with the
    process, however it ends. Where all are taken, processes share them evenly by their numbers.

    Parameters
    ----------
    environment : in which the GPU is set.
    gpus : see `devices_of`.
    locks : folder of the lock files; default the system's temporary one.

    Returns
    -------
    Name of the GPU; None where there is none or only one.
    """
    devices = devices_of(environment, gpus)
    if len(devices) < 2:
        return None
    folder = locks or Path(tempfile.gettempdir())
    chosen = devices[os.getpid() % len(devices)]
    for device in devices:
        name = "".join(c if c.isalnum() else "-" for c in device)
        try:
            handle = os.open(folder / f"hesim_render-{os.getuid()}-gpu-{name}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        except OSError:
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            continue
        _held.append(handle)
        chosen = device
        break
    environment[VISIBLE] = chosen
    return chosen
