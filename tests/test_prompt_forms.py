"""What the arms of ablations show the policy: forms of a prompt, spoiled masks, hidden targets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.toys import TOYS, observation, personal, scene
from vap_core.attend import Attender, Prompting
from vap_core.base.types import Camera
from vap_core.notebook import marked_frames
from vap_core.prompt import PALETTE, Tint, choose_colours, has_colour, tint
from vap_core.rollout.prompters import PromptContext, spoil
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object, texture_image
from vap_core.simulation.suites.open_row import open_row
from vap_core.study.forms import ArrowPrompter, draw_arrow, hand_pixel
from vap_core.study.methods import ABLATIONS

FORMS = {
    name: arm.form for name, arm in ABLATIONS["form"].arms.items() if isinstance(arm, Prompting)
}
RED = PALETTE[0]


def blob(h: int, w: int, y: int, x: int, r: int) -> np.ndarray:
    rows, cols = np.mgrid[0:h, 0:w]
    return (rows - y) ** 2 + (cols - x) ** 2 <= r * r


@settings(max_examples=15, deadline=None)
@given(
    h=st.integers(40, 90),
    w=st.integers(40, 90),
    y=st.integers(-5, 95),
    x=st.integers(-5, 95),
    seed=st.integers(0, 9),
)
@pytest.mark.parametrize("name", FORMS)
def test_a_form_marks_a_copy_of_any_picture(
    name: str, h: int, w: int, y: int, x: int, seed: int
) -> None:
    rgb = np.random.default_rng(seed).integers(0, 200, (h, w, 3), np.uint8)
    kept = rgb.copy()
    mask, other = blob(h, w, y, x, 9), blob(h, w, h // 4, w // 4, 6)
    marked = FORMS[name](rgb, mask, RED, [other & ~mask])
    assert (rgb == kept).all()
    assert (marked.shape, marked.dtype) == (rgb.shape, np.uint8)
    if mask.any() and name != "others-erased":
        assert (marked != rgb).any()


@pytest.mark.parametrize("name", sorted(set(FORMS) - {"marker", "others-erased"}))
def test_without_a_target_nothing_is_marked(name: str) -> None:
    rgb = np.full((64, 64, 3), 90, np.uint8)
    nothing = np.zeros((64, 64), bool)
    assert (FORMS[name](rgb, nothing, RED, []) == rgb).all()


def test_each_form_does_what_its_name_says() -> None:
    rgb = np.random.default_rng(0).integers(60, 120, (112, 112, 3), np.uint8)
    mask, other = blob(112, 112, 60, 40, 14), blob(112, 112, 60, 85, 12)
    changed = {
        name: (form(rgb, mask, RED, [other]) != rgb).any(axis=2) for name, form in FORMS.items()
    }
    assert (changed["opaque"] == mask).all()
    box = np.zeros_like(mask)
    box[46:75, 26:55] = True
    assert (changed["box"] == box).all()
    assert not changed["contour"][60, 40]
    assert changed["point"][60, 40]
    assert changed["point"].sum() < 0.2 * mask.sum()
    assert not changed["circle"][mask].any()
    assert changed["marker"][60, 85]
    assert not changed["dimmed"][mask].any()
    assert changed["dimmed"][~mask].all()
    assert not changed["others-erased"][mask].any()
    assert changed["others-erased"][other].mean() > 0.9


def test_the_default_form_is_the_papers_tint() -> None:
    rgb = np.random.default_rng(1).integers(0, 255, (32, 32, 3), np.uint8)
    mask = blob(32, 32, 16, 16, 7)
    assert (Prompting().form(rgb, mask, RED, []) == tint(rgb, mask, RED)).all()
    assert Prompting().form == Tint(0.5)


@pytest.mark.parametrize(("area", "shift"), [(0.25, 0.0), (2.0, 0.0), (1.0, 0.5)])
def test_a_spoiled_mask_has_its_area_and_its_shift(area: float, shift: float) -> None:
    mask = blob(224, 224, 100, 90, 30)
    spoiled = spoil(mask, area, shift)
    assert spoiled.sum() == pytest.approx(area * mask.sum(), rel=0.05)
    centre = np.argwhere(spoiled).mean(axis=0)
    assert centre == pytest.approx([100, 90 + shift * 61], abs=1.0)


def camera(x: float = 0.0) -> Camera:
    """Looks straight down from one metre above the table; `x` is its place (metres)."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = x, 0, 1
    k = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    return Camera(name="top", width=100, height=100, k=k, pose_world=pose)


