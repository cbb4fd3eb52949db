"""Which Dr.Jit backend runs here: a GPU where one works, else LLVM on the CPU.

LLVM 15 and 16 abort the whole process on CPUs with AVX-512, so no library is ever loaded into
this process before a child process has compiled and run a kernel with it. Candidates, in order:

1. ``DRJIT_LIBLLVM_PATH``, if set;
2. the system's ``libLLVM``, version 17 or newer, newest first;
3. the library of the optional ``llvm`` extra (LLVM 17.0.6, from the wheel `EXTRA`).

Dr.Jit loads its LLVM the moment it is imported, so `hesim_render` prepares the choice when it is
imported itself (`prepare`). The verdict on a library is cached by path, size and modification time.
"""

import contextlib
import ctypes
import ctypes.util
import functools
import importlib
import importlib.metadata
import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hesim_render.core.child import child_environment, interrupts_held, python_command
from hesim_render.core.errors import BackendError, how_to_install

OLDEST_LLVM = 17
BACKEND_VARIABLE = "HESIM_RENDER_BACKEND"  # "llvm" or "cuda" forces one
EXTRA = "karellen-llvm-core"
#: Libraries beside that of the extra, in the order in which they need one another. They are loaded by their own paths:
#: the links by which libLLVM finds them are made at Python's first start, and only where that may write.
_BESIDE_EXTRA = ("libunwind", "libc++abi", "libc++")

#: The value that this process itself wrote into DRJIT_LIBLLVM_PATH, as opposed to a choice of the user.
_chosen_here = ""

#: Device nodes of NVIDIA's driver, on Linux and on Windows' Linux.
_GPU_NODES = ("/dev/nvidiactl", "/dev/dxg")

_SYSTEM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
    "/opt/homebrew/opt/llvm*/lib",
)

# Runs in a child process: argv = backend, library, preloads... Compiles a kernel with vector
# minimum and maximum, the very instructions that LLVM 15 and 16 fail to select on AVX-512.
_PROBE = """
import ctypes, os, sys
backend, library, *preload = sys.argv[1:]
if backend == "llvm":
    for name in preload:
        ctypes.CDLL(name)
    handle = ctypes.CDLL(library)
    try:
        version = (ctypes.c_uint * 3)()
        handle.LLVMGetVersion(*[ctypes.byref(version, 4 * k) for k in range(3)])
    except AttributeError:
        sys.exit("older than LLVM 16 (no LLVMGetVersion)")
    print(".".join(map(str, version)), flush=True)
    if version[0] < %d:
        sys.exit(f"LLVM {version[0]} is older than %d")
    os.environ["DRJIT_LIBLLVM_PATH"] = library
    import drjit.llvm as types
else:
    import drjit.cuda as types
    print("GPU", flush=True)
import drjit as dr
x = dr.arange(types.Float, 4096)
y = dr.minimum(dr.maximum(x, 17), 99) + dr.clip(dr.round(x * 0.5), 0, 1023)
z = dr.sum(dr.minimum(types.UInt32(y), 500))
assert z[0] == 1882201, z
print("ok")
""" % (OLDEST_LLVM, OLDEST_LLVM)


@dataclass(frozen=True)
class BackendCandidate:
    """One library (or the GPU) and the result of its probe."""

    backend: str  # "llvm" or "cuda"
    source: str  # how it was found
    path: str
    preload: tuple[str, ...] = ()
    version: str = ""
    works: bool = False
    reason: str = ""

    @property
    def label(self) -> str:
        """Kind and version, which decide the bits; where the library lies does not."""
        return "CUDA" if self.backend == "cuda" else f"LLVM {self.version or '?'}"

    def describe(self) -> str:
        return f"{self.label} ({self.source}: {self.path})" if self.path else f"{self.label} ({self.source})"


def _major(path: Path) -> int:
    """Major version in a libLLVM file name, 0 where it has none."""
    match = re.search(r"libLLVM[-.](?:so\.)?(\d+)", path.name)
    return int(match.group(1)) if match else 0


def _system_libraries() -> list[Path]:
    folders: list[Path] = []
    for pattern in _SYSTEM_FOLDERS:
        root = Path("/")
        folders += sorted(root.glob(pattern.lstrip("/")))
    libraries: dict[str, Path] = {}
    for folder in folders:
        for path in list(folder.glob("libLLVM[-.]*so*")) + list(folder.glob("libLLVM*.dylib")):
            if _major(path) >= OLDEST_LLVM:
                libraries.setdefault(os.path.realpath(path), path)
    return sorted(libraries.values(), key=_major, reverse=True)


