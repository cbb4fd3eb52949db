"""The file of a comparison with other event simulators: scenes, sensor, pictures, and how each peer is run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from hesim_render.specs.benchmark import NAME, SensorChoice
from hesim_render.specs.files import NamedSpec, Strict, locate, read_spec

Rate = Annotated[float, Field(ge=1, le=1e6)]


class Peer(Strict):
    """A program that makes events from pictures. It is run in a process of its own."""

    name: str = Field(pattern=f"^{NAME}$")
    command: tuple[Annotated[str, Field(min_length=1)], ...] = Field(
        min_length=1, description="program and arguments; paths are relative to this file"
    )
    encoding: Literal["linear", "srgb"] = Field("linear", description="of the pictures that it expects")
    bits: Literal[8, 16] = 8
    noise: bool = Field(False, description="given to the program, which switches its own noise on or off")
    options: dict[str, Any] = Field({}, description="given to the program")
    timeout_s: float = Field(3600, gt=0, le=1e6)


class PeersSpec(NamedSpec):
    """Scenes that our sensor and all peers see in the same light."""

    name: str = Field(pattern=f"^{NAME}$")
    scenes: tuple[str, ...] = Field(min_length=1, description="names of shipped scenes, or paths relative to this file")
    sensor: SensorChoice
    duration_s: float = Field(0.1, gt=0, le=60)
    quality: float = Field(0.5, gt=0, le=100)
    seed: int = Field(7, ge=0, lt=2**63)
    fps: tuple[Rate, ...] = Field((1000.0,), min_length=1, description="pictures per second, one comparison for each")
    shutter: float = Field(1.0, gt=0, le=1, description="share of a picture's period that it is exposed")
    match_us: float = Field(10_000, gt=0, description="events farther apart in time are not the same event")
    peers: tuple[Peer, ...] = Field(min_length=1)
    folder: Path = Field(Path(), exclude=True)

    @model_validator(mode="after")
    def _check(self) -> "PeersSpec":
        names = [peer.name for peer in self.peers]
        if len(set(names)) != len(names):
            raise ValueError(f"peers: each name once; there are {', '.join(names)}")
        if self.duration_s * min(self.fps) < 3:
            raise ValueError(f"fps: fewer than three pictures in {self.duration_s:g} s")
        return self

    @property
    def duration_us(self) -> int:
        return round(self.duration_s * 1e6)


def read_peers(file: str | Path, overrides: Mapping[str, Any] | None = None) -> PeersSpec:
    """Read the file of a comparison, with dotted `overrides` applied before validation.

    Raises
    ------
    SpecError
        If the file is not valid; the message names file, line and key.
    """
    path = locate(Path(file).resolve(), "scenes")
    spec = read_spec(PeersSpec, path, overrides=overrides)
    return spec.model_copy(update={"folder": path.parent})
