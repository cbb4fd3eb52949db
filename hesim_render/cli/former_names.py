"""What commands and options of drafts of this program are called now; no release had them."""

from __future__ import annotations

from collections.abc import Sequence

_KEYS = "its options are keys: --set"
#: Commands, with their first argument where that decides.
_COMMANDS = {
    "doctor": "info",
    "list": "info KIND; all: info names",
    "sensor describe": "info SENSOR",
    "sensor new": "new FILE",
    "video": f"simulate VIDEO; {_KEYS} fps=100",
    "expose": f"simulate CUBE; {_KEYS} illuminance_lux=500",
    "run": "simulate RUN.yaml",
    "rerun": "simulate RECORDING",
    "lab": "calibrate lab",
    "twin": "calibrate twin",
    "study cfa": "study SPEC",
    "study design": "study SPEC",
    "sweep": "study SPEC",
    "benchmark pack": "benchmark export --format webdataset",
}
#: Options of `simulate`, but for one of `benchmark export`.
_OPTIONS = {
    **{
        f"--{key.replace('_', '-')}": f"--set {key}=VALUE"
        for key in (
            "fps", "slow_motion", "duty", "interpolation", "motion_factor", "transfer", "gamma", "primaries", "matrix",
            "range", "bit_depth", "mode", "others", "camera", "illuminant", "white_lux", "white_e_per_s",
            "white_filter", "fit", "scale",
        )
    },
    "--lens-shading": "--set lens_shading=true",
    "--lux": "--set illuminance_lux=VALUE",
    "--luminance": "--set mean_luminance_cd_m2=VALUE",
    "--radiance": "--set quantity=radiance",
    "--bands": "--set wavelength_nm=FIRST:LAST:STEP",
    "--hold": "--set beyond=hold",
    "--pan": "--set pan_px_per_s=[X,Y]",
    "--zoom": "--set zoom_per_s=VALUE",
    "--rotate": "--set rotation_deg_per_s=VALUE",
    "--layout": "--format",
}  # fmt: skip


def name_now(given: Sequence[str]) -> str | None:
    """The present form of a command line that is refused and has a former command or option, else None."""
    words = [word for word in given if not word.startswith("-")]
    for former in (" ".join(words[:2]), *words[:1]):
        if former in _COMMANDS:
            return f"hesim-render {_COMMANDS[former]}"
    return next((_OPTIONS[word.partition("=")[0]] for word in given if word.partition("=")[0] in _OPTIONS), None)
