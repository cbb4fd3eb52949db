"""A pipeline: a list of steps that a YAML file can change, and the functions that run it."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hesim_render.core.errors import RangeError
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.steps import BEFORE_DENOISE, ON_MOSAIC, Demosaic, Denoise, Development, Encode, Step
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.description import Mosaic
from hesim_render.recording.frame import Frame
from hesim_render.specs.files import Strict, read_spec


class Pipeline(Strict):
    """A list of steps, in the order in which they are done. A step may be left out, and some may occur more than once.

    Steps on the mosaic (black_level, fill, denoise, lens_shading, white_balance) come before the single demosaic step,
    all others after it. An encode step comes last. Only black_level and fill may come before denoise.

    Parameters
    ----------
    schema_version : version of the file format, 1.
    steps : steps as in a pipeline file, see docs/isp.md.

    Raises
    ------
    ValidationError
        If a step is unknown or the order is wrong (from pydantic; `load_pipeline` makes a `SpecError` of it).
    """

    schema_version: Literal[1] = 1
    steps: list[Step] = Field(min_length=1)

    @model_validator(mode="after")
    def _in_order(self) -> "Pipeline":
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
            if isinstance(item, Denoise):
                before = self.steps[:k]
                if "black_level" not in names[:k] or not all(isinstance(other, BEFORE_DENOISE) for other in before):
                    raise ValueError("steps: denoise must come after black_level, with nothing but fill in between")
        return self

    @classmethod
    def of(cls, *steps: str | dict[str, Any]) -> "Pipeline":
        """A pipeline of given steps.

        Parameters
        ----------
        steps : step names, or dictionaries as in a file.

        Returns
        -------
        The pipeline.
        """
        return cls.model_validate({"steps": [{"step": item} if isinstance(item, str) else item for item in steps]})

    def without(self, step: str) -> "Pipeline":
        """The same pipeline without some of its steps.

        Parameters
        ----------
        step : name of the steps to leave out.

        Returns
        -------
        A new pipeline.
        """
        return self.model_copy(update={"steps": [item for item in self.steps if item.step != step]})


#: Colours as the camera's description has them, no exposure of its own: what an inverse pipeline undoes.
DEFAULT = Pipeline.of("black_level", "white_balance", "demosaic", "colour_matrix", "encode")
#: For pictures of recordings, which may be dark: exposed so that the brightest half percent is nearly white.
PICTURE = Pipeline.of(
    "black_level", "white_balance", "demosaic", "colour_matrix", {"step": "exposure", "auto": True}, "encode"
)

#: The same for frames whose sensor's noise is known: its maps taken out, its noise reduced.
DENOISED_PICTURE = Pipeline.of("black_level", "denoise", *PICTURE.model_dump()["steps"][1:])


def load_pipeline(file: str | Path) -> Pipeline:
    """Read a pipeline from a YAML file.

    Parameters
    ----------
    file : the file.

    Returns
    -------
    The pipeline.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    return read_spec(Pipeline, Path(file))


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
    noise: FrameNoise | None = None,
) -> Development:
    """As `process`, with measurements: the result also has the report of each step (`Development.report`).

    Charts are measured on linear data before noise reduction, even if the pipeline has a denoise step.

    Parameters
    ----------
    frame_or_raw, mosaic, pipeline : as for `process`.
    illumination : relative illumination [row, col], for a lens_shading step without values of its own.
    exposure_gain : factor of an automatic exposure; None measures the frame.
    noise : noise of the sensor, for a denoise step; a `Frame` supplies its own exposure.

    Returns
    -------
    The picture and the reports of its steps.

    Raises
    ------
    RangeError, SpecError
        If the frame does not fit the camera, or a step lacks an input.
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
    if noise is not None and isinstance(frame_or_raw, Frame):
        noise = noise.at(frame_or_raw.exposure_us)
    state = Development(raw, camera, tile, illumination, exposure_gain, noise)
    chain = pipeline or DEFAULT
    for item in _charts_measured(state, chain):
        item.run(state)
    if state.image.shape[-1] == 1:  # a mono camera without a matrix step
        state.image = np.repeat(state.image, 3, axis=-1)
    return state


def _charts_measured(state: Development, chain: Pipeline) -> list[Step]:
    """The steps; if one is a denoise step, charts are measured on a branch without it."""
    charts = [k for k, item in enumerate(chain.steps) if getattr(item, "method", None) == "chart"]
    steps = list(chain.steps)
    if not charts or not any(isinstance(item, Denoise) for item in steps):
        return steps
    linear = replace(state)
    for k, item in enumerate(steps[: charts[-1] + 1]):
        if isinstance(item, Denoise):
            continue
        item.run(linear)
        if k in charts:
            outcome = linear.report or {}
            result = (
                {"gains": outcome["white_balance"]} if item.step == "white_balance" else {"matrix": outcome["matrix"]}
            )
            steps[k] = item.model_copy(update={"method": "given", **result})
    state.report = linear.report
    return steps
