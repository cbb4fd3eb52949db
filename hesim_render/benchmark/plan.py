"""The clips of a benchmark: every combination of its axes, each with a name, a split and its own settings."""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hesim_render.benchmark.draws import AUDITS, CLIPS, EXPOSURES, draws, log_uniform
from hesim_render.benchmark.generator import GeneratedScene, Generator
from hesim_render.core.errors import SpecError
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.sources.scene import Scene, load_scene
from hesim_render.specs.benchmark import BenchmarkSpec, SensorChoice
from hesim_render.specs.files import content_hash


@dataclass(frozen=True)
class Clip:
    """One clip: numbers on the axes of its benchmark, and what follows from them.

    Parameters
    ----------
    name : of the clip and of its folder.
    split : to which its scene belongs.
    scene, motion, light : numbers of a generated scene; scene counts on through the given ones, whose motion and light
        are 0.
    sensor, exposure, noise, seed : numbers on these axes.
    exposure_us : exposure of its frames, µs; None keeps the sensor's own.
    """

    name: str
    split: str
    scene: int
    motion: int
    light: int
    sensor: int
    exposure: int
    noise: int
    seed: int
    exposure_us: int | None

    def as_dict(self) -> dict[str, Any]:
        """All fields, as plain values."""
        return asdict(self)


class BenchmarkPlan:
    """All clips of a benchmark. Scenes and sensors are made when a clip asks for them."""

    def __init__(self, spec: BenchmarkSpec) -> None:
        self.spec, self.generator = spec, Generator(spec)

    @cached_property
    def clips(self) -> list[Clip]:
        """The clips, in order of their names on the axes; at most `spec.clips`, drawn so that scenes take turns."""
        spec = self.spec
        combinations = list(self._combinations())
        if spec.clips is not None and spec.clips < len(combinations):
            rng = draws(spec.seed, CLIPS)
            rank = rng.permutation(len(combinations))
            turn: dict[int, int] = {}
            order = []
            for k in rank:  # the first of every scene, then the second of every scene, and so on
                scene = combinations[k][0]
                order.append((turn.setdefault(scene, 0), int(k)))
                turn[scene] += 1
            combinations = [combinations[k] for k in sorted(k for _, k in sorted(order)[: spec.clips])]
        return [self._clip(*numbers) for numbers in combinations]

    def _combinations(self) -> Any:
        spec = self.spec
        scenes = [
            *itertools.product(range(spec.scenes.count), range(spec.motions.count), range(spec.lights.count)),
            *((spec.scenes.count + k, 0, 0) for k in range(len(spec.scenes.given))),
        ]
        others = [range(len(axis)) for axis in (spec.sensors, spec.exposures_us or (None,), spec.noise, spec.seeds)]
        for scene, rest in itertools.product(scenes, itertools.product(*others)):
            yield (*scene, *rest)

    def _clip(self, scene: int, motion: int, light: int, sensor: int, exposure: int, noise: int, seed: int) -> Clip:
        spec = self.spec
        given = scene - spec.scenes.count
        split = spec.scenes.given[given].split if given >= 0 else self.generator.split_of(scene)
        exposure_us = None
        if spec.exposures_us:
            rng = draws(spec.seed, EXPOSURES, scene, motion, light, sensor, exposure)
            exposure_us = round(log_uniform(rng, spec.exposures_us[exposure]))
        name = f"s{scene:06d}-m{motion}-l{light}-{sensor_name(spec.sensors[sensor])}"
        name += f"-e{exposure}" if len(spec.exposures_us) > 1 else ""
        name += f"-{spec.noise[noise].name}-r{spec.seeds[seed]}"
        return Clip(name, split, scene, motion, light, sensor, exposure, noise, seed, exposure_us)

    def scene_files(self, clip: Clip) -> GeneratedScene | None:
        """The generated scene of a clip; None for a given one."""
        if clip.scene >= self.spec.scenes.count:
            return None
        return self.generator.scene(clip.scene, clip.motion, clip.light)

    def given_scene(self, clip: Clip) -> Scene:
        """The scene file that a clip names."""
        entry = self.spec.scenes.given[clip.scene - self.spec.scenes.count]
        key = f"scenes.given.{clip.scene - self.spec.scenes.count}.scene"
        return load_scene(file_of(self.spec.folder, entry.scene, key))

    def given_parts(self, clip: Clip) -> tuple[str, ...]:
        """The parts of a given scene: its content, and each of its objects and its target."""
        spec = self.given_scene(clip).spec
        parts = [f"scene:{content_hash(spec)}", *(f"object:{content_hash(item)}" for item in spec.objects)]
        if spec.target is not None:
            parts.append(f"target:{content_hash(spec.target)}")
        return tuple(sorted(set(parts)))

    def sensor(self, clip: Clip) -> Sensor:
        """The sensor of a clip, with its region, exposure and changed keys."""
        choice, level = self.spec.sensors[clip.sensor], self.spec.noise[clip.noise]
        changes: dict[str, Any] = {**choice.set, **level.set}
        if clip.exposure_us is not None:
            changes["aps.exposure_us"] = clip.exposure_us
        return chosen_sensor(choice, self.spec.folder, f"sensors.{clip.sensor}.sensor", changes)

    def is_audited(self, clip: Clip) -> bool:
        """True if the render of a clip is audited; a pure function of the specification and the clip's numbers."""
        numbers = (clip.scene, clip.motion, clip.light, clip.sensor, clip.exposure, clip.noise, clip.seed)
        return bool(draws(self.spec.seed, AUDITS, *numbers).random() < self.spec.audit)

    def check(self) -> None:
        """Load every sensor and given scene once, and see that splits share no part of a given scene.

        Raises
        ------
        SpecError, RangeError
            If a sensor, a scene or a combination is not valid, or a given scene stands in two splits.
        """
        from hesim_render.capture.run_settings import noise_models
        from hesim_render.recording.truth_file import truth_kinds

        truth_kinds(self.spec.truth)
        seen: set[tuple[int, int]] = set()
        owner: dict[str, str] = {}
        for clip in self.clips:
            if (clip.sensor, clip.noise) not in seen:
                seen.add((clip.sensor, clip.noise))
                level = self.spec.noise[clip.noise]
                for limit in self._exposure_limits(clip):
                    choice = self.spec.sensors[clip.sensor]
                    changes = {**choice.set, **level.set, **limit}
                    sensor = chosen_sensor(choice, self.spec.folder, f"sensors.{clip.sensor}.sensor", changes)
                noise_models(sensor, level.clean, level.without)
                if self.spec.exposures_us and sensor.spec.aps is None:
                    raise SpecError(f"{sensor.name} has no frames to expose", key="exposures_us")
                if self.spec.sharp is not None and sensor.spec.aps is None:
                    raise SpecError(f"{sensor.name} has no frame pixels to be sharp", key="sharp")
            if clip.scene >= self.spec.scenes.count:
                for part in self.given_parts(clip):
                    if owner.setdefault(part, clip.split) != clip.split:
                        raise SpecError(
                            f"{self.spec.scenes.given[clip.scene - self.spec.scenes.count].scene} shares a part "
                            f"({part[:20]}…) with a scene of the split {owner[part]}, and splits must not leak",
                            key=f"scenes.given.{clip.scene - self.spec.scenes.count}",
                        )
        self.generator.check()

    def _exposure_limits(self, clip: Clip) -> list[dict[str, Any]]:
        if clip.exposure_us is None:
            return [{}]
        low, high = self.spec.exposures_us[clip.exposure]
        return [{"aps.exposure_us": round(low)}, {"aps.exposure_us": round(high)}]


