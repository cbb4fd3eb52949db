"""A pipeline: a list of steps that a YAML file can change, and what runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hesim_render.camera import Camera
from hesim_render.errors import RangeError
from hesim_render.frame import Frame
from hesim_render.isp.steps import ON_MOSAIC, Demosaic, Development, Encode, Step
from hesim_render.mosaic import Mosaic
from hesim_render.specs.files import Strict, load_yaml, validate


class Pipeline(Strict):
    """Steps in the order in which they are done; a step may be left out, and some may stand more than once.

    Steps on the mosaic (black_level, fill, lens_shading, white_balance) come before the one demosaic, the others
    after it; encode, if there is one, comes last.
    """

    schema_version: Literal[1] = 1
    steps: list[Step] = Field(min_length=1)

    @model_validator(mode="after")
    def _in_order(self) -> Pipeline:
        names = [item.step for item in self.steps]
        if names.count("demosaic") != 1:
            raise ValueError("steps: exactly one of them must be demosaic")
        middle = names.index("demosaic")
        for k, item in enumerate(self.steps):
            if isinstance(item, Demosaic):
                continue
            if isinstance(item, ON_MOSAIC) != (k < middle):
                side = "before" if isinstance(item, ON_MOSAIC) else "after"
                raise ValueError(f"steps: {item.step} must come {side} demosaic")
            if isinstance(item, Encode) and k != len(names) - 1:
                raise ValueError("steps: encode must come last")
        return self

    @classmethod
    def of(cls, *steps: str | dict[str, Any]) -> Pipeline:
        """A pipeline of step names, or of dictionaries as in a file."""
        return cls.model_validate({"steps": [{"step": item} if isinstance(item, str) else item for item in steps]})


#: Colours as the camera's description has them, no exposure of its own: what an inverse pipeline undoes.
DEFAULT = Pipeline.of("black_level", "white_balance", "demosaic", "colour_matrix", "encode")
#: For pictures of recordings, which may be dark: exposed so that the brightest half percent is nearly white.
PICTURE = Pipeline.of(
    "black_level", "white_balance", "demosaic", "colour_matrix", {"step": "exposure", "auto": True}, "encode"
)


def load_pipeline(file: str | Path) -> Pipeline:
    """A pipeline from a YAML file.

    Raises
    ------
    SpecError
        If the file is not one; the message has file, line and key.
    """
    path = Path(file)
    return validate(Pipeline, load_yaml(path), path, {})


def process(
    frame_or_raw: Frame | NDArray, mosaic: Mosaic | Camera, pipeline: Pipeline | None = None
) -> NDArray[np.float32] | NDArray[np.uint8] | NDArray[np.uint16]:
    """A picture of one RAW frame.

    Parameters
    ----------
    frame_or_raw : a frame of a recording, or a RAW array [row, col] in DN; row 0, column 0 is tile position (0, 0).
    mosaic : of the recording, or a `Camera` for a plain array.
    pipeline : default `DEFAULT`.

    Returns
    -------
    [row, col, 3] : uint8 with the default; uint16, or float32 in [0, 1], as the encode step says; linear float32
        where there is none.

    Raises
    ------
    RangeError, SpecError
        If the frame does not fit the camera, or a step lacks what it needs.
    """
    return develop(frame_or_raw, mosaic, pipeline).image


def develop(
    frame_or_raw: Frame | NDArray,
    mosaic: Mosaic | Camera,
    pipeline: Pipeline | None = None,
    *,
    illumination: NDArray[np.float32] | None = None,
    exposure_gain: float | None = None,
) -> Development:
    """As `process`; the result also says what steps found out (`Development.report`).

    Parameters
    ----------
    illumination : relative illumination [row, col], for a lens_shading step without figures.
    exposure_gain : for an automatic exposure, instead of measuring the frame.
    """
    camera = mosaic if isinstance(mosaic, Camera) else Camera.of(mosaic)
    raw = np.asarray(frame_or_raw.raw if isinstance(frame_or_raw, Frame) else frame_or_raw)
    tile = camera.tile_channel
    if raw.ndim != 2 or raw.shape[0] < tile.shape[0] or raw.shape[1] < tile.shape[1]:
        raise RangeError("shape of the RAW frame", raw.shape, f"[row, col], at least one tile {tile.shape}")
    if raw.dtype.kind not in "uif":
        raise RangeError("type of the RAW frame", str(raw.dtype), "numbers")
    if raw.dtype.kind == "f" and not np.isfinite(raw).all():
        raise RangeError("RAW frame", "NaN or infinite values", "finite DN")
    state = Development(raw, camera, tile, illumination, exposure_gain)
    for item in (pipeline or DEFAULT).steps:
        item.run(state)
    if state.image.shape[-1] == 1:  # a mono camera without a matrix step
        state.image = np.repeat(state.image, 3, axis=-1)
    return state