def _extra_library() -> tuple[str, tuple[str, ...]] | None:
    """libLLVM of the ``llvm`` extra, and the libraries that must be loaded before it."""
    try:
        files = importlib.metadata.files(EXTRA) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    paths = [Path(str(file.locate())).resolve() for file in files if ".so" in file.name]
    libraries = sorted({path for path in paths if _major(path) >= OLDEST_LLVM and path.is_file()}, key=_major)
    if not libraries:
        return None
    beside = [sorted({p for p in paths if p.name.startswith(f"{stem}.so.") and p.is_file()}) for stem in _BESIDE_EXTRA]
    return str(libraries[-1]), tuple(str(result[0]) for result in beside if result)


def candidates() -> list[BackendCandidate]:
    """Everything that could run Dr.Jit here, best first; nothing has been loaded yet."""
    forced = os.environ.get(BACKEND_VARIABLE, "").lower()
    if forced not in ("", "llvm", "cuda"):
        raise BackendError(f"{BACKEND_VARIABLE} is {forced!r}; expected 'llvm' or 'cuda'")
    listed: list[BackendCandidate] = []
    if forced != "llvm" and _has_cuda():
        listed.append(BackendCandidate("cuda", "GPU", ""))
    if forced != "cuda":
        given = os.environ.get("DRJIT_LIBLLVM_PATH")
        extra = _extra_library()
        if given and given != _chosen_here:
            preload = extra[1] if extra and given == extra[0] else ()  # inherited from a parent that chose it
            listed.append(BackendCandidate("llvm", "DRJIT_LIBLLVM_PATH", given, preload))
        listed += [BackendCandidate("llvm", "system", str(path)) for path in _system_libraries()]
        if extra:
            listed.append(BackendCandidate("llvm", "'llvm' extra", extra[0], extra[1]))
    return listed


def _has_cuda() -> bool:
    """Whether a GPU is worth a probe: its driver is named, runs, or is where the loader looks by itself."""
    # containers often mount the driver where only LD_LIBRARY_PATH leads, which `find_library` does not search
    if os.environ.get("DRJIT_LIBCUDA_PATH") or any(os.path.exists(node) for node in _GPU_NODES):
        return True
    try:
        return ctypes.util.find_library("cuda") is not None
    except OSError:  # it may write a temporary file, for which there may be no place
        return False


def _cache_file() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root) / "hesim_render" / "backend.json"


def _cache_key(candidate: BackendCandidate) -> str | None:
    """Everything a verdict depends on, as a key; None if it cannot be determined, so that the verdict is not cached."""
    try:
        if candidate.backend == "cuda":
            devices = ",".join(sorted(str(path) for path in Path("/dev").glob("nvidia*")))
            identity = Path("/proc/driver/nvidia/version").read_text() + devices
        else:
            stat = os.stat(candidate.path)
            identity = f"{candidate.path}|{stat.st_size}|{stat.st_mtime_ns}"
    except OSError:
        return None
    drjit = importlib.util.find_spec("drjit")
    return "|".join((candidate.backend, identity, str(drjit.origin if drjit else ""), sys.version))


def probe(candidate: BackendCandidate) -> BackendCandidate:
    """Run a kernel with `candidate` in a child process, and return the candidate with the result."""
    if candidate.path and not os.path.exists(candidate.path):
        return BackendCandidate(**{**candidate.__dict__, "reason": "no such file"})
    command = python_command(_PROBE, candidate.backend, candidate.path, *candidate.preload)
    environment = {k: v for k, v in child_environment().items() if k != "DRJIT_LIBLLVM_PATH"}
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    except (OSError, subprocess.TimeoutExpired) as error:
        return BackendCandidate(**{**candidate.__dict__, "reason": f"probe did not finish: {error}"})
    lines = child.stdout.split()
    version = lines[0] if lines else ""
    works = child.returncode == 0 and lines[-1:] == ["ok"]
    reason = ""
    if not works:
        last = (child.stderr.strip().splitlines() or [""])[-1]
        died = f"killed by signal {-child.returncode}" if child.returncode < 0 else ""
        reason = "; ".join(part for part in (died, last) if part) or f"exit status {child.returncode}"
    return BackendCandidate(**{**candidate.__dict__, "version": version, "works": works, "reason": reason})


