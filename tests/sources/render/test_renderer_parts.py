"""Faces and balls that are met in closed form, against Mitsuba's own search and its own surfaces."""

import drjit as dr
import numpy as np
import pytest
from rendering import mitsuba_scene, mono, pair_tracer, traced

from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport import closed_form as parts
from hesim_render.sources.render.transport import moving_scene as moving
from hesim_render.sources.render.transport.closed_form import Part, surface_of

COUNT = 100_000


def placed(seed, size=0.3, at=(0.0, 0.0, 0.0)):
    """A turned, stretched and shifted shape of Mitsuba's."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ np.diag(size * rng.uniform(0.5, 1.5, 3))
    matrix[:3, 3] = at
    return mitsuba().ScalarTransform4f(matrix)


def mesh(vertices, triangles, uv=None, normals=None):
    mi = mitsuba()
    has = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uv is not None}
    made = mi.Mesh("mesh", len(vertices), len(triangles), **has)
    changed = mi.traverse(made)
    changed["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    changed["faces"] = np.ravel(triangles).astype(np.uint32)
    if uv is not None:
        changed["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    if normals is not None:
        changed["vertex_normals"] = np.ravel(normals).astype(np.float32)
    changed.update()
    return made


def scene_of(*shapes):
    return mitsuba().load_dict({"type": "scene", **{f"shape_{k}": shape for k, shape in enumerate(shapes)}})


def rays():
    """Of which some start inside or between the shapes."""
    mi, rng = mitsuba(), np.random.default_rng(1)
    origin = rng.normal(size=(3, COUNT)) * rng.choice([0.2, 1.0], COUNT)
    direction = -origin + rng.normal(size=(3, COUNT)) * 0.3
    direction /= np.linalg.norm(direction, axis=0)
    ray = mi.Ray3f(mi.Point3f(origin.astype(np.float32)), mi.Vector3f(direction.astype(np.float32)))
    ray.maxt = from_host(mi.Float, rng.choice([np.inf, 0.7], COUNT))
    return ray


SQUARE = np.array([[0, 0, 0], [0.4, 0, 0.1], [0.5, 0.3, 0.2], [0.1, 0.3, 0.1]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
BOXES = {
    "rectangle": lambda: [{"type": "rectangle", "to_world": placed(1)}],
    "flipped": lambda: [{"type": "rectangle", "to_world": placed(2), "flip_normals": True}],
    "box": lambda: [{"type": "cube", "to_world": placed(3, 0.2)}],
    "no texture coordinates": lambda: [mesh(SQUARE, HALVES)],
    "texture that differs between the halves": lambda: [
        mesh(SQUARE, HALVES, uv=[[0, 0], [1, 0.2], [0.9, 1], [0.1, 0.7]])
    ],
    "corners in another order": lambda: [mesh(SQUARE, [[1, 2, 0], [3, 0, 2]])],
    "corners of their own": lambda: [mesh(SQUARE[[0, 1, 2, 0, 2, 3]], [[0, 1, 2], [5, 3, 4]])],
    "balls": lambda: [{"type": "sphere", "center": [0.1 * k, 0.2, 0], "radius": 0.1 + 0.2 * k} for k in range(2)],
    "all together": lambda: [
        {"type": "rectangle", "to_world": placed(4, 1.0)},
        {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.25, "flip_normals": True},
        {"type": "cube", "to_world": placed(5, 0.2)},
    ],
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in ("flipped", "box", "corners of their own") else n for n in BOXES],
)
def test_hits_and_surfaces_are_those_of_mitsuba(name):
    import drjit as dr

    mi = mitsuba()
    scene = scene_of(*BOXES[name]())
    part = Part(mi, scene, apart=False)
    ray, everywhere = rays(), mi.Bool(True)
    assert part._scene is None
    theirs = scene.ray_intersect(ray)
    hit, face = part.nearest(ray, False, everywhere)
    ours = surface_of([part], hit, face, ray, mi.RayFlags.All, everywhere)

    met, wanted = np.array(hit.is_valid()), np.array(theirs.is_valid())
    assert 0.05 < wanted.mean() < 0.9
    # a ray that grazes an edge may fall to the other side by rounding
    agree = met == wanted
    assert agree.mean() > 0.9999
    both = met & wanted
    same = both & np.isclose(np.array(hit.t), np.array(theirs.t), rtol=0, atol=3e-5)
    assert same.sum() > 0.9999 * both.sum()
    assert np.all(np.isinf(np.array(hit.t)[~met]))
    for field, told, known in [
        ("p", ours.p, theirs.p),
        ("n", ours.n, theirs.n),
        ("uv", ours.uv, theirs.uv),
        ("frame n", ours.sh_frame.n, theirs.sh_frame.n),
        ("frame s", ours.sh_frame.s, theirs.sh_frame.s),
        ("frame t", ours.sh_frame.t, theirs.sh_frame.t),
        ("dp_du", ours.dp_du, theirs.dp_du),
        ("dp_dv", ours.dp_dv, theirs.dp_dv),
        ("wi", ours.wi, theirs.wi),
    ]:
        off = np.abs(np.array(told) - np.array(known))[:, same]
        # where u or v of a ball turns over, or a diagonal is met, rounding decides
        assert np.mean(off.max(axis=0) < 2e-4) > 0.9995, field
    for field in ("shape", "prim_index"):
        told, known = getattr(ours, field), getattr(theirs, field)
        if field == "shape":
            told, known = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (told, known))
        assert np.mean(np.array(told)[same] == np.array(known)[same]) > 0.9999, field

    blocked = np.array(part.blocks(ray, everywhere))
    assert np.mean(blocked == np.array(scene.ray_test(ray))) > 0.9999
    np.testing.assert_array_equal(blocked, met)


@pytest.mark.parametrize(("balls", "apart"), [(1, True), (3, False), (parts._MOST_BALLS + 1, False)])
def test_a_few_balls_beside_other_shapes_are_met_in_closed_form(balls, apart):
    """Boxes, a disk and balls that cover one another, one turned inside out."""
    import drjit as dr

    mi, rng = mitsuba(), np.random.default_rng(9)
    shapes = [{"type": "cube", "to_world": placed(k, 0.15, rng.uniform(-0.5, 0.5, 3))} for k in range(3)]
    shapes += [{"type": "disk", "to_world": placed(11, 0.3)}]
    shapes[1:1] = [
        {"type": "sphere", "center": rng.uniform(-0.6, 0.6, 3).tolist(), "radius": 0.1 + 0.3 / (k + 1)}
        for k in range(balls)
    ]
    shapes[1]["flip_normals"] = True
    scene = scene_of(*shapes)
    part = Part(mi, scene, apart)
    assert [len(part._balls), part._scene is scene] == ([0, True] if balls > parts._MOST_BALLS else [balls, False])
    ray, everywhere = rays(), mi.Bool(True)
    theirs = scene.ray_intersect(ray)
    hit, face = part.nearest(ray, False, everywhere)
    ours = surface_of([part], hit, face, ray, mi.RayFlags.All, everywhere)
    met, wanted = np.array(hit.is_valid()), np.array(theirs.is_valid())
    assert 0.05 < wanted.mean() < 0.95
    assert np.mean(met == wanted) > 0.9999
    both = met & wanted
    told, known = (dr.reinterpret_array(mi.UInt32, si.shape) for si in (ours, theirs))
    same = both & (np.array(told) == np.array(known))
    assert same.sum() > 0.9999 * both.sum()
    for told, known in [(ours.t, theirs.t), (ours.p, theirs.p), (ours.n, theirs.n), (ours.wi, theirs.wi)]:
        off = np.abs(np.array(told)[..., same] - np.array(known)[..., same])
        assert np.mean(off < 2e-4) > 0.9995
    asked = from_host(mi.Bool, np.arange(COUNT) % 3 != 1)
    blocked = np.array(part.blocks(ray, asked))
    assert np.mean(blocked == np.array(scene.ray_test(ray, asked))) > 0.9999
    np.testing.assert_array_equal(np.array(part.nearest(ray, False, asked)[0].is_valid()), met & np.array(asked))


def test_balls_beside_instances_are_left_to_mitsuba():
    """It cannot put an instance into a second scene."""
    mi = mitsuba()
    shapes = {"group": {"type": "shapegroup", "box": {"type": "cube", "to_world": placed(2, 0.2)}}}
    shapes["ball"] = {"type": "sphere", "center": [0.1, -0.3, 0.2], "radius": 0.3}
    for k in range(2):
        move = mi.ScalarTransform4f().translate([0.4 * k, 0.1, -0.2])
        shapes[f"copy_{k}"] = {"type": "instance", "to_world": move, "ref": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", **shapes})
    part = Part(mi, scene, apart=False)
    assert part._scene is scene
    assert not part._balls


def test_masked_lanes_meet_nothing():
    mi = mitsuba()
    part = Part(mi, scene_of(*BOXES["all together"]()), apart=False)
    asked = from_host(mi.Bool, np.arange(COUNT) % 2 == 0)
    hit, face = part.nearest(rays(), False, asked)
    for found in (hit.is_valid(), face != 0, part.blocks(rays(), asked)):
        assert np.array(found)[::2].any()
        assert not np.array(found)[1::2].any()


def test_a_ray_leaves_the_surface_it_starts_from():
    """From a ball of 1 mm to 100 m, outwards and inwards."""
    mi, rng = mitsuba(), np.random.default_rng(3)
    outward = rng.normal(size=(3, COUNT))
    outward /= np.linalg.norm(outward, axis=0)
    turned = rng.normal(size=(3, COUNT))
    turned /= np.linalg.norm(turned, axis=0)
    for radius in (1e-3, 0.2, 100.0):
        scene = scene_of({"type": "sphere", "center": [0.5, 0.1, -1.0], "radius": radius})
        part = Part(mi, scene, apart=False)
        start = np.array([0.5, 0.1, -1.0])[:, None] + 3 * radius * outward
        ray = mi.Ray3f(mi.Point3f(start.astype(np.float32)), mi.Vector3f((-outward).astype(np.float32)))
        hit, _ = part.nearest(ray, False, mi.Bool(True))
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, mi.Bool(True))
        assert np.array(si.is_valid()).all()
        onwards = si.spawn_ray(mi.Vector3f(turned.astype(np.float32)))
        t = np.array(part.nearest(onwards, False, mi.Bool(True))[0].t)
        side = np.sum(turned * outward, axis=0)
        assert np.isinf(t[side > 0.05]).all()
        # Mitsuba starts 0.1 mm off the surface; from there, in double precision
        into = side < -0.2
        to = np.array(onwards.o, np.float64)[:, into] - np.array([0.5, 0.1, -1.0])[:, None]
        along = np.sum(to * np.array(onwards.d, np.float64)[:, into], axis=0)
        far = -along + np.sqrt(along**2 - np.sum(to**2, axis=0) + radius**2)
        np.testing.assert_allclose(t[into], far, rtol=1e-3)


def test_a_ray_leaves_the_face_it_starts_from():
    """To both sides, also at grazing angles, from places up to 100 m off."""
    mi, rng = mitsuba(), np.random.default_rng(4)
    for size in (1e-2, 1.0, 100.0):
        placing = placed(6, size, at=(0.3 * size, -size, 0.2 * size))
        part = Part(mi, scene_of({"type": "rectangle", "to_world": placing}), apart=False)
        inside = rng.uniform(-0.9, 0.9, (2, COUNT))
        matrix = np.array(placing.matrix, np.float64).reshape(4, 4)
        middle = matrix[:3, :2] @ inside + matrix[:3, 3:]
        normal = np.cross(matrix[:3, 0], matrix[:3, 1])
        normal /= np.linalg.norm(normal)
        ray = mi.Ray3f(mi.Point3f((middle + size * normal[:, None]).astype(np.float32)), mi.Vector3f(-normal))
        hit, face = part.nearest(ray, False, mi.Bool(True))
        si = surface_of([part], hit, face, ray, mi.RayFlags.All, mi.Bool(True))
        assert np.array(face).min() == 1
        turned = rng.normal(size=(3, COUNT))
        turned /= np.linalg.norm(turned, axis=0)
        onwards = si.spawn_ray(mi.Vector3f(turned.astype(np.float32)))
        assert not np.array(part.nearest(onwards, False, mi.Bool(True))[0].is_valid()).any()
        assert not np.array(part.blocks(onwards, mi.Bool(True))).any()


@pytest.mark.parametrize(
    "shapes",
    [
        pytest.param(lambda: [{"type": "cylinder"}], id="cylinder"),
        pytest.param(lambda: [{"type": "rectangle"}, {"type": "disk"}], id="a disk too"),
        pytest.param(
            lambda: [{"type": "rectangle", "to_world": placed(k, at=(0, 0, 0.1 * k))} for k in range(parts._MOST + 1)],
            id="too many",
        ),
        pytest.param(lambda: [mesh(SQUARE[:3], [[0, 1, 2]])], id="one triangle"),
        pytest.param(
            lambda: [mesh(np.add(SQUARE, [[0.1 * (k == 2), 0, 0] for k in range(4)]), HALVES)], id="trapezium"
        ),
        pytest.param(lambda: [mesh(SQUARE[[0, 1, 2, 2, 1, 0]], [[0, 1, 2], [3, 4, 5]])], id="the same twice"),
        pytest.param(lambda: [mesh(SQUARE * [1, 0, 0], HALVES)], id="without area"),
        pytest.param(
            lambda: [mesh(SQUARE, HALVES, normals=[[0, 0, 1], [0, 0.6, 0.8], [0, 0, 1], [0, 0, 1]])], id="smooth"
        ),
    ],
)
def test_anything_else_is_left_to_mitsuba(shapes):
    mi = mitsuba()
    scene = scene_of(*shapes())
    for apart in (False, True):
        part = Part(mi, scene, apart)
        assert part._scene is scene
        assert part.face_count == 0
        ray = rays()
        np.testing.assert_array_equal(
            np.array(part.nearest(ray, False, mi.Bool(True))[0].t), np.array(scene.ray_intersect_preliminary(ray).t)
        )


@pytest.mark.slow
def test_an_even_sky_is_left_to_the_surfaces_own_directions():
    """A lamp and a sky: no light is sampled towards the sky, all of it arrives; a sky alone is sampled.

    Differences over their standard errors, of both ways of sampling: beyond 4.5 in one of 10^5 runs.
    """
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 0.05}}
    floor = {"type": "rectangle", "bsdf": grey}
    lamp = {
        "type": "rectangle",
        "to_world": [[0.2, 0, 0, 0.3], [0, -0.2, 0, 0], [0, 0, -0.2, 0.7], [0, 0, 0, 1]],
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1.0}},
    }
    sensor = mono(32, 24)
    pixel = np.arange(32 * 24, dtype=np.uint32)

    def weights_and_flux(shapes):
        tracer = pair_tracer(mitsuba_scene(shapes, depth=3), sensor)
        result = traced(tracer, 256, 0.0, 1.0)
        weights = {light.class_name(): light.sampling_weight() for light in tracer.parts.static.emitters()}
        return weights, np.stack([result.half_a, result.half_b]).astype(np.float64)

    weights, flux = weights_and_flux({"floor": floor, "lamp": lamp, "sky": sky})
    assert weights == {"AreaLight": 1.0, "ConstantBackgroundEmitter": 0.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moving, "spare_even_skies", lambda mi, emitters: None)
        weights, wanted = weights_and_flux({"floor": floor, "lamp": lamp, "sky": sky})
    assert weights["ConstantBackgroundEmitter"] == 1.0
    means = flux.mean(), wanted.mean()
    errors = [np.sqrt(np.mean((a - b) ** 2) / 4 / pixel.size) for a, b in (flux, wanted)]
    assert max(errors) < 1e-3 * means[1]
    assert abs(means[0] - means[1]) < 4.5 * np.hypot(*errors)
    assert weights_and_flux({"floor": floor, "sky": sky})[0] == {"ConstantBackgroundEmitter": 1.0}


def test_shapes_share_the_kernel_that_looks_at_them():
    """With the number of a shape within it, it would be another one for each shape: 80 ms for a box."""
    shapes = scene_of(*({"type": "cube", "to_world": placed(seed, at=(seed, 0, 0))} for seed in range(3))).shapes()
    seen = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for shape in shapes:
            dr.kernel_history_clear()
            assert len(parts.faces_of(mitsuba(), shape)) == 6
            seen.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
    assert seen[0] == seen[1] == seen[2] and seen[0]
