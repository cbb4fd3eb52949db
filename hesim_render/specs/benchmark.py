"""The specification of a benchmark: which clips are built, from which parts, for which sensors."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, PositiveInt, field_validator, model_validator

from hesim_render.core.errors import SpecError
from hesim_render.specs.files import NamedSpec, Strict, read_spec

#: Splits, in the order in which scenes are assigned to them.
SPLITS = ("train", "val", "test")
Split = Literal["train", "val", "test"]
#: Largest number of clips of one benchmark.
MOST_CLIPS = 1_000_000
#: Form of names that become parts of file names.
NAME = r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}"


def _one_value(given: Any) -> Any:
    """A single number as a range of length 0."""
    return [given, given] if isinstance(given, int | float) and not isinstance(given, bool) else given


def _increasing(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[1] < limits[0]:
        raise ValueError(f"a range is [smallest, largest]; {limits[0]:g} is above {limits[1]:g}")
    return limits


def _range(low: float, high: float) -> Any:
    """Type of a range of values within limits; one number is a range as well."""
    value = Annotated[float, Field(ge=low, le=high)]
    return Annotated[tuple[value, value], BeforeValidator(_one_value)]  # type: ignore[valid-type]


class _Ranges(Strict):
    """Base of models whose pairs of numbers are ranges in increasing order."""

    @field_validator("*")
    @classmethod
    def _in_order(cls, value: Any) -> Any:
        is_pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, int | float) for v in value)
        return _increasing(value) if is_pair else value


class MaterialShares(Strict):
    """Relative frequencies of the materials of surfaces."""

    diffuse: float = Field(4.0, ge=0)
    plastic: float = Field(1.0, ge=0, description="diffuse below a smooth coat")
    rough_plastic: float = Field(1.0, ge=0, description="diffuse below a rough coat")
    metal: float = Field(0.5, ge=0, description="rough metal")
    glass: float = Field(0.0, ge=0, description="takes several times as long as the others")

    @model_validator(mode="after")
    def _check(self) -> "MaterialShares":
        if sum(self.shares.values()) <= 0:
            raise ValueError("at least one material must have a share above 0")
        return self

    @property
    def shares(self) -> dict[str, float]:
        return {name: getattr(self, name) for name in type(self).model_fields}


class GivenScene(Strict):
    """A scene file that joins the generated scenes with its own motion and light."""

    scene: str = Field(min_length=1, description="name of a shipped scene, or a path relative to this file")
    split: Split


class ScenesSpec(_Ranges):
    """What stands in the generated scenes. Lengths are in widths of the view."""

    count: int = Field(0, ge=0, le=1_000_000, description="number of generated scenes")
    objects: _range(1, 200) = Field((2, 6), description="number of solids")  # type: ignore[valid-type]
    size: _range(0.002, 1) = Field((0.05, 0.5), description="largest extent of a solid, view widths")  # type: ignore[valid-type]
    contrast: _range(0.005, 0.98) = Field(  # type: ignore[valid-type]
        (0.03, 0.95), description="(max - min) / (max + min) of the reflectances of a scene"
    )
    textured: float = Field(0.6, ge=0, le=1, description="share of surfaces with a texture")
    materials: MaterialShares = MaterialShares()
    parts: str | None = Field(None, description="folder of meshes (OBJ) and textures (PNG, JPEG) that join")
    given: tuple[GivenScene, ...] = ()

    @field_validator("objects")
    @classmethod
    def _whole(cls, value: tuple[float, float]) -> tuple[float, float]:
        if any(number != int(number) for number in value):
            raise ValueError("objects: whole numbers")
        return value


class MotionsSpec(_Ranges):
    """How generated scenes move: several draws of trajectories for each scene."""

    count: PositiveInt = 1
    speed: _range(1e-4, 1000) = Field((0.03, 3.0), description="of a motion, view widths per second")  # type: ignore[valid-type]
    moving: float = Field(0.8, ge=0, le=1, description="share of solids that move; at least one does")
    camera: float = Field(0.3, ge=0, le=1, description="share of motions in which the camera moves as well")


class LightsSpec(_Ranges):
    """How generated scenes are lit: several draws of lamps for each scene."""

    count: PositiveInt = 1
    illuminance_lux: _range(1e-3, 1e6) = Field((30.0, 10_000.0), description="of all lamps together")  # type: ignore[valid-type]
    illuminants: tuple[str, ...] = Field(("D65", "A", "FL11", "LED-B3"), min_length=1)
    lamps: _range(1, 8) = Field((1, 3), description="number of lamps")  # type: ignore[valid-type]
    flicker: float = Field(0.0, ge=0, le=1, description="share of lights in which one lamp flickers")


class SensorChoice(Strict):
    """A sensor with its region and changed keys."""

    sensor: str = Field(min_length=1, description="name of a shipped sensor, or a path relative to this file")
    roi: str | None = Field(None, pattern=r"^[0-9]{1,5}x[0-9]{1,5}(\+[0-9]{1,5}\+[0-9]{1,5})?$")
    set: dict[str, Any] = Field({}, description="keys of the sensor file, dotted, and their values")
    name: str | None = Field(None, pattern=f"^{NAME}$", description="in the names of clips; default the sensor's")


class NoiseLevel(Strict):
    """Which noise the clips have."""

    name: str = Field(pattern=f"^{NAME}$")
    clean: bool = False
    without: tuple[str, ...] = ()
    set: dict[str, Any] = Field({}, description="keys of the sensor file, such as aps.read_noise_e")

    @model_validator(mode="after")
    def _check(self) -> "NoiseLevel":
        if self.clean and (self.without or self.set):
            raise ValueError("clean has no noise at all: drop without and set")
        return self


class SharpSpec(Strict):
    """Sharp images: noise-free flux of the frame pixels in short windows, and the RAW of a still scene of that flux."""

    every_us: PositiveInt | None = Field(None, description="distance of their middles, from 0 on")
    times_us: tuple[Annotated[int, Field(ge=0)], ...] = Field((), description="middles of the windows")
    window_us: PositiveInt = 200
    shutter: Literal["sensor", "global"] = Field(
        "sensor", description="times are those of row 0, and rows follow as in a frame; or all rows at the same time"
    )

    colours: bool = Field(
        False, description="the same times through every filter at every pixel as well, rendered; for demosaicing"
    )

    @model_validator(mode="after")
    def _check(self) -> "SharpSpec":
        if (self.every_us is None) == (not self.times_us):
            raise ValueError("give every_us or times_us")
        if list(self.times_us) != sorted(set(self.times_us)):
            raise ValueError("times_us: in order of time, each once")
        return self

    def middles_us(self, duration_us: int, readout_us: float = 0.0) -> list[float]:
        """Middles of the windows of row 0 of all images that lie within a run, µs.

        Parameters
        ----------
        duration_us : of the run, µs.
        readout_us : from the first row to the last one, µs.
        """
        half = self.window_us / 2
        every = self.times_us or np.arange(0, duration_us + 1, self.every_us or 1)
        return [float(t) for t in every if half <= t <= duration_us - half - readout_us]


class SplitShares(Strict):
    """Shares of the scenes in each split."""

    train: float = Field(0.7, ge=0, le=1)
    val: float = Field(0.15, ge=0, le=1)
    test: float = Field(0.15, ge=0, le=1)

    @model_validator(mode="after")
    def _check(self) -> "SplitShares":
        if abs(self.train + self.val + self.test - 1) > 1e-6:
            raise ValueError(f"train, val and test add up to {self.train + self.val + self.test:g}, not to 1")
        return self


class BenchmarkSpec(NamedSpec):
    """A whole benchmark: scenes × motions × lights × sensors × exposures × noise × seeds."""

    name: str = Field(pattern=f"^{NAME}$")
    seed: int = Field(1, ge=0, lt=2**63, description="of all draws of scenes, motions, lights and exposures")
    duration_s: float = Field(0.1, gt=0, le=3600)
    scenes: ScenesSpec
    motions: MotionsSpec = MotionsSpec()
    lights: LightsSpec = LightsSpec()
    sensors: tuple[SensorChoice, ...] = Field(min_length=1)
    exposures_us: tuple[_range(1, 1e9), ...] = Field(  # type: ignore[valid-type]
        (), description="values or ranges, one draw of each per clip; none keeps the sensor's own exposure"
    )
    noise: tuple[NoiseLevel, ...] = Field((NoiseLevel(name="standard"),), min_length=1)
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**63)], ...] = Field((7,), min_length=1)
    clips: PositiveInt | None = Field(None, description="at most this many, drawn from all combinations")
    splits: SplitShares = SplitShares()
    sharp: SharpSpec | None = None
    truth: tuple[str, ...] = Field(("flow", "depth"), description="kinds as of simulate; events labels events")
    quality: float = Field(0.5, gt=0, le=100)
    samples: int | None = Field(
        None,
        ge=2,
        le=1_000_000,
        multiple_of=2,
        description="rays per pixel and slice, in place of quality: exact mode",
    )
    audit: float = Field(1.0, ge=0, le=1, description="share of the clips whose render is audited, drawn at random")
    folder: Path = Field(Path(), exclude=True)

    @model_validator(mode="after")
    def _check(self) -> "BenchmarkSpec":
        if self.scenes.count == 0 and not self.scenes.given:
            raise ValueError("scenes: give a count above 0, or scenes of your own (given)")
        for choice in self.sensors:
            if choice.name is None and not re.fullmatch(NAME, stem := Path(choice.sensor).stem):
                raise ValueError(f"sensors: {stem!r} cannot be part of the names of clips; give it a name (name: …)")
        for key, names in (
            ("noise", [level.name for level in self.noise]),
            ("seeds", list(self.seeds)),
            ("sensors", [choice.name or Path(choice.sensor).stem for choice in self.sensors]),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"{key}: each name once; there are {', '.join(map(str, names))}")
        if self.samples is not None and self.sharp is not None:
            raise ValueError("samples: sharp images have an error that follows quality; leave one of the two out")
        if any(limits[1] < limits[0] for limits in self.exposures_us):
            raise ValueError("exposures_us: a range is [smallest, largest]")
        if self.combinations > MOST_CLIPS:
            raise ValueError(f"{self.combinations} combinations; at most {MOST_CLIPS} can be counted")
        if self.sharp is not None and not self.sharp.middles_us(self.duration_us):
            raise ValueError(f"sharp: no window of {self.sharp.window_us} µs lies within {self.duration_us} µs")
        return self

    @property
    def duration_us(self) -> int:
        return round(self.duration_s * 1e6)

    @property
    def combinations(self) -> int:
        """Number of all combinations of the axes."""
        generated = self.scenes.count * self.motions.count * self.lights.count
        others = len(self.sensors) * max(1, len(self.exposures_us)) * len(self.noise) * len(self.seeds)
        return (generated + len(self.scenes.given)) * others


def read_benchmark(file: str | Path, overrides: Mapping[str, Any] | None = None) -> BenchmarkSpec:
    """Read a benchmark's specification, with dotted `overrides` applied before validation.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    path = Path(file)
    if not path.is_file():
        raise SpecError("no such file", file=file)
    spec = read_spec(BenchmarkSpec, path.resolve(), overrides=overrides)
    return spec.model_copy(update={"folder": path.resolve().parent})
