"""A scene as Mitsuba's parser has read it: what it names is checked before it is built."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.files import SceneFiles
from hesim_render.sources.render.scene.mitsuba_version import plugin_folder, settle_normals
from hesim_render.sources.render.scene.vertex_normals import MESH_FILES, brings_normals


def load_mitsuba_scene(
    mi: MitsubaModule, source: Path | dict[str, Any], review: Callable[[Any], None], root: Path | None = None
) -> MitsubaObject:
    """Load a scene from an XML file or a dictionary, without merging shapes.

    Parameters
    ----------
    mi : the mitsuba module.
    source : path of an XML file, or a dictionary.
    review : called with the `ParserState` before the scene is built; it may change the state.
    root : folder that must contain all files that the scene names, and in which the names in a dictionary are looked
        up first; None allows all.
    """
    parser = mi.parser
    config = parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    resolver = mi.file_resolver()  # type: ignore[operator]  # the stubs declare it as a plain object
    inner = mi.FileResolver(resolver)
    if isinstance(source, Path):
        inner.prepend(str(source.resolve().parent))
    elif root is not None:
        inner.prepend(str(root.resolve()))
    mi.set_file_resolver(inner)
    try:
        if isinstance(source, Path):
            SceneFiles(mi.FileResolver(inner), root).check_xml(source)
            state = parser.parse_file(config, str(source))
        else:
            SceneFiles(inner, root).check_dictionary(source, None)
            inner.prepend(str(plugin_folder(mi)))  # to read a dictionary is to load its plugins
            state = parser.parse_dict(config, source)
        parser.transform_all(config, state)
        mi.file_resolver().prepend(str(plugin_folder(mi)))  # type: ignore[operator]  # again: <path> puts its own folder first
        SceneFiles(mi.file_resolver(), root).check_state(  # type: ignore[operator]
            mi, state, source if isinstance(source, Path) else None
        )
        review(state)
        needs_normals = _without_normals(state)
        scene = parser.instantiate(config, state)
    finally:
        mi.set_file_resolver(resolver)
    settle_normals(mi.traverse(scene), needs_normals)
    return scene


def _without_normals(state: Any) -> Callable[[str], bool]:
    """Tell of a shape's name in a parsed scene whether it is a mesh from files without normals.

    Raises
    ------
    SpecError
        If a 'merge' has meshes of both kinds, whose vertices cannot be distinguished afterwards.
    """
    files = {}
    for number, node in enumerate(state.nodes):
        own = node.props
        if own.plugin_name() in MESH_FILES and not own.get("face_normals", False):
            path = Path(_opened(own["filename"]))
            # Mitsuba says what is wrong with a file that is not there
            files[number] = path.is_file() and not brings_normals(path, own.get("shape_index", 0))
    merged = set()
    for node in state.nodes:
        if node.props.plugin_name() == "merge":
            merged |= {files[number] for number in children_of(node) if number in files}
    if len(merged) == 2:
        raise SpecError("shape 'merge': some of its meshes have normals of their vertices and others do not; take the "
                        "meshes out of 'merge'")  # fmt: skip
    named = {node.props.id(): files.get(number, False) for number, node in enumerate(state.nodes)
             if node.props.plugin_name() != "merge"}  # fmt: skip
    return lambda name: named.get(name, merged == {True})


def children_of(node: Any) -> list[int]:
    """Numbers of the nodes that a node of a parsed scene refers to."""
    import mitsuba as mi

    resolved = mi.Properties.Type.ResolvedReference
    return [node.props[key].index() for key in node.props if node.props.type(key) == resolved]


def _opened(name: str) -> str:
    """The file that Mitsuba opens for a name: without one in its folders, that of the working folder."""
    import mitsuba as mi

    path = Path(str(mi.file_resolver().resolve(name)))  # type: ignore[operator]
    return str(path.absolute() if path.exists() else path)


def switch_off(state: Any, shines: Callable[[str], bool], names: Sequence[str]) -> None:
    """Remove the unwanted emitters from a parsed scene. A shape without its emitter stays.

    Parameters
    ----------
    state : the `ParserState`.
    shines : True for the name of a wanted emitter; the name is the id of its shape, or its own.
    names : names that must belong to emitters of the scene.

    Raises
    ------
    SpecError
        If a name does not belong to an emitter.
    """
    import mitsuba as mi

    nodes, known = state.nodes, set()
    for node in nodes:
        properties = node.props
        for key in list(properties.keys()):
            if properties.type(key) != mi.Properties.Type.ResolvedReference:
                continue
            child = nodes[properties[key].index()]
            if child.type != mi.ObjectType.Emitter:
                continue
            both = [node.props.id(), child.props.id()] if node.type == mi.ObjectType.Shape else [child.props.id()]
            # an emitter's own name counts only if it was asked for: a dictionary may name every emitter 'emitter'
            name = next((name for name in both if name in names), both[0])
            known.add(name)
            if not shines(name):
                del properties[key]
    for name in names:
        if name not in known:
            there = ", ".join(sorted(repr(k) for k in known if k)) or "none with a name"
            raise SpecError(f"no emitter {name!r} in the Mitsuba scene; there are {there}")