def test_the_arrow_begins_at_the_hand_and_ends_on_the_target() -> None:
    assert hand_pixel(camera(), np.array([0.1, 0.2, 0.5])) == (70, 10)
    assert hand_pixel(camera(), np.array([0.0, 0.0, 1.5])) is None, "behind the camera"
    assert hand_pixel(camera(), np.array([500.0, 0.0, 0.5])) == (4096, 50), "far outside"
    rgb = np.full((100, 100, 3), 90, np.uint8)
    drawn = draw_arrow(rgb, blob(100, 100, 70, 30, 8), RED, (70, 10))
    changed = (drawn != rgb).any(axis=2)
    assert changed[10, 70]
    assert changed[70, 30]
    assert not changed[:, 80:].any()


def test_two_targets_at_one_place_have_one_arrow_in_the_colour_that_is_named() -> None:
    square = (40, 120, 110)
    memory = {name: personal(name, name, square) for name in ("cup", "vase")}
    attender = Attender(TOYS, memory, Prompting(highlight=False))
    prompter = ArrowPrompter(attender, np.array([0.0, 0, 0, 1, 0, 0, 0]))
    seen = observation({"top": scene([(60, 20, square)], size=100)})
    context = PromptContext("put my cup near my vase", {"top": camera()})
    _, attended = prompter.start(seen, context)
    assert attended.text == "put the red cup near my vase"
    red, blue = (has_colour(attended.images["top"].reshape(-1, 3), one) for one in PALETTE[:2])
    assert red.any()
    assert not blue.any()


def test_every_look_alike_can_be_red_by_nature() -> None:
    for row in suites.benchmark("simpler-bridge-red"):
        listed = suites.benchmark("simpler-bridge")
        same = next(one for one in listed if (one.task, one.episode) == (row.task, row.episode))
        changed = [a.model for a, b in zip(row.placements, same.placements, strict=True)
                   if a.model != b.model]  # fmt: skip
        assert len(changed) == 1
        assert changed[0].endswith("-red")
        assert get_object(changed[0]).category == row.category
    red = get_object("shaver-lookalike-1-red")
    assert red is get_object("shaver-lookalike-1-red"), "meshes are kept by object"
    assert (
        has_colour(texture_image(red), RED).mean()
        > 3 * has_colour(texture_image(get_object("shaver-lookalike-1")), RED).mean() + 0.1
    )


def test_the_target_is_hidden_from_the_third_call_on() -> None:
    from vap_core.study.trials import _occlusion

    occlusion = _occlusion("hidden-2", execute=4)
    assert occlusion is not None
    assert [step for step in range(40) if occlusion.covers("front", step)] == list(range(8, 16))
    assert _occlusion("vap", execute=4) is None


@pytest.mark.parametrize("name", FORMS)
def test_a_form_that_marks_others_says_so(name: str) -> None:
    rgb = np.random.default_rng(2).integers(60, 120, (112, 112, 3), np.uint8)
    mask, other = blob(112, 112, 60, 30, 12), blob(112, 112, 60, 80, 12)
    differs = bool((FORMS[name](rgb, mask, RED, [other]) != FORMS[name](rgb, mask, RED, [])).any())
    assert differs == bool(getattr(FORMS[name], "marks_others", False))


def test_every_form_is_shown_on_one_frame() -> None:
    frames = marked_frames(suites.rows("simpler-bridge", "put-camera", n=1)[0])
    assert set(frames) == {"vap", *ABLATIONS["form"].arms, *ABLATIONS["opacity"].arms}
    assert len({frame.shape for frame in frames.values()}) == 1
    pictures = {frame.tobytes() for frame in frames.values()}
    assert len(pictures) == len(frames), "no two forms look the same"


def test_the_chosen_tint_is_none_that_a_red_look_alike_has() -> None:
    row = suites.rows("simpler-bridge-red", "put-camera", n=1)[0]
    with open_row(row) as env:
        (view,) = env.observe().images.values()
        (masks,) = env.truth(masks=True).masks.values()
    alike = [mask for name, mask in masks.items() if get_object(name).category == row.category]
    (red,) = (mask for name, mask in masks.items() if name.endswith("-red"))
    assert has_colour(view[red], RED).mean() > 0.1, "by nature"
    (chosen,) = choose_colours(1, [(view, alike)])
    assert chosen.name != RED.name
