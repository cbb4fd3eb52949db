"""What keys of a file must be relative to each other: the last value that is right and the first that is not."""

import pytest
from pydantic import ValidationError

from hesim_render.core.errors import SpecError
from hesim_render.sensor.reading import read_sensor
from hesim_render.sources.video.options import VideoOptions
from hesim_render.specs.benchmark import BenchmarkSpec, MaterialShares, NoiseLevel, SharpSpec, SplitShares
from hesim_render.specs.boards import CharucoTarget, CircleGridTarget, LedGridTarget
from hesim_render.specs.capture import CaptureSpec
from hesim_render.specs.charts import DeadLeavesTarget, GreyRampTarget, IntegratingSphereTarget, StepWedgeTarget
from hesim_render.specs.data_sheet import DataSheetSpec, SpeedSpec
from hesim_render.specs.event_bench import Modulation, Steady
from hesim_render.specs.event_pixels import PhotoreceptorSpec
from hesim_render.specs.geometry import Region
from hesim_render.specs.lens import IlluminationTable, MeasuredPsf
from hesim_render.specs.light import LightSpec, TableWaveformSpec
from hesim_render.specs.mitsuba_scene import MitsubaSpec
from hesim_render.specs.motion import DeformationSpec, KeyframeSpec, TrackSpec
from hesim_render.specs.scene import CameraSpec, ObjectSpec, SceneSpec
from hesim_render.specs.spectrum import DyeSpec, SpectrumSpec
from hesim_render.specs.study import SurfacesSpec
from hesim_render.specs.sweep import RangeSpec

BURST = {"begin_us": 0, "length_us": 160_000, "period_us": 160_001}
MODULATION = {"file": "a.raw", "lux": 30.0, "hz": 25.0, "depth": 0.4, "bursts": BURST}
LEAVES = {"type": "dead-leaves", "width_m": 0.256, "radius_min_m": 0.002, "texels_across": 128}
TABLE = {"type": "table", "value": [3.0, 4.0]}
PSF = {"type": "measured", "sample_um": 0.7, "image_height_mm": [0.0], "kernels": [[[0.0, 0.5, 0.5009]]]}
CORNER = {"cutoff_hz": 70.0, "min_cutoff_hz": 70.0, "signal_dn": 3.0, "follows_light": True}
SMALL = {
    "schema_version": 1,
    "name": "a",
    "description": "",
    "scenes": {"count": 1000},
    "sensors": [{"sensor": "eiger"}],
}
NO_MATERIAL = dict.fromkeys(("diffuse", "plastic", "rough_plastic", "metal"), 0.0)
CAPTURE = {"bit_depth": 10, "tile_rows": 2, "tile_cols": 4}
FIRM = {"cutoff_hz": 70.0, "follows_light": False}
DIM, LIT = {"rate_hz": 3.1, "lux": 0.5}, {"rate_hz": 1.7, "lux": 200.0}
SLOW, QUICK = {"lux": 5.0, "latency_us": 900.0}, {"lux": 1000.0, "latency_us": 70.0}
SHEET = {"threshold_on_percent": 20.0, "threshold_off_percent": 25.0, "leak_hz": 1.69, "noise_cutoff_hz": 300.0}
ONE, TWO = SHEET | {"background": [DIM], "dark_lux": 0.3}, SHEET | {"background": [DIM, LIT]}
FAST = SHEET | {"background": [DIM], "dark_lux": 0.3, "speed": [SLOW, QUICK], "noise_cutoff_hz": None}
POINT = {"type": "point", "position_m": [0, 0, 2], "illuminance_lux": 3.0}
BOX = {"builtin": "cornell_box"}
LEVEL = {"illuminance_lux": 30.0, "plane_point_m": [0, 0, 1], "plane_normal": [0, 1, 0]}


def pose(last=1.00009, stretch=1.00004, shear=9e-5, mirror=1):
    """A quarter turn about z and a way, by rows, off by rounding."""
    return [[0, -1, 0, 0.3], [stretch, shear, 0, -0.2], [0, 0, mirror, 4.0], [0, 0, 0, last]]


