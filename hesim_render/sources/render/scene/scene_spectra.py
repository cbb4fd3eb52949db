"""The spectra that a scene file names, and the wavelengths that these must cover."""

from collections.abc import Iterator, Mapping

from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene import lights
from hesim_render.specs.reflectance import leaves_of
from hesim_render.specs.scene import SceneSpec
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.specs.target import lamps_of
from hesim_render.spectral.spectrum import Spectrum, constant, require_coverage
from hesim_render.targets.build import placed_pieces
from hesim_render.targets.piece import Picture, TargetPiece


def target_pieces(spec: SceneSpec) -> list[TargetPiece]:
    """The parts of the scene's target; an error names the scene file where no other file is to blame."""
    assert spec.target is not None
    try:
        return placed_pieces(spec.target)
    except SpecError as error:
        if error.file is not None:
            raise
        raise SpecError(str(error), file=spec.file) from None


def named_spectra(spec: SceneSpec) -> Iterator[tuple[str, Spectrum]]:
    """Key and spectrum of a scene file's lights and reflectances; none in darkness or for a Mitsuba scene.

    The RGB colours of a Mitsuba scene become spectra over the whole visible range, so there is nothing to check.
    """
    lamp = lamps_of(spec.target)
    is_on = any(light.is_on for light in spec.lights) or any(own.is_on for own in spec.lamps)
    if spec.mitsuba is not None or not is_on:
        return
    for number, light in enumerate(spec.lights):
        if light.is_on:
            yield f"{lights.key_of(spec.lights, number)}.illuminant", light.illuminant.load()
    if spec.target is not None:
        if lamp is not None and lamp.is_on:
            yield "target.illuminant", lamp.illuminant.load()
        for piece in target_pieces(spec):
            if not isinstance(piece.reflectance, Picture):
                yield f"target ({piece.name})", piece.reflectance
            elif piece.reflectance.wavelength_nm is not None:
                ends = piece.reflectance.wavelength_nm[[0, -1]].tolist()
                yield f"target ({piece.name})", constant(1.0, *ends)
    for item in spec.objects:
        own = [("reflectance", item.reflectance), ("pattern", item.pattern)]
        if item.texture is not None or item.material is not None:
            own = [(f"material.{key}", source) for key, source in leaves_of(item.material or {}, SpectrumSpec)]
        if item.emission is not None and item.emission.is_on:
            own.append(("emission.illuminant", item.emission.illuminant))
        for key, source in own:
            if source is not None:
                yield f"objects.{item.name}.{key}", source.load()


def check_coverage(spec: SceneSpec, responses: Mapping[str, Spectrum]) -> None:
    """Refuse a scene in which a light or a reflectance covers less than 99.9 % of a response.

    Raises
    ------
    SpecError
        Names scene file and key.
    """
    for key, spectrum in named_spectra(spec):
        for name, response in responses.items():
            try:
                require_coverage(spectrum, response, "this spectrum", f"filter {name!r}")
            except SpecError as error:
                raise SpecError(str(error), file=spec.file, key=key) from None
