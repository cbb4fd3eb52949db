"""More of what is damaged: surfaces, lenses, data sheets, studies, hyperspectral cubes and benchmarks."""

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import h5py
import numpy as np
import scipy.io
from PIL import Image

import hesim_render as hr
from benchmarks import SMALL

_SHIPPED = Path(__file__).parents[2]
_BANDS = np.arange(400.0, 701.0, 10.0)


def surfaces(folder):
    """Pictures and materials on objects, an environment map, and a track with a parent."""
    from hesim_render.sources.render.scene.mitsuba_version import files_readable, mitsuba

    rng = np.random.default_rng(6)
    Image.fromarray(rng.integers(0, 255, (8, 8, 3), dtype=np.uint8)).save(folder / "t.png")
    np.save(folder / "cube.npy", rng.random((4, 6, 5), dtype=np.float32))
    mi = mitsuba()
    with files_readable():
        mi.Bitmap(rng.random((4, 8, 3), dtype=np.float32)).write(str(folder / "sky.exr"))
    (folder / "curve.csv").write_text("360,0.4\n830,0.5\n")
    (folder / "s.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: d\nobjects:\n"
        "  - {name: a, shape: sphere, size_m: [0.1, 0.1, 0.1], texture: {file: t.png, repeat: [2, 3]}}\n"
        "  - {name: b, shape: box, texture: {file: cube.npy, wavelength_nm: [400, 475, 550, 625, 700], beyond: hold}}\n"
        "  - {name: c, shape: rectangle, size_m: [1, 1, 0], position_m: [0, 0, -0.2],\n"
        "     material: {type: roughplastic, alpha: 0.1, diffuse_reflectance: curve.csv}}\n"
        "  - {name: d, shape: sphere, size_m: [0.1, 0.1, 0.1], position_m: [0, 0.3, 0],\n"
        "     emission: {luminance_cd_m2: 10, waveform: {type: pwm, frequency_hz: 100, duty: 0.5}}}\n"
        "motion:\n  - object: a\n    keyframes:\n      - {t_us: 0}\n      - {t_us: 900, rotation_deg: 90}\n"
        "  - object: b\n    parent: a\n    repeat: true\n    keyframes:\n      - {t_us: 0}\n"
        "      - {t_us: 500, rotation_axis: [1, 0, 0], rotation_deg: 360}\n"
        "light: {type: environment, file: sky.exr, illuminance_lux: 100, rotation_deg: 20}\n"
        "camera: {origin_m: [0, 0, 2]}\n"
    )


def lens(folder):
    """A sensor with all effects of the lens and a measured PSF, and one from a data sheet."""
    kernel = np.zeros((3, 5, 5))
    kernel[:, 1:4, 1:4] = 1 / 9
    np.save(folder / "psf.npy", kernel)
    text = (_SHIPPED / "sensors" / "reference-mono.yaml").read_text()
    begin, end = text.index("lens:"), text.index("\naps:")
    own = (
        "lens:\n  f_number: 4.0\n  focal_length_mm: 16.0\n  relative_illumination: cos4\n"
        "  distortion: {model: opencv, k1: -0.2, k2: 0.05, p1: 0.001}\n  depth_of_field: true\n  diffraction: true\n"
        "  psf: {type: measured, file: psf.npy, sample_um: 2.5, image_height_mm: [0, 1.5, 3]}\n"
        "  lateral_chromatic: {wavelength_nm: [400, 550, 700], magnification_rel: [0.0005, 0, -0.0005]}\n"
        "  veiling_glare: 0.02\n"
    )
    (folder / "s.yaml").write_text(text[:begin] + own + text[end:])
    shutil.copy(_SHIPPED / "sensors" / "imx636.yaml", folder / "sheet.yaml")


def use_lens(folder):
    from hesim_render.sources.render.projection import Projection

    made = hr.load_sensor(folder / "s.yaml")
    Projection.of(made).unproject([[0.0, 0.0], [10.0, 20.0]])
    sheet = hr.load_sensor(folder / "sheet.yaml")
    if sheet.spec.evs is not None and sheet.spec.geometry.rows > 8 and sheet.spec.geometry.cols > 8:
        _ = sheet.crop(8, 8).evs.threshold_on_map


def studies(folder):
    for kind, name in (("study", "five-cfas"), ("design", "rggb-dyes"), ("sweep", "light-and-exposure")):
        shutil.copy(_SHIPPED / "studies" / f"{name}.yaml", folder / f"{kind}.yaml")
    shutil.copy(_SHIPPED / "studies" / "filter_sets" / "rccb.yaml", folder / "set.yaml")
    shutil.copy(_SHIPPED / "studies" / "palettes" / "dyes.yaml", folder / "palette.yaml")


