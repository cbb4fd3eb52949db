"""Choosing a backend: nothing dangerous is loaded, and a machine without one gets told what to install."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from hesim_render.core import backend
from hesim_render.core.backend import BackendCandidate
from hesim_render.core.errors import BackendError, how_to_install


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """No cached verdicts, no environment of the user's, and the process's own choice left alone."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.delenv(backend.BACKEND_VARIABLE, raising=False)
    # select() sets DRJIT_LIBLLVM_PATH: under monkeypatch it is restored afterwards
    return monkeypatch


def select_anew():
    return backend.select.__wrapped__()


FAKE_LLVM = """
void LLVMGetVersion(unsigned *major, unsigned *minor, unsigned *patch) { *major = %d; *minor = 0; *patch = 7; }
"""


def fake_library(folder, version):
    """A shared library that says it is LLVM `version`, and nothing else."""
    source = folder / f"llvm{version}.c"
    library = folder / f"libLLVM-{version}.so"
    source.write_text(FAKE_LLVM % version if version else "int nothing;")
    done = subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], capture_output=True)
    if done.returncode:
        pytest.skip("no C compiler")
    return library


@pytest.fixture(autouse=True)
def _compiler(request):
    import shutil

    if "fake" in request.node.name and shutil.which("cc") is None:
        pytest.skip("no C compiler")


@pytest.mark.parametrize("version", [15, 16])
def test_fake_llvm_15_and_16_are_turned_away_by_their_version(version, fresh, tmp_path):
    found = backend.probe(BackendCandidate("llvm", "test", str(fake_library(tmp_path, version))))
    assert not found.works and found.version == f"{version}.0.7"
    assert found.reason == f"LLVM {version} is older than 17"


def test_fake_library_without_a_version_is_turned_away(fresh, tmp_path):
    found = backend.probe(BackendCandidate("llvm", "test", str(fake_library(tmp_path, 0))))
    assert not found.works and found.reason == "older than LLVM 16 (no LLVMGetVersion)"


def test_fake_llvm_17_that_cannot_compile_is_turned_away_without_harm(fresh, tmp_path):
    found = backend.probe(BackendCandidate("llvm", "test", str(fake_library(tmp_path, 17))))
    assert not found.works and found.reason


def test_system_libraries_are_17_or_newer_and_newest_first(fresh, tmp_path):
    for name in ("libLLVM-14.so", "libLLVM-15.so.1", "libLLVM.so.16.0", "libLLVM-17.so.1", "libLLVM.so.19.1",
                 "libLLVM-18.so", "libLLVM.so.22.1", "libLLVMSPIRVLib.so.17"):  # fmt: skip
        (tmp_path / name).write_bytes(b"")
    fresh.setattr(backend, "_SYSTEM_FOLDERS", (str(tmp_path),))
    names = [path.name for path in backend._system_libraries()]
    assert names[:4] == ["libLLVM.so.22.1", "libLLVM.so.19.1", "libLLVM-18.so", "libLLVM-17.so.1"]
    assert not [name for name in names if any(old in name for old in ("14", "15", "16"))]


def test_the_extra_s_library_comes_with_those_it_needs_by_their_own_paths(fresh, tmp_path):
    """Its links may be missing: they are made at Python's first start, where that may write."""
    site, lib = tmp_path / "site", tmp_path / "lib"
    info = site / "karellen_llvm_core-17.0.6.0.dist-info"
    info.mkdir(parents=True)
    (lib / "of-the-machine").mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: karellen-llvm-core\nVersion: 17.0.6.0\n")
    real = ["libLTO.so.17", "libLLVM-17.so", "of-the-machine/libc++.so.1.0", "of-the-machine/libc++abi.so.1.0",
            "of-the-machine/libc++.modules.json", "of-the-machine/libunwind.so.1.0"]  # fmt: skip
    links = ["libLLVM.so", "libLLVM-17.0.6.so", "of-the-machine/libc++.so.1"]
    for name in real:
        (lib / name).write_bytes(b"")
    (info / "RECORD").write_text("".join(f"../lib/{name},,\n" for name in real + links))
    fresh.setattr(sys, "path", [str(site)])
    beside = tuple(str(lib / "of-the-machine" / f"{name}.so.1.0") for name in ("libunwind", "libc++abi", "libc++"))
    assert backend._extra_library() == (str(lib / "libLLVM-17.so"), beside)
    (lib / "libLLVM-17.0.6.so").symlink_to("libLLVM-17.so")
    (lib / "of-the-machine" / "libc++.so.1").symlink_to("libc++.so.1.0")
    assert backend._extra_library() == (str(lib / "libLLVM-17.so"), beside)
    (lib / "libLLVM-17.so").rename(lib / "gone")
    assert backend._extra_library() is None
    fresh.setattr(sys, "path", [str(lib)])
    assert backend._extra_library() is None


def test_nonsense_in_the_environment_falls_through(fresh, tmp_path):
    nonsense = tmp_path / "libLLVM-19.so"
    nonsense.write_bytes(b"not a library")
    fresh.setenv("DRJIT_LIBLLVM_PATH", str(nonsense))
    fresh.setenv(backend.BACKEND_VARIABLE, "llvm")
    first = backend.candidates()[0]
    assert first.source == "DRJIT_LIBLLVM_PATH" and not backend.probe(first).works
    chosen = select_anew()
    assert chosen.works and chosen.path != str(nonsense)
    missing = backend.probe(BackendCandidate("llvm", "DRJIT_LIBLLVM_PATH", str(tmp_path / "gone.so")))
    assert not missing.works and missing.reason == "no such file"