ABOUT = {"schema_version": 1, "name": "a", "description": ""}
CARD = {"name": "b", "shape": "rectangle"}
SCENE = ABOUT | {
    "objects": [CARD],
    "light": {"type": "uniform", "illuminance_lux": 3.0},
    "camera": {"horizontal_fov_deg": 30.0},
}
TRACK = {"object": "b", "keyframes": [{"t_us": 0}, {"t_us": 7}]}
DARK = {"type": "none"}
POSE = {"t_us": 3, "matrix": pose()}
OTHER_POSE = {"t_us": 3, "matrix": pose(last=0.99991, stretch=0.99996, shear=-9e-5)}
RELATIONS = [  # model, keys that are right, what makes them wrong
    (CharucoTarget, {"type": "charuco", "square_m": 0.03, "marker_m": 0.0299}, {"marker_m": 0.03}),
    (CircleGridTarget, {"type": "circle-grid", "pitch_m": 0.03, "diameter_m": 0.0299}, {"diameter_m": 0.03}),
    (LedGridTarget, {"type": "led-grid", "pitch_m": 0.03, "diameter_m": 0.0299}, {"diameter_m": 0.03}),
    (IntegratingSphereTarget, {"type": "integrating-sphere", "plate_m": 0.2, "port_diameter_m": 0.199},
     {"port_diameter_m": 0.2}),
    (StepWedgeTarget, {"type": "step-wedge", "reflectance_min": 0.39, "reflectance_max": 0.4},
     {"reflectance_min": 0.4}),
    (GreyRampTarget, {"type": "grey-ramp", "reflectance_min": 0.39, "reflectance_max": 0.4}, {"reflectance_min": 0.4}),
    (DeadLeavesTarget, LEAVES | {"reflectance_min": 0.39, "reflectance_max": 0.4}, {"reflectance_min": 0.4}),
    (DeadLeavesTarget, LEAVES | {"radius_max_m": 0.0021}, {"radius_max_m": 0.002}),
    (DeadLeavesTarget, LEAVES, {"radius_min_m": 0.00199}),
    (MaterialShares, NO_MATERIAL | {"glass": 1e-9}, {"glass": 0.0}),
    (BenchmarkSpec, SMALL, {"scenes": {"count": 0}}),
    (BenchmarkSpec, SMALL, {"sensors": [{"sensor": "a b"}]}),
    (BenchmarkSpec, SMALL, {"noise": [{"name": "a"}, {"name": "a"}]}),
    (BenchmarkSpec, SMALL, {"seeds": [3, 3]}),
    (BenchmarkSpec, SMALL, {"sensors": [{"sensor": "eiger"}, {"sensor": "x/eiger.yaml"}]}),
    (BenchmarkSpec, SMALL | {"samples": 8}, {"sharp": {"times_us": [100]}}),
    (BenchmarkSpec, SMALL | {"exposures_us": [[70, 70]]}, {"exposures_us": [[70, 69]]}),
    (BenchmarkSpec, SMALL | {"seeds": list(range(1000))}, {"seeds": list(range(1001))}),
    (BenchmarkSpec, SMALL | {"sharp": {"times_us": [500], "window_us": 1000}},
     {"sharp": {"times_us": [499], "window_us": 1000}}),
    (CaptureSpec, CAPTURE | {"evs_tile_rows": 2, "evs_tile_cols": 3}, {"evs_tile_rows": None}),
    (CaptureSpec, CAPTURE | {"evs_tile_rows": 2, "evs_tile_cols": 3}, {"evs_tile_cols": None}),
    (CaptureSpec, CAPTURE | {"tile_position": [1, 2]}, {"tile_position": [2, 1]}),
    (SplitShares, {"train": 0.5, "val": 0.3, "test": 0.2000005}, {"test": 0.200002}),
    (SplitShares, {"train": 0.5, "val": 0.3, "test": 0.1999995}, {"test": 0.199998}),
    (Steady, {"file": "a.raw", "lux": 3.0, "interval_us": [0, 1]}, {"interval_us": [1, 1]}),
    (Steady, {"file": "a.raw", "lux": 3.0, "interval_us": [0, 1]}, {"interval_us": [-1, 1]}),
    (Modulation, MODULATION, {"bursts": BURST | {"period_us": 160_000}}),
    (Modulation, MODULATION, {"hz": 24.99}),
    (IlluminationTable, {"image_height_mm": [0, 2], "illumination_rel": [1, 0]}, {"image_height_mm": [-0.1, 2]}),
    (IlluminationTable, {"image_height_mm": [0, 2], "illumination_rel": [1, 0]}, {"image_height_mm": [2, 2]}),
    (IlluminationTable, {"image_height_mm": [0, 2], "illumination_rel": [1, 0]}, {"illumination_rel": [1.01, 0]}),
    (IlluminationTable, {"image_height_mm": [0, 2], "illumination_rel": [1, 0]}, {"illumination_rel": [1, -0.01]}),
    (TableWaveformSpec, TABLE | {"t_us": [7.0, 7.0011]}, {"t_us": [7.0, 7.0009]}),
    (RangeSpec, {"first": 1e-6, "last": 1e-7, "count": 3, "scale": "log"}, {"first": 0.0}),
    (RangeSpec, {"first": 1e-6, "last": 1e-7, "count": 3, "scale": "log"}, {"last": 0.0}),
    (SurfacesSpec, {"reflectances": "a.csv", "bands_nm": [360, 830, 1]}, {"bands_nm": [359, 830, 1]}),
    (SurfacesSpec, {"reflectances": "a.csv", "bands_nm": [360, 830, 1]}, {"bands_nm": [360, 831, 1]}),
    (SurfacesSpec, {"reflectances": "a.csv", "bands_nm": [400, 499.9, 0.1]}, {"bands_nm": [400, 500, 0.1]}),
    (SurfacesSpec, {"reflectances": "a.csv", "bands_nm": [400, 401, 5]}, {"bands_nm": [400, 400, 5]}),
    (SurfacesSpec, {"reflectances": "a.csv", "bands_nm": [400, 401, 5]}, {"bands_nm": [400, 401, 0]}),
    (MeasuredPsf, PSF, {"kernels": [[[-1e-9, 0.5, 0.5]]]}),
    (MeasuredPsf, PSF, {"kernels": [[[0.0, 0.5, 0.4989]]]}),
    (MeasuredPsf, PSF, {"kernels": [[[0.0, 0.5, 0.5011]]]}),
    (MeasuredPsf, PSF, {"kernels": [[[0.25, 0.25, 0.25, 0.25]]]}),
    (MeasuredPsf, PSF | {"kernels": [[[1.0] + [0.0] * 256]]}, {"kernels": [[[1.0] + [0.0] * 258]]}),
    (PhotoreceptorSpec, CORNER, {"min_cutoff_hz": 70.1}),
    (PhotoreceptorSpec, CORNER, {"min_cutoff_hz": None}),
    (PhotoreceptorSpec, CORNER, {"signal_dn": None}),
    (PhotoreceptorSpec, FIRM, {"signal_dn": 3.0}),
    (PhotoreceptorSpec, FIRM, {"min_cutoff_hz": 60.0}),
    (PhotoreceptorSpec, FIRM, {"filters_noise": True}),
    (PhotoreceptorSpec, FIRM, {"approach": "gradual"}),
    (TrackSpec, {"object": "a", "keyframes": [{"t_us": 0}, {"t_us": 1}]}, {"keyframes": [{"t_us": 1}, {"t_us": 1}]}),
    (DataSheetSpec, TWO, {"leak_hz": 1.7}),
    (DataSheetSpec, TWO, {"dark_lux": 0.3}),
    (DataSheetSpec, TWO, {"background": [DIM, LIT | {"lux": 0.5}]}),
    (DataSheetSpec, TWO, {"noise_cutoff_hz": None}),
    (DataSheetSpec, TWO, {"background": [LIT]}),
    (DataSheetSpec, ONE, {"dark_lux": None}),
    (DataSheetSpec, FAST, {"speed": [SLOW, QUICK | {"lux": 5.0}]}),
    (DyeSpec, {"edges": [[500.0, 1e-9, 2.0]]}, {"edges": [[500.0, 0.0, 2.0]]}),
    (DataSheetSpec, FAST, {"background": [], "dark_lux": None}),
    (DataSheetSpec, FAST, {"background": [DIM, LIT], "dark_lux": None}),
    (DataSheetSpec, FAST, {"background": [DIM, LIT]}),
    (SpeedSpec, SLOW, {"bandwidth_hz": 30.0}),
    (SpeedSpec, SLOW, {"latency_us": None}),
    (NoiseLevel, {"name": "a", "clean": True}, {"without": ["aps.read"]}),
    (NoiseLevel, {"name": "a", "clean": True}, {"set": {"aps.read_noise_e": 2.0}}),
    (SharpSpec, {"times_us": [3, 4]}, {"times_us": [4, 4]}),
    (SharpSpec, {"times_us": [3, 4]}, {"times_us": [4, 3]}),
    (SharpSpec, {"times_us": [3, 4]}, {"every_us": 3}),
    (SharpSpec, {"times_us": [3, 4]}, {"times_us": []}),
    (CameraSpec, {"focal_length_mm": 8.0}, {"horizontal_fov_deg": 30.0}),
    (CameraSpec, {"origin_m": [1, 2, 3], "target_m": [1, 2, 2.99]}, {"target_m": [1, 2, 3]}),
    (LightSpec, POINT, {"position_m": None}),
    (LightSpec, POINT, {"size_m": [1, 1]}),
    (LightSpec, POINT, {"direction": [0, 0, -1]}),
    (LightSpec, POINT, {"rotation_deg": 10.0}),
    (LightSpec, POINT, {"irradiance_w_m2": 3.0}),
    (LightSpec, POINT, {"illuminance_lux": None}),
    (LightSpec, POINT | {"plane_normal": [0, 0, 1.1e-9]}, {"plane_normal": [0, 0, 0.9e-9]}),
    (LightSpec, {"type": "none"}, {"illuminance_lux": 3.0}),
    (LightSpec, {"type": "none"}, {"waveform": {"type": "mains", "frequency_hz": 50, "depth": 0.4}}),
    (MitsubaSpec, BOX, {"inline": {"a": {"type": "constant"}}}),
    (MitsubaSpec, BOX, {"builtin": None}),
    (MitsubaSpec, BOX | {"lit": ["a"]}, {"unlit": ["b"]}),
    (MitsubaSpec, BOX | LEVEL, {"irradiance_w_m2": 3.0}),
    (MitsubaSpec, BOX | LEVEL, {"radiance_scale": 2.0}),
    (MitsubaSpec, BOX | LEVEL, {"plane_normal": None}),
    (MitsubaSpec, BOX, {"plane_point_m": [0, 0, 1]}),
    (SceneSpec, SCENE | {"motion": [TRACK]}, {"motion": [TRACK, TRACK]}),
    (SceneSpec, SCENE, {"objects": []}),
    (SceneSpec, SCENE, {"objects": [CARD, CARD]}),
    (SceneSpec, SCENE, {"objects": [CARD | {"name": "target"}]}),
    (SceneSpec, SCENE, {"objects": [CARD | {"name": "camera"}]}),
    (SceneSpec, SCENE, {"camera": None}),
    (SceneSpec, SCENE, {"camera": {"fit": "target"}}),
    (SceneSpec, ABOUT | {"mitsuba": BOX, "light": DARK}, {"light": POINT}),
    (SceneSpec, ABOUT | {"mitsuba": BOX}, {"objects": [CARD]}),
    (SceneSpec, ABOUT | {"mitsuba": BOX, "camera": {}}, {"camera": {"fit": "target"}}),
    (SpectrumSpec, {"colorchecker": "cc_ohta", "patch": 24}, {"patch": None}),
    (SpectrumSpec, {"colorchecker": "cc_ohta", "patch": 24}, {"patch": 25}),
    (SpectrumSpec, {"colorchecker": "cc_ohta", "patch": 1}, {"patch": 0}),
    (SpectrumSpec, {"peak_nm": 500.0, "fwhm_nm": 30.0}, {"fwhm_nm": None}),
    (SpectrumSpec, {"peak_nm": 500.0, "fwhm_nm": 30.0}, {"flat": 0.3}),
    (KeyframeSpec, POSE, {"matrix": pose(last=1.0002)}),
    (KeyframeSpec, POSE, {"matrix": pose(stretch=1.0002)}),
    (KeyframeSpec, POSE, {"matrix": pose(shear=2e-4)}),
    (KeyframeSpec, POSE, {"matrix": pose(mirror=-1)}),
    (KeyframeSpec, POSE, {"translation_m": [0, 0, 0]}),
    (KeyframeSpec, POSE, {"rotation_deg": 0.0}),
    (KeyframeSpec, POSE, {"rotation_axis": [0, 0, 1]}),
    (KeyframeSpec, OTHER_POSE, {"matrix": pose(last=0.9998)}),
    (KeyframeSpec, OTHER_POSE, {"matrix": pose(stretch=0.9998)}),
    (KeyframeSpec, OTHER_POSE, {"matrix": pose(shear=-2e-4)}),
    (VideoOptions, {"white_e_per_s": 3e5, "white_filter": "clear"}, {"white_lux": 30.0}),
    (VideoOptions, {"white_e_per_s": 3e5, "white_filter": "clear"}, {"white_filter": None}),
    (VideoOptions, {"white_e_per_s": 3e5, "white_filter": "clear"}, {"white_e_per_s": None}),
    (Region, {"x": 0, "y": 0, "width_px": 2**14, "height_px": 2**14}, {"width_px": 2**14 + 1}),
    (ObjectSpec, {"name": "a", "shape": "mesh", "mesh": "a.obj"}, {"mesh": None}),
    (ObjectSpec, {"name": "a", "shape": "mesh", "mesh": "a.obj"}, {"shape": "box"}),
    (ObjectSpec, {"name": "a", "shape": "mesh", "mesh": "a.glb", "materials": "file"}, {"mesh": "a.obj"}),
    (ObjectSpec, {"name": "a", "shape": "sphere", "size_m": [2, 2, 2]}, {"size_m": [2, 2, 2.001]}),
    (ObjectSpec, {"name": "a", "shape": "box", "size_m": [2, 2, 2], "pattern": 0.3},
     {"material": {"type": "diffuse", "reflectance": 0.2}}),
    (ObjectSpec, {"name": "a", "shape": "rectangle", "size_m": [1, 2, 0]}, {"shape": "box"}),
    (ObjectSpec, {"name": "a", "shape": "rectangle", "size_m": [1, 2, 0]}, {"size_m": [1, 2, -1e-9]}),
]  # fmt: skip


