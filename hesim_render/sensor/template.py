"""A sensor file to begin with: round numbers with comments that say what to put there, or those of a shipped one."""

import re

from hesim_render.core.shipped import data_folder

_HEAD = """\
# A sensor file. Every number here is a placeholder: replace it by a figure of your sensor, and note under `sources`
# where that is from, or under `assumptions` why you assumed it. docs/sensors.md has all keys. To look at the result:
#     hesim-render info THIS_FILE --out curves.png
schema_version: 1
name: {name}
description: "{description}"
device_seed: 1                 # another number is another device: other fixed patterns, other thresholds

geometry:
  rows: {rows}                    # pixels of the whole sensor
  cols: {cols}
  pitch_um: 5.0
  fill_factor: 1.0             # part of the pixel that collects light; with microlenses 1

# The smallest part of the mosaic that repeats, one letter a pixel.
tile: |
{tile}
pixels:
{pixels}{grid}
filters:                       # transmittance: a table as here, {{csv: file.csv}}, or another way of docs/sensors.md
{filters}
# electrons per photon
quantum_efficiency: {{wavelength_nm: [380, 450, 550, 650, 700], value: [0.3, 0.5, 0.6, 0.5, 0.4]}}

lens:
  f_number: 2.0
  focal_length_mm: 8.0
  transmittance: 0.9
  magnification: focus         # from the focal length and the distance that the scene is focused at
  relative_illumination: cos4
"""

_APS = """
aps:                           # pixels that give frames; an EMVA 1288 data sheet has most of these figures
  full_well_e: 10000           # saturation capacity
  system_gain_dn_per_e: 0.4    # DN per electron: (largest DN - black level) / full well, if nothing else is known
  bit_depth: 12
  black_level_dn: 64
  read_noise_e: 2.5            # temporal dark noise without dark current
  dark_current_e_per_s: 5.0
  prnu_rel: 0.005              # spread of the response over pixels
  dsnu_e: 1.0                  # spread of the offset over pixels
  law: poisson
  exposure_us: 5000
  frame_rate_hz: 50
  shutter: rolling             # or global, without line_time_us
  line_time_us: 15.0
"""

_EVS = """
evs:                           # pixels that give events
  reference: last_event        # asynchronous pixels; for comparisons at a fixed tick see docs/sensors.md
  window_us: 1
  data_sheet:                  # turned into the parameters of the model; `info` shows them
    light: LED-B2              # light of the illuminances below, which are those on the sensor itself
    threshold_on_percent: 25   # contrast (brighter - darker)/darker that half of the pixels answer to
    threshold_off_percent: 25
    threshold_mismatch_percent: 2.5              # its spread over pixels
    background: [{lux: 5, rate_hz: 5}]           # all events of a pixel in steady light, mean over pixels
    dark_lux: 0.1              # light that gives as much current as the dark
    noise_cutoff_hz: 60        # in bright light; in dim light the speed of the pixel limits it
    leak_hz: 0.1               # ON events of the leak, a part of the background
    speed:                     # latency or bandwidth_hz, at one or two illuminances
      - {lux: 1000, latency_us: 200}
      - {lux: 5, latency_us: 1000}
    speed_step_percent: 100    # step of contrast that the latencies are stated for
    refractory_us: 500         # time after an event in which the pixel gives no other
"""

_TAIL = """
sources: {{}}
assumptions:
  geometry: placeholder
  filters: placeholder
  quantum_efficiency: placeholder
  lens: placeholder
"""

_CLEAR = "  clear: {wavelength_nm: [380, 400, 420, 650, 690, 720], value: [0.0, 0.5, 1.0, 1.0, 0.5, 0.0]}"
_COLOURS = """\
  red: {peak_nm: 600, fwhm_nm: 80}
  green: {peak_nm: 540, fwhm_nm: 80}
  blue: {peak_nm: 460, fwhm_nm: 70}"""
_GRID = """
evs_grid: {rows_per_tile: 1, cols_per_tile: 1}   # event pixels of a tile; their coordinates count in these
"""
_APS_LETTERS = """\
  R: {filter: red, roles: [aps]}
  G: {filter: green, roles: [aps]}
  B: {filter: blue, roles: [aps]}
"""
_EVS_LETTERS = "  w: {filter: clear, roles: [evs]}   # by habit, letters of event pixels are lower case\n"


def sensor_template(name: str, like: str) -> str:
    """Text of a sensor file with placeholders and comments; it can be simulated as it is.

    Parameters
    ----------
    name : name of the sensor.
    like : ``frames`` (a Bayer mosaic), ``events`` (asynchronous pixels), or ``hybrid`` (both).
    """
    frames, events = like != "events", like != "frames"
    tile = {"frames": "  R G\n  G B", "events": "  w", "hybrid": "  R R G G\n  R w G G\n  G G B B\n  G G B B"}[like]
    text = _HEAD.format(
        name=_quoted(name),
        description={"frames": "a Bayer sensor for frames", "events": "an asynchronous event sensor",
                     "hybrid": "a hybrid sensor for frames and events"}[like],
        rows=480, cols=640, tile=tile + "\n",
        pixels=(_APS_LETTERS if frames else "") + (_EVS_LETTERS if events else ""),
        grid=_GRID if events else "",
        filters="\n".join([_COLOURS] * frames + [_CLEAR] * events),
    )  # fmt: skip
    parts = [text, _APS * frames, _EVS * events, _TAIL.format()]
    notes = ["  aps: placeholder\n"] * frames + ["  evs: placeholder\n"] * events
    return "".join([*parts, *notes])


def sensor_copy(name: str, shipped: str) -> str:
    """Text of a shipped sensor file under another name.

    Parameters
    ----------
    name : name of the new sensor.
    shipped : name of the shipped one.
    """
    text = (data_folder("sensors") / f"{shipped}.yaml").read_text(encoding="utf-8")
    named = re.sub(r"(?m)^name:.*$", lambda _: f"name: {_quoted(name)}", text, count=1)
    return f"# A copy of {shipped}: correct what differs, and note its source. docs/sensors.md has all keys.\n{named}"


def _quoted(name: str) -> str:
    """A name as a YAML text, whatever its characters."""
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