def test_the_probe_runs_in_a_child_process(fresh, tmp_path):
    """What the probe does (here: dying) does not happen to us."""
    fresh.setattr(backend, "_PROBE", "import os; os.abort()")
    library = tmp_path / "libLLVM-99.so"
    library.write_bytes(b"")
    found = backend.probe(BackendCandidate("llvm", "test", str(library)))
    assert not found.works and "killed by signal 6" in found.reason


def test_probe_checks_the_kernel_s_result():
    """The figure in the probe, worked out again with NumPy."""
    import numpy as np

    x = np.arange(4096, dtype=np.float32)
    y = np.clip(x, 17, 99) + np.clip(np.rint(x * 0.5), 0, 1023)
    assert f"z[0] == {int(np.minimum(y, 500).sum())}" in backend._PROBE


def test_without_candidates_the_message_says_what_to_install(fresh):
    fresh.setattr(backend, "candidates", list)
    with pytest.raises(BackendError) as caught:
        select_anew()
    text = str(caught.value)
    assert "\n" not in text
    for part in ("no Dr.Jit backend works", "LLVM >= 17", "libllvm19", how_to_install("llvm")):
        assert part in text


def test_failed_candidates_are_named_in_the_message(fresh, tmp_path):
    broken = BackendCandidate("llvm", "system", str(tmp_path / "libLLVM-20.so"))
    fresh.setattr(backend, "candidates", lambda: [broken])
    with pytest.raises(BackendError, match=r"tried LLVM \? \(system: .*libLLVM-20\.so\): no such file"):
        select_anew()


def test_a_verdict_is_cached_by_path_size_and_time(fresh, tmp_path):
    library = tmp_path / "libLLVM-19.so"
    library.write_bytes(b"1")
    probed = []

    def answer(candidate):
        probed.append(candidate.path)
        return BackendCandidate(**{**candidate.__dict__, "works": True, "version": "19.0.0"})

    fresh.setattr(backend, "probe", answer)
    candidate = BackendCandidate("llvm", "system", str(library))
    assert backend._probe_cached(candidate).works and backend._probe_cached(candidate).works
    assert len(probed) == 1
    library.write_bytes(b"22")
    backend._probe_cached(candidate)
    assert len(probed) == 2
    assert len(json.loads(backend._cache_file().read_text())) == 2


def test_unknown_backend_name_is_an_error(fresh):
    fresh.setenv(backend.BACKEND_VARIABLE, "opencl")
    with pytest.raises(BackendError, match="expected 'llvm' or 'cuda'"):
        backend.candidates()


def test_the_chosen_backend_computes():
    types = backend.jit()
    import drjit as dr

    assert dr.sum(dr.arange(types.Float, 101))[0] == 5050
    assert backend.variant() in ("llvm_ad_spectral", "cuda_ad_spectral")
    assert backend.select().works


def test_importing_the_package_loads_neither_drjit_nor_mitsuba():
    code = "import sys, hesim_render; print([m for m in ('drjit', 'mitsuba', 'numpy', 'colour') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_gpu_gets_no_kernels_that_its_compiler_refuses(monkeypatch):
    """CUDA's compiler refuses registers in shared memory for kernels that call functions by table."""
    import drjit as dr

    flag = dr.JitFlag.SpillToSharedMemory
    before = dr.flag(flag)
    try:
        dr.set_flag(flag, True)
        backend.set_compiler_flags()
        assert dr.flag(flag) == (backend.select().backend != "cuda")
        monkeypatch.setattr(backend, "select", lambda: BackendCandidate("cuda", "GPU", ""))
        backend.set_compiler_flags()
        assert not dr.flag(flag)
    finally:
        dr.set_flag(flag, before)


@pytest.mark.parametrize("hint", ["node", "variable", "loader"])
def test_a_gpu_is_probed_wherever_its_driver_shows(fresh, tmp_path, hint):
    """Containers mount the driver where `find_library` does not look."""
    fresh.delenv("DRJIT_LIBCUDA_PATH", raising=False)
    fresh.setattr(backend.ctypes.util, "find_library", lambda name: None)
    fresh.setattr(backend, "_GPU_NODES", (str(tmp_path / "nvidiactl"),))
    assert all(candidate.backend == "llvm" for candidate in backend.candidates())
    if hint == "node":
        (tmp_path / "nvidiactl").touch()
    elif hint == "variable":
        fresh.setenv("DRJIT_LIBCUDA_PATH", "/opt/driver/libcuda.so.1")
    else:
        fresh.setattr(backend.ctypes.util, "find_library", lambda name: f"lib{name}.so.1")
    assert backend.candidates()[0].backend == "cuda"


def test_a_library_that_the_user_named_stays_a_candidate(fresh, tmp_path):
    """After it was chosen, a list of the candidates still has it."""
    library = fake_library(tmp_path, 17)
    fresh.setenv("DRJIT_LIBLLVM_PATH", str(library))
    fresh.setattr(backend, "_chosen_here", "")
    fresh.setattr(backend, "_probe_cached", lambda candidate: replace(candidate, version="17", works=True))
    fresh.setattr(backend, "_adopt", lambda chosen: chosen)
    assert select_anew().path == str(library)
    assert (str(library), "DRJIT_LIBLLVM_PATH") in [(c.path, c.source) for c in backend.candidates()]
