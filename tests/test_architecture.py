"""Imports point down only, and one package alone knows Mitsuba."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "hesim_render"

# lowest first; a module may import its own layer and those below. Names are modules or packages.
LAYERS = [
    {"errors", "units", "rng", "backend", "progress", "spectra", "colorimetry", "events", "frame", "output"}
    | {"guard", "npzfile", "bands", "transfer", "waveform", "render_error"},
    {"specs"},
    {"optics", "layout", "noise"},
    {"sensor", "flux", "crosstalk", "mosaic", "camera", "schedule"},
    {"radiometry", "scene", "flicker", "renderer", "video"},
    {"aps", "evs"},
    {"capture"},
    {"eventfile", "dng", "preview", "manifest", "recording_spec", "showcase", "recording"},
    {"simulation", "video_simulation", "calibrate", "bench", "lab", "isp"},
    {"cli", "terminal"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def modules():
    return sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def name_of(path):
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path):
    """Dotted names imported anywhere in a module but under TYPE_CHECKING."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing_only = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "hesim_render":
                yield from (f"hesim_render.{alias.name}" for alias in node.names)
            else:
                yield node.module or ""


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down_only(path):
    own = name_of(path)
    assert own in LEVEL, f"{own} has no place in the house yet: add it to LAYERS"
    for name in imports(path):
        if not name.startswith("hesim_render."):
            continue
        other = name.split(".")[1]
        if other.startswith("__") or other == own:
            continue
        if not (PACKAGE / other).exists() and not (PACKAGE / f"{other}.py").exists():
            continue  # a name of the package's face, such as load_sensor, only imported by the command line
        assert LEVEL[other] <= LEVEL[own], f"{own} imports {other}, which is above it"


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_the_renderer_imports_mitsuba(path):
    if name_of(path) != "renderer":
        assert not [name for name in imports(path) if name.split(".")[0] == "mitsuba"]


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_picks_a_drjit_backend_itself(path):
    """`hesim_render.backend.jit` probes the library first; importing drjit.llvm directly may abort the process."""
    chosen = [name for name in imports(path) if name.startswith(("drjit.llvm", "drjit.cuda"))]
    assert not chosen


def test_importing_the_package_loads_nothing_heavy():
    """Dr.Jit above all: it takes an LLVM when it is imported, and the choice must come first."""
    heavy = ("drjit", "mitsuba", "numpy", "scipy", "colour", "pydantic", "rich")
    code = f"import sys, hesim_render; print([name for name in {heavy} if name in sys.modules])"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "[]"


def test_layers_name_what_exists_once():
    names = [name for layer in LAYERS for name in layer]
    assert len(names) == len(set(names))


def test_calibration_runs_without_renderer_and_simulators():
    """It must run on captures of real sensors."""
    simulators = {"renderer", "scene", "flux", "capture", "simulation", "aps", "evs"}
    for path in (PACKAGE / "calibrate").rglob("*.py"):
        used = {name.split(".")[1] for name in imports(path) if name.startswith("hesim_render.")}
        assert not used & simulators, path