def file_of(folder: Path, name: str, key: str) -> str | Path:
    """A shipped name, or the path of a YAML file relative to a folder.

    Raises
    ------
    SpecError
        If there is no such file; the message names the key.
    """
    path = folder / name
    if Path(name).suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise SpecError(f"no such file: {path}", key=key)
        return path
    return name


def chosen_sensor(choice: SensorChoice, folder: Path, key: str, changes: Mapping[str, Any]) -> Sensor:
    """A sensor with its region, and with changed keys in place of those of the choice.

    Parameters
    ----------
    choice, folder, key : the choice, the folder of its file, and its key, for errors.
    changes : keys of the sensor file.
    """
    sensor = load_sensor(file_of(folder, choice.sensor, key), changes)
    if choice.roi is None:
        return sensor
    size, *offset = choice.roi.split("+")
    width, height = map(int, size.split("x"))
    return sensor.crop(width, height, *map(int, offset))


def sensor_name(choice: SensorChoice) -> str:
    """Name of a sensor in the names of clips."""
    return choice.name or Path(choice.sensor).stem


def shared_parts(parts: Mapping[str, tuple[str, set[str]]]) -> list[tuple[str, str, str]]:
    """Parts that scenes of different splits have in common.

    Parameters
    ----------
    parts : split and parts of each scene, by its name.

    Returns
    -------
    Part and the two splits, for each part of that kind.
    """
    owner: dict[str, str] = {}
    result = []
    for split, names in parts.values():
        for name in sorted(names):
            if owner.setdefault(name, split) != split:
                result.append((name, owner[name], split))
    return sorted(set(result))
