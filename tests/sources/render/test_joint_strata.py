"""Smaller errors by strata of place and first surface together: lamps in closed form, paths, and shared paths."""

import numpy as np
import pytest
from rendering import mono

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.shared_tracer import Tiles
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.sampling.sampler import permute, sampler_class
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

#: A plate above a checked floor, below a lamp: penumbrae on checks of two to three pixels.
PLATE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>
  <sensor type="perspective"><float name="fov" value="31"/>
    <transform name="to_world"><lookat origin="0.3, -0.4, 1.9" target="0.05, 0.02, 0" up="0, 1, 0"/></transform>
  </sensor>
  <shape type="rectangle" id="floor"><transform name="to_world"><scale value="1.3"/></transform>
    <bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
      <rgb name="color0" value="0.73, 0.6, 0.4"/><rgb name="color1" value="0.12, 0.2, 0.25"/>
      <transform name="to_uv"><scale x="14" y="14"/></transform></texture></bsdf></shape>
  <shape type="cube" id="plate"><transform name="to_world"><scale x="0.2" y="0.15" z="0.01"/>
    <rotate z="1" angle="17"/><translate x="-0.1" y="0.05" z="0.35"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.5, 0.6"/></bsdf></shape>
  <shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="180"/><scale x="0.4" y="0.3"/>
    <translate x="0.5" y="0.1" z="1.6"/></transform>
    <emitter type="area"><rgb name="radiance" value="7, 6, 5"/></emitter></shape>
</scene>"""
XML = "mitsuba: {file: scene.xml, radiance_scale: 0.7}\n"
#: A plate just above an even floor: penumbrae of a few pixels, by lamps in closed form.
OBJECTS = """objects:
- {name: floor, shape: box, size_m: [2.6, 2.6, 0.02], position_m: [0, 0, -0.01], reflectance: 0.45}
- {name: plate, shape: box, size_m: [0.4, 0.3, 0.001], position_m: [-0.155, 0.05, 0.006], reflectance: 0.3}
light: {type: area, illuminant: D50, illuminance_lux: 700, position_m: [0.5, 0.1, 1.6], size_m: [0.8, 0.6]}
camera: {origin_m: [0.3, -0.4, 1.9], target_m: [0.05, 0.02, 0], horizontal_fov_deg: 31}
"""


@pytest.mark.slow
@pytest.mark.parametrize(("depth", "shared"), [(1, False), (3, False), pytest.param(3, True, marks=pytest.mark.slow)])
def test_penumbrae_have_smaller_errors_than_with_directions_drawn_apart(tmp_path, monkeypatch, depth, shared):
    """RMS error of pixels, by five repetitions of 1024 rays: lamps in closed form, paths, and paths in tiles; and the
    same mean.
    """
    (tmp_path / "scene.xml").write_text(PLATE.format(depth=depth))
    head = "schema_version: 1\nname: plate\ndescription: .\n"
    (tmp_path / "scene.yaml").write_text(head + (XML if depth > 1 else OBJECTS))
    windows = Windows(np.array([7000.0]), np.array([7900.0]))

    def means():
        source = ChangeDrivenFlux(hr.load_scene(str(tmp_path / "scene.yaml")), mono(28, 20), seed=11)
        tracer, pixel = source._tracer, source._index[source.sensor.layout.evs_pixel.ravel()]
        assert tracer.is_diffuse == (depth == 1)
        given = pixel, np.zeros(pixel.size, np.int64), windows, np.full(pixel.size, 1024)
        if shared:
            tiles = Tiles(source._renderer.sharing.lattice)
            traced = [tracer._of_tiles(*given, tiles, Stream.RENDER, None, repeat)[1] for repeat in range(5)]
        else:
            traced = [tracer.trace(*given, np.ones(pixel.size, bool), repeat=repeat) for repeat in range(5)]
        return np.array([flux.mean for flux in traced], np.float64)

    def apart(sampler):
        key = sampler.keys[1] + 77 * sampler.dimension
        return permute(sampler.sample, sampler._mask, key)

    together = means()
    monkeypatch.setattr(sampler_class(mitsuba().variant()), "_surface_point", apart)
    separate = means()
    ratio = np.sqrt(together.var(axis=0, ddof=1).sum() / separate.var(axis=0, ddof=1).sum())
    assert ratio < 0.8
    spread = np.sqrt((together.var(axis=0, ddof=1) + separate.var(axis=0, ddof=1)).sum() / 5)
    assert abs((together.mean(axis=0) - separate.mean(axis=0)).sum()) < 4 * spread