def read_studies(folder):
    from hesim_render.specs.design import DesignSpec
    from hesim_render.specs.files import read_spec
    from hesim_render.specs.filter_set import FilterSetSpec, PaletteSpec
    from hesim_render.specs.study import StudySpec
    from hesim_render.specs.sweep import SweepSpec

    for model, name in (
        (StudySpec, "study"), (DesignSpec, "design"), (SweepSpec, "sweep"), (FilterSetSpec, "set"),
        (PaletteSpec, "palette"),
    ):  # fmt: skip
        read_spec(model, folder / f"{name}.yaml")


def cubes(folder):
    from spectral.io import envi

    rng = np.random.default_rng(7)
    cube = rng.random((7, 5, 31), dtype=np.float32)
    header = {"wavelength": _BANDS.tolist(), "wavelength units": "nm"}
    envi.save_image(str(folder / "a.hdr"), cube, metadata=header, dtype=np.float32)
    scipy.io.savemat(folder / "b.mat", {"ref": cube.astype(float), "lbl": np.ones((7, 5))})
    with h5py.File(folder / "c.mat", "w") as file:
        file["cube"], file["bands"] = cube.transpose(2, 1, 0), _BANDS[None]


def read_cubes(folder):
    from hesim_render.targets.cube_file import open_cube

    for name in ("a.hdr", "b.mat", "c.mat"):
        found = open_cube(folder / name)
        assert found.whole().shape == found.shape


def benchmark(folder):
    (folder / "b.yaml").write_text(json.dumps(SMALL, indent=1))


def read_plan(folder):
    from hesim_render.benchmark.plan import BenchmarkPlan
    from hesim_render.specs.benchmark import read_benchmark

    for clip in BenchmarkPlan(read_benchmark(folder / "b.yaml")).clips:
        assert clip.name


def built(folder):
    """A benchmark of two clips; names in its files become folders, files and members of shards."""
    from hesim_render.benchmark import build_benchmark
    from hesim_render.specs.benchmark import BenchmarkSpec

    given = [{"scene": "flat-field", "split": "train"}, {"scene": "checkerboard", "split": "test"}]
    changes = {"scenes": {"given": given}, "truth": [], "sharp": None, "audit": 0}
    sensors = [{"sensor": "reference-mono", "roi": "8x6"}]
    spec = BenchmarkSpec.model_validate({**SMALL, **changes, "sensors": sensors})
    build_benchmark(spec, folder / "b", workers=0, estimate=False)


def use_built(folder):
    """Verify, discard, pack and export a copy; beside it nothing may appear, change or vanish."""
    from hesim_render.benchmark.layouts import export_benchmark
    from hesim_render.benchmark.shards import pack_benchmark
    from hesim_render.benchmark.verify import discard_damaged, verify_benchmark

    with tempfile.TemporaryDirectory() as other:
        place = Path(other)
        (place / "mine").mkdir()
        (place / "mine" / "thesis").write_text("years")
        root = place / "in" / "b"
        root.parent.mkdir()
        subprocess.run(["cp", "-a", folder / "b", root], check=True)  # pipes and links as well
        (root / "clips" / "mine").mkdir()
        (root / "clips" / "mine" / "notes").touch()
        try:
            pack_benchmark(root, place / "out" / "shards")
            export_benchmark(root, "raw-npz", place / "out" / "raw")
            discard_damaged(root, verify_benchmark(root))
        finally:
            assert (place / "mine" / "thesis").read_text() == "years" and (root / "clips" / "mine" / "notes").is_file()
            assert {path.name for path in place.iterdir()} <= {"mine", "in", "out"}
            assert {path.name for path in (place / "in").iterdir()} == {"b"}
            assert {path.name for path in place.glob("out/*")} <= {"shards", "raw"}


def shards(folder):
    from hesim_render.benchmark.shards import pack_benchmark

    built(folder)
    pack_benchmark(folder / "b", folder / "s")


def verify_packed(folder):
    from hesim_render.benchmark.shards import verify_shards

    verify_shards(folder / "s")


def run_file(folder):
    (folder / "r.yaml").write_text(
        "schema_version: 1\nname: r\nscene: flat-field\nsensor: eiger\nroi: 8x8\nduration_s: 0.002\nsamples: 2\n"
        "export:\n  - {format: evt3, out: events.raw}\n  - {format: tiff, out: frames}\n"
    )


def read_run(folder):
    from hesim_render.specs.files import read_spec
    from hesim_render.specs.run import RunSpec

    for step in read_spec(RunSpec, folder / "r.yaml").export:
        assert (folder / step.out).resolve().parent == folder.resolve()