def _probe_cached(candidate: BackendCandidate) -> BackendCandidate:
    """As `probe`, remembering libraries that worked (a failure is always tried again)."""
    key = _cache_key(candidate)
    file = _cache_file()
    try:
        cache = json.loads(file.read_text())
    except (OSError, ValueError):
        cache = {}
    if key is not None and key in cache:
        return BackendCandidate(**{**candidate.__dict__, "version": cache[key], "works": True})
    result = probe(candidate)
    if result.works and key is not None:
        cache[key] = result.version
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary = file.with_suffix(f".{os.getpid()}.tmp")
            temporary.write_text(json.dumps(cache))
            os.replace(temporary, file)
        except OSError:
            pass  # an unwritable cache costs a second per start, nothing else
    return result


def _loaded_llvm() -> list[str]:
    """LLVM libraries in this process (Linux)."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return []
    return sorted({line.split(maxsplit=5)[5] for line in lines if "libLLVM" in line})


def _adopt(chosen: BackendCandidate) -> BackendCandidate:
    """Set up the chosen library; if Dr.Jit was imported before, check that it took a working one."""
    if chosen.backend == "cuda" or "drjit" not in sys.modules:
        return chosen
    loaded = _loaded_llvm()
    if any(os.path.realpath(path) == os.path.realpath(chosen.path) for path in loaded):
        return chosen
    early = [_probe_cached(BackendCandidate("llvm", "taken by Dr.Jit", path)) for path in loaded]
    if early and all(candidate.works for candidate in early):
        return early[0]
    took = f"took {early[0].describe()}, which does not work ({early[0].reason})" if early else "found no LLVM"
    raise BackendError(
        f"Dr.Jit was imported before hesim_render and {took}: import hesim_render first, "
        f"or set DRJIT_LIBLLVM_PATH={chosen.path}"
    )


def install_hint() -> str:
    """What to do on a machine where no backend works."""
    return (
        "install LLVM >= 17, either with the system's package manager (Debian 12+, Ubuntu 24.04+: "
        f"'sudo apt install libllvm19') or without root: {how_to_install('llvm')}"
    )


@functools.cache
def select() -> BackendCandidate:
    """First candidate that works; its library is set up for Dr.Jit in this process.

    Raises
    ------
    BackendError
        If none works; the message lists what was tried and what to install. Also if Dr.Jit was
        imported earlier and took a library that does not work.
    """
    global _chosen_here
    tried: list[str] = []
    for candidate in candidates():
        result = _probe_cached(candidate)
        if not result.works:
            tried.append(f"{result.describe()}: {result.reason}")
            continue
        result = _adopt(result)
        if result.backend == "llvm":
            for name in result.preload:
                ctypes.CDLL(name)  # local: libc++ must not serve libraries that were built with libstdc++
            if result.path != os.environ.get("DRJIT_LIBLLVM_PATH"):  # what the user wrote there remains the user's
                _chosen_here = result.path
            os.environ["DRJIT_LIBLLVM_PATH"] = result.path
        return result
    detail = f" (tried {'; '.join(tried)})" if tried else ""
    raise BackendError(f"no Dr.Jit backend works on this machine{detail}: {install_hint()}")


def prepare() -> None:
    """Select silently, before anything imports Dr.Jit. Errors are reported when the backend is first needed."""
    if "drjit" not in sys.modules:
        with contextlib.suppress(BackendError):
            select()


def variant() -> str:
    """Mitsuba variant that belongs to the selected backend."""
    return f"{select().backend}_ad_spectral"


@functools.cache
def jit() -> Any:
    """Module with the Dr.Jit array types of the selected backend (``drjit.llvm.ad`` or ``drjit.cuda.ad``)."""
    with interrupts_held():
        types = importlib.import_module(f"drjit.{select().backend}.ad")
        set_compiler_flags()
        return types


def set_compiler_flags() -> None:
    """Turn off what the compiler of the selected backend cannot do; for the calling thread, as all flags of Dr.Jit.

    Dr.Jit 1.5 lets CUDA's compiler keep registers in shared memory. That compiler refuses this for kernels that call
    functions by table, and Dr.Jit then ends the process.
    """
    if select().backend == "cuda":
        drjit = importlib.import_module("drjit")
        drjit.set_flag(drjit.JitFlag.SpillToSharedMemory, False)
