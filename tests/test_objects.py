"""The object registry: complete, split cleanly, true to its sizes, and at rest where it is put."""

import json
import os
import subprocess
import sys
from dataclasses import asdict

import numpy as np
import pytest

from vap_core.base.errors import UnknownName
from vap_core.simulation.assets.mujoco_object import add_object
from vap_core.simulation.assets.objects import (
    BAKED,
    CATEGORIES,
    CLUTTER,
    OBJECTS,
    RED,
    Baked,
    extent_m,
    get_object,
    lookalikes,
    mesh_of,
    personal_instance,
    texture_image,
    tier,
)
from vap_core.simulation.gl import ensure_gl
from vap_core.simulation.studio import reference_views
from vap_make.objects import FIXED, draw, generic_instance
from vap_make.objects.__main__ import placed

ensure_gl()
import mujoco  # noqa: E402

STEMS = sorted({name.rpartition("-personal")[0] for name in OBJECTS if name.endswith("-personal")})
GENERICS = [generic_instance(kind, i) for kind in [*STEMS, *CLUTTER] for i in range(3)]
EVERYTHING = [*OBJECTS.values(), *GENERICS]
RECEPTACLES = ("plate", "basket", "plastic bowl")
TABLE = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10"/>
<worldbody><geom name="table" type="box" size=".5 .5 .05" pos="0 0 -.05" condim="4" rgba=".4 .4 .4 1"/>
<camera name="side" fovy="20" pos="0 -2 0.05" xyaxes="1 0 0 0 0 1"/></worldbody></mujoco>"""


def on_table(model, height=0.0, yaw=0.0):
    spec = mujoco.MjSpec.from_string(TABLE)
    add_object(spec, model, (0, 0, height), yaw)
    return spec.compile()


def test_every_category_has_a_personal_instance_and_look_alikes():
    assert {personal_instance(stem).category for stem in STEMS} == set(CATEGORIES)
    for category in CATEGORIES:
        assert personal_instance(category).split == "personal"
        assert len(lookalikes(category)) >= 2
        assert all(model.category == category for model in lookalikes(category))
    assert all(name == model.name for name, model in OBJECTS.items())
    names = [model.name for model in EVERYTHING]
    assert len(set(names)) == len(names)


def test_look_alikes_differ_in_motif_and_in_shape():
    for stem in STEMS:
        models = (personal_instance(stem), *lookalikes(stem))
        assert len({(m.texture.motif, m.texture.layout) for m in models}) == len(models)
        assert len({repr(m.shape) for m in models}) == len(models)
        assert all(
            {m.texture.base, m.texture.ink, m.texture.accent}
            & {models[0].texture.base, models[0].texture.accent}
            for m in models
        )


@pytest.mark.parametrize("stem", STEMS)
def test_look_alikes_come_in_three_tiers(stem):
    assert {tier(model) for model in lookalikes(stem)} == {"hard", "medium", "easy"}
    assert tier(lookalikes(stem)[-1]) == "easy"


def test_generic_is_deterministic_and_ignores_global_seeds():
    first = generic_instance("cup", 7)
    generic_instance.cache_clear()
    np.random.seed(3)  # noqa: NPY002
    again = generic_instance("cup", 7)
    assert repr(again) == repr(first)
    assert again.name == "cup-generic-0007"
    assert repr(get_object("pen-holder-generic-0012")) == repr(generic_instance("pen holder", 12))
    assert len({repr(generic_instance("vase", i)) for i in range(50)}) == 50


def same(name: str) -> bool:
    """Whether the archive has what the generator draws."""
    baked, drawn = get_object(name), draw(name)
    pairs, meshes = (
        [(texture_image(baked), drawn.form.picture())],
        (mesh_of(baked), drawn.form.mesh()),
    )
    for part in ("vertex", "normal", "uv", "face"):
        pairs.append(tuple(getattr(mesh, part) for mesh in meshes))
    about = []
    for model in (baked, drawn):
        parts = [asdict(part) for part in (model.texture, *model.form.solids())]
        kinds = (model.category, model.split, model.shape, model.mass_kg, parts)
        about.append(json.dumps(kinds, default=lambda number: number.tolist()))
    return about[0] == about[1] and all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    "name",
    ["cup-personal", "shoe-lookalike-2", "vase-lookalike-4-red", "camera-generic-9501-2-red"],
)
def test_what_ships_is_what_the_generator_draws(name):
    assert isinstance(get_object(name).form, Baked)
    assert same(name)


@pytest.mark.slow
def test_all_that_ships_is_what_the_generator_draws():
    assert list(FIXED) == list(OBJECTS)
    assert set(BAKED) == {name for name in placed() if not name.endswith(RED)}
    check = (
        "from tests.test_objects import placed, same; print([n for n in placed() if not same(n)])"
    )
    # In a process in which no shape is checked: half a million arrays.
    environment = {**os.environ, "JAXTYPING_DISABLE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", check], env=environment, capture_output=True, text=True
    )
    assert done.stdout == "[]\n", done.stdout + done.stderr


def test_generic_and_evaluation_parameters_are_disjoint():
    trained = [generic_instance(kind, i).texture for kind in [*STEMS, *CLUTTER] for i in range(300)]
    held_out = [model.texture for model in OBJECTS.values()]
    for read in (lambda t: t.motif, lambda t: t.layout, lambda t: (t.base, t.ink, t.accent)):
        assert not {read(t) for t in trained} & {read(t) for t in held_out}


@pytest.mark.parametrize("name", ["cup-mine", "cup-generic-7", "mug-generic-0001", "cup-generic-"])
def test_unknown_name_lists_what_exists(name):
    with pytest.raises(UnknownName, match=r"objects: object .* is unknown; known: .*cup-lookalike"):
        get_object(name)


@pytest.mark.parametrize("find", [personal_instance, lookalikes, lambda c: generic_instance(c, 0)])
def test_unknown_category_lists_what_exists(find):
    with pytest.raises(UnknownName, match="known: .*bottle, .*camera, .*cup"):
        find("spaceship")


@pytest.mark.parametrize("model", EVERYTHING, ids=lambda m: m.name)
def test_object_compiles_fits_its_extent_and_rests_upright(model):
    compiled = on_table(model, height=0.001, yaw=0.3)
    geom, form = compiled.geom(f"{model.name}/visual"), mesh_of(model)
    assert len(form.face) <= 1500
    assert np.isclose(form.vertex[:, 2].min(), 0, atol=1e-6)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, geom.quat)
    vertex = compiled.mesh_vert @ turn.reshape(3, 3).T + geom.pos
    assert np.allclose(np.ptp(vertex, axis=0), extent_m(model), atol=1e-3)
    assert np.isclose(compiled.body(model.name).mass[0], model.mass_kg)
    mass_kg, tall_m = (
        ((0.3, 0.5), (0.010, 0.060))
        if model.category in RECEPTACLES
        else ((0.05, 0.16), (0.060, 0.122))
    )
    assert mass_kg[0] <= model.mass_kg <= mass_kg[1]
    assert tall_m[0] <= extent_m(model)[2] <= tall_m[1]

    data = mujoco.MjData(compiled)
    mujoco.mj_step(compiled, data, 250)
    settled = data.qpos.copy()
    assert np.abs(data.qvel).max() < 1e-2
    mujoco.mj_step(compiled, data, 500)
    assert 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2) > 0.9999
    assert np.linalg.norm(data.qpos[:2]) < 1e-3
    assert abs(data.qpos[2]) < 5e-4
    assert np.allclose(data.qpos, settled, atol=5e-4)


@pytest.mark.parametrize("model", EVERYTHING, ids=lambda m: m.name)
def test_two_fingers_fit_around_it(model):
    form = mesh_of(model)
    level = (0.5 if model.category == "scrubber" else 0.6) * form.vertex[:, 2].max()
    solids = [
        s
        for s in model.form.solids()
        if s.pos[2] - s.size[-1] < level < s.pos[2] + s.size[-1]
        and s.kind == "cylinder"
        and s.axis == "z"
    ]
    if model.category == "camera":
        assert 0.036 <= extent_m(model)[1] <= 0.042
    for solid in solids:
        assert 0.030 <= 2 * solid.size[0] <= 0.045


def test_visible_mask_has_the_size_of_the_can():
    model = generic_instance("coke can", 0)
    compiled = on_table(model)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    with mujoco.Renderer(compiled, 400, 400) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, "side")
        mask = renderer.render()[..., 0] == compiled.geom(f"{model.name}/visual").id
    px_per_m = 200 / np.tan(np.radians(10)) / 2
    ys, xs = np.nonzero(mask)
    width, _, height = extent_m(model)
    assert np.ptp(xs) + 1 == pytest.approx(width * px_per_m, abs=2.5)
    assert np.ptp(ys) + 1 == pytest.approx(height * px_per_m, abs=2.5)
    assert mask.sum() == pytest.approx(width * height * px_per_m**2, rel=0.08)


def test_atlas_keeps_its_swatches_below_the_decoration():
    picture = texture_image(personal_instance("cup"))
    assert picture.shape == (512, 512, 3)
    assert tuple(picture[-1, 0]) == personal_instance("cup").texture.base


def test_reference_views_are_seeded_varied_and_framed():
    model = personal_instance("cup")
    views = reference_views(model, n=5, size=160)
    again = reference_views(model, n=5, size=160)
    other = reference_views(model, n=5, seed=1, size=160)
    assert all(np.array_equal(a, b) for a, b in zip(views, again, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(views, other, strict=True))
    assert len({view.tobytes() for view in views}) == 5
    assert all(view.shape == (160, 160, 3) and view.std() > 10 for view in views)


@pytest.mark.parametrize("kind", RECEPTACLES)
@pytest.mark.parametrize("index", [None, 0, 1])
def test_things_lie_inside_a_receptacle(kind, index):
    place = (
        get_object(f"{kind.replace(' ', '-')}-prop")
        if index is None
        else generic_instance(kind, index)
    )
    thing = personal_instance("owl figurine")
    spec = mujoco.MjSpec.from_string(TABLE)
    add_object(spec, place)
    add_object(spec, thing, (0.012, 0, 0.02))
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_step(compiled, data, 750)
    form = mesh_of(place).vertex
    floor_m = form[np.hypot(form[:, 0], form[:, 1]) < 1e-6, 2].max()
    assert data.body(thing.name).xpos == pytest.approx([0.012, 0, floor_m], abs=1e-3)
    assert data.body(thing.name).xmat[8] > 0.9999
    assert np.abs(data.qvel).max() < 1e-2
