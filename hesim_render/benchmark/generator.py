"""Scenes by number: solids with materials, their motion, and their light, written as a scene file with its parts.

The camera is 2 m before the plane z = 0, of which it sees 1 m across: lengths in m are lengths in widths of the view.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.benchmark.draws import LIGHTS, MOTIONS, SOLIDS, draws, log_uniform, shares
from hesim_render.benchmark.lamps import lamps
from hesim_render.benchmark.materials import Palette, patch_names, write_texture
from hesim_render.benchmark.meshes import mesh
from hesim_render.benchmark.motions import CAMERA_Z, tracks
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile
from hesim_render.specs.benchmark import SPLITS, BenchmarkSpec
from hesim_render.spectral.spectrum import illuminant

SCENE_FILE = "scene.yaml"
_MESHES, _PICTURES = (".obj",), (".png", ".jpg", ".jpeg")
_FOV_DEG = float(np.degrees(2 * np.arctan(0.5 / CAMERA_Z)))
_WALL_Z, _WALL = -0.6, 6.0
_MAX_DEPTH = 3


@dataclass(frozen=True)
class GeneratedScene:
    """A scene and what it is made of.

    Parameters
    ----------
    content : of the scene file.
    texts, pictures : files beside it, by name: text, or arrays and files of pictures.
    parts : names of its parts, by which splits are compared: hashes of solids, materials, motions and lamps, and the
        shipped and given parts that were used.
    """

    content: dict[str, Any]
    texts: dict[str, str]
    pictures: dict[str, Any]
    parts: tuple[str, ...]

    def write(self, folder: Path) -> Path:
        """Write scene file and parts into a folder; returns the scene file."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in self.texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        for name, picture in self.pictures.items():
            write_texture(picture, folder / name)
        file = folder / SCENE_FILE
        file.write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")  # JSON is YAML, and fast to read
        return file


def _digest(kind: str, value: Any) -> str:
    text = json.dumps(value, sort_keys=True, default=str)
    return f"{kind}:{hashlib.sha256(text.encode()).hexdigest()[:32]}"


def _by_content(node: Any, files: dict[str, str]) -> Any:
    """A description in which hashes stand for the names of files."""
    if isinstance(node, dict):
        return {
            key: files.get(value, value) if key == "filename" else _by_content(value, files)
            for key, value in node.items()
        }
    return node


