"""Names and numbers of objects, instances and materials of a scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import MitsubaModule, MitsubaObject, UInt32
from hesim_render.sources.render.scene.builder import BuiltScene
from hesim_render.sources.render.transport.moving_scene import MovingScene

#: Name of number 0: nothing was met.
NOTHING = "background"


@dataclass(frozen=True)
class Names:
    """What rays can meet. Numbers of all kinds begin at 1; 0 is the background.

    Parameters
    ----------
    objects : names of objects by number. An object of a scene file may have several shapes, such as the patches of a
        target; a shape of a Mitsuba scene is an object of its own, under its id.
    instances : ids of shapes by number.
    materials : names of reflection models by number.
    object_of : [instances + 1], number of the object of each instance.
    group_of : [objects + 1], number of the moving group of each object, −1 where it rests.
    """

    objects: tuple[str, ...]
    instances: tuple[str, ...]
    materials: tuple[str, ...]
    object_of: NDArray[np.uint16]
    group_of: NDArray[np.int64]
    _of_shape: NDArray[np.uint16]
    _of_material: NDArray[np.uint16]

    @classmethod
    def of(cls, mi: MitsubaModule, built: BuiltScene, parts: MovingScene) -> "Names":
        """Names of a loaded scene."""
        objects, instances, materials = [NOTHING], [NOTHING], [NOTHING]
        object_of, of_shape, of_material = [0], {0: 0}, {0: 0}
        for name, shape in parts.shapes.items():
            owner = built.object_of_shape.get(name, name)
            if owner not in objects:
                objects.append(owner)
            of_shape[_number(mi.ShapePtr, shape)] = len(instances)
            instances.append(name)
            object_of.append(objects.index(owner))
            if shape.bsdf() is not None:
                number = _number(mi.BSDFPtr, shape.bsdf())
                if number not in of_material:
                    of_material[number] = len(materials)
                    materials.append(_material_name(shape.bsdf().id(), name))
        groups = {group.name: number for number, group in enumerate(parts.groups)}
        group_of = np.array([groups.get(name, -1) for name in objects], np.int64)
        return cls(
            tuple(objects), tuple(instances), tuple(materials), np.array(object_of, np.uint16), group_of,
            _table(of_shape), _table(of_material),
        )  # fmt: skip

    def instance(self, shape: NDArray[np.uint32]) -> NDArray[np.uint16]:
        """Numbers of instances, from Dr.Jit's numbers of shapes."""
        return self._of_shape[np.minimum(shape, self._of_shape.size - 1)]

    def material(self, number: NDArray[np.uint32]) -> NDArray[np.uint16]:
        """Numbers of materials, from Dr.Jit's; that of a shape group's own shapes is 0."""
        return self._of_material[np.minimum(number, self._of_material.size - 1)]


def _table(numbers: dict[int, int]) -> NDArray[np.uint16]:
    """Numbers by Dr.Jit's number, with a last entry of 0 for all that are not known."""
    table = np.zeros(max(numbers) + 2, np.uint16)
    for key, value in numbers.items():
        table[key] = value
    return table


def _material_name(own: str, shape: str) -> str:
    return own if own and not own.startswith("_") else f"material of {shape}"


def _number(pointer: MitsubaObject, thing: MitsubaObject) -> int:
    """The number by which Dr.Jit identifies an object of Mitsuba."""
    import mitsuba as mi

    number: UInt32 = dr.reinterpret_array(mi.UInt32, pointer(thing))
    return int(number[0])