@pytest.mark.parametrize(("model", "right", "wrong"), RELATIONS)
def test_keys_of_a_section(model, right, wrong):
    model.model_validate(right)
    with pytest.raises(ValidationError) as caught:
        model.model_validate(right | wrong)
    # a relation, not the type or the limits of one key
    assert [error["type"] for error in caught.value.errors()] == ["value_error"]


SENSORS = [  # sensor, overrides that are right, what makes them wrong, and the message
    ("eiger", {"aps.black_level_dn": 1022.9}, {"aps.black_level_dn": 1023.0}, "does not fit into 10 bits"),
    ("eiger", {"aps.frame_rate_hz": 125.0, "aps.exposure_us": 8000}, {"aps.exposure_us": 8001}, "longer than a frame"),
    ("eiger", {"evs.tick_us": 900, "evs.window_us": 900}, {"evs.window_us": 901}, "window_us"),
    ("davis346", {"evs.contrast_threshold_on": 1e-4}, {"evs.contrast_threshold_on": 0.99e-4}, "at least 0.0001"),
    ("davis346", {"evs.noise_cutoff_hz": 70.0, "evs.photoreceptor": CORNER | {"filters_noise": True}},
     {"evs.noise_cutoff_hz": 70.1}, "above photoreceptor.cutoff_hz"),
    ("eiger", {"evs.defects": {"stuck_share": 0.25, "hot_share": 0.25, "hot_rate_hz": 2.0}},
     {"evs.defects": {"stuck_share": 0.25, "hot_share": 0.2501, "hot_rate_hz": 2.0}}, "share"),
    ("eiger", {"evs.defects": {"hot_share": 0.0}}, {"evs.defects": {"hot_share": 1e-6}}, "hot_rate_hz"),
    ("eiger", {"evs.defects": {"flickering_share": 0.0}}, {"evs.defects": {"flickering_share": 1e-6}}, "flickering"),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore::hesim_render.core.errors.HesimWarning")
@pytest.mark.parametrize(("name", "right", "wrong", "message"), SENSORS)
def test_keys_of_a_sensor(name, right, wrong, message):
    read_sensor(name, right)
    with pytest.raises(SpecError, match=message):
        read_sensor(name, right | wrong)


def test_a_deforming_mesh_has_all_meshes_of_its_folder_in_the_order_of_their_names(tmp_path):
    (tmp_path / "shapes").mkdir()
    for name in ("c.ply", "a.obj", "d.OBJ", "b.PLY", "notes.txt", "e.stl"):
        (tmp_path / "shapes" / name).touch()
    spec = DeformationSpec.model_validate({"file": "shapes", "every_us": 1000}, context={"folder": tmp_path})
    assert spec.files == ["shapes/a.obj", "shapes/b.PLY", "shapes/c.ply", "shapes/d.OBJ"]