class Generator:
    """All generated scenes of a benchmark. Each is a pure function of the specification and its numbers.

    Raises
    ------
    SpecError
        If the folder of parts is missing or empty.
    """

    def __init__(self, spec: BenchmarkSpec) -> None:
        self.spec = spec
        weights = [spec.splits.train, spec.splits.val, spec.splits.test]
        self._weights, self._key = weights, str(spec.seed)
        by_split = shares(range(spec.scenes.count), weights, f"{spec.seed}/scenes")
        self._split = {number: SPLITS[k] for k, numbers in enumerate(by_split) for number in numbers}

    def check(self) -> None:
        """Find the user's parts and the illuminants.

        Raises
        ------
        SpecError
            If one is not there.
        """
        _ = self._given
        for name in self.spec.lights.illuminants:
            illuminant(name)

    def split_of(self, scene: int) -> str:
        """The split of a scene."""
        return self._split[scene]

    @cached_property
    def _patches(self) -> dict[str, list[str]]:
        return dict(zip(SPLITS, shares(patch_names(), self._weights, f"{self._key}/patches"), strict=True))

    @cached_property
    def _given(self) -> dict[str, list[Path]]:
        """The user's meshes and pictures of each split; files of the same bytes are one part."""
        if self.spec.scenes.parts is None:
            return {split: [] for split in SPLITS}
        folder = self.spec.folder / self.spec.scenes.parts
        result: dict[str, Path] = {}
        if folder.is_dir():
            for path in sorted(folder.rglob("*")):
                if path.suffix.lower() in _MESHES + _PICTURES and path.is_file():
                    result.setdefault(WholeFile(path).sha256(), path)
        if not result:
            raise SpecError(f"no mesh (OBJ) or picture (PNG, JPEG) in {folder}", key="scenes.parts")
        pools: dict[str, list[Path]] = {split: [] for split in SPLITS}
        for kinds in (_MESHES, _PICTURES):
            names = [key for key, path in result.items() if path.suffix.lower() in kinds]
            for split, keys in zip(SPLITS, shares(names, self._weights, f"{self._key}/parts"), strict=True):
                pools[split] += [result[key] for key in keys]
        return pools

    def given_files(self) -> list[Path]:
        """All files of the user's folder that are parts."""
        return [path for split in SPLITS for path in self._given[split]]

    def _pool(self, split: str, kinds: tuple[str, ...]) -> list[Path]:
        return [path for path in self._given[split] if path.suffix.lower() in kinds]

    def scene(self, scene: int, motion: int, light: int) -> GeneratedScene:
        """One scene, with one of its motions and one of its lights, all numbered from 0 on."""
        spec, seed, split = self.spec, self.spec.seed, self.split_of(scene)
        rng = draws(seed, SOLIDS, scene)
        palette = Palette(rng, spec.scenes, self._patches[split], self._pool(split, _PICTURES))
        shapes: dict[str, Any] = {"type": "scene"}
        texts: dict[str, str] = {}
        wall = np.diag([_WALL / 2, _WALL / 2, 1.0, 1.0])
        wall[2, 3] = _WALL_Z
        shapes["wall"] = {
            "type": "rectangle", "to_world": wall.tolist(), "bsdf": palette.material("wall", solid=False),
        }  # fmt: skip
        sizes: dict[str, float] = {}
        low, high = map(int, spec.scenes.objects)
        for k in range(int(rng.integers(low, high + 1))):
            name = f"solid{k}"
            sizes[name] = log_uniform(rng, spec.scenes.size)
            shapes[name] = self._solid(rng, name, sizes[name], palette, texts, self._pool(split, _MESHES))
        bodies = {name: shape for name, shape in shapes.items() if name != "type"}
        moving = tracks(draws(seed, MOTIONS, scene, motion), spec.motions, sizes, spec.duration_us)
        emitters, waveforms = lamps(draws(seed, LIGHTS, scene, light), spec.lights)
        files = {name: _digest("mesh", text) for name, text in texts.items()}
        files |= {
            name: f"file:{WholeFile(p).sha256()}" if isinstance(p, Path) else _digest("texture", p.tobytes().hex())
            for name, p in palette.files.items()
        }
        bodies = _by_content(bodies, files)
        parts = [*files.values(), *(_digest("solid", shape) for name, shape in bodies.items() if name != "wall")]
        parts += [_digest("material", shape["bsdf"]) for shape in bodies.values()]
        parts += [_digest("motion", {**track, "object": ""}) for track in moving]
        parts += [_digest("lamp", lamp) for lamp in emitters.values()]
        parts += [f"patch:{name}" for name in palette.measured]
        content = {
            "schema_version": 1,
            "name": f"scene{scene:06d}-m{motion}-l{light}",
            "description": f"Generated scene {scene}, motion {motion}, light {light} of {spec.name}.",
            "mitsuba": {"inline": {**shapes, **emitters}, "waveforms": waveforms},
            "camera": {"origin_m": [0, 0, CAMERA_Z], "target_m": [0, 0, 0], "horizontal_fov_deg": _FOV_DEG},
            "motion": moving,
            "max_depth": _MAX_DEPTH,
        }
        return GeneratedScene(content, texts, palette.files, tuple(sorted(set(parts))))

    def _solid(
        self, rng: np.random.Generator, name: str, size: float, palette: Palette, texts: dict[str, str],
        given: list[Path],
    ) -> dict[str, Any]:  # fmt: skip
        """A solid somewhere in the view: a sphere, a box, a cylinder, a plate, or a mesh."""
        from scipy.spatial.transform import Rotation

        kind = str(
            rng.choice(["sphere", "cube", "cylinder", "disk", "rectangle", "mesh"], p=[0.2] * 2 + [0.1] * 3 + [0.3])
        )
        extent = size * np.array([1.0, *rng.uniform(0.3, 1.0, 2)])
        if kind in ("sphere", "mesh"):
            extent[:] = size
        elif kind in ("disk", "cylinder"):
            extent[1] = extent[0]
        place = rng.uniform([-0.42, -0.3, -0.3], [0.42, 0.3, 0.35])
        matrix = np.eye(4)
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        matrix[:3, :3] = turn @ np.diag(extent if kind == "mesh" else extent / 2)
        matrix[:3, 3] = place
        shape: dict[str, Any] = {"type": kind, "to_world": matrix.round(9).tolist()}
        if kind == "mesh":
            if given and rng.random() < 0.5:
                source = given[int(rng.integers(len(given)))]
                shape |= {"type": "obj", "filename": f"{name}.obj"}
                shape["to_world"] = (matrix @ _into_cube(source)).round(9).tolist()
                palette.files[shape["filename"]] = source
            else:
                shape |= {"type": "obj", "filename": f"{name}.obj"}
                texts[f"{name}.obj"] = mesh(rng)
        shape["bsdf"] = palette.material(name, solid=kind not in ("disk", "rectangle", "cylinder", "mesh"))
        return shape


def _into_cube(file: Path) -> np.ndarray:
    """The map of an OBJ file's own coordinates into the cube of side 1 about the origin."""
    lines = [line.split()[1:4] for line in WholeFile(file).text().splitlines() if line.startswith("v ")]
    try:
        points = np.array(lines, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise SpecError("a vertex is not three numbers", file=file) from None
    extent = np.ptp(points, axis=0).max() if len(points) else 0.0
    if not 0 < extent < np.inf:
        raise SpecError("has no extent", file=file)
    matrix = np.diag([1 / extent] * 3 + [1.0])
    matrix[:3, 3] = -(points.min(axis=0) + points.max(axis=0)) / 2 / extent
    return matrix
