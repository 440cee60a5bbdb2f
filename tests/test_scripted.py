"""The scripted policy reads words and pixels only; its geometry is exact on pictures whose answer is known."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vap_core.base.types import Boxes, Camera, Rgb
from vap_core.policies.protocol import PolicyInput
from vap_core.policies.scripted.scripted import SPEED_M_S, Scripted, ScriptedState, coloured, read
from vap_core.prompt import PALETTE
from vap_core.simulation import robots

RED = PALETTE[0]


def camera() -> Camera:
    """One metre in front of the robot, half a metre up, looking back at the table under 45 degrees."""
    s = np.sqrt(0.5)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, s, -s], [1, 0, 0], [0, -s, -s]])
    pose[:3, 3] = [0.8, 0.0, 0.5]
    return Camera("front", 224, 224, np.array([[250.0, 0, 112], [0, 250, 112], [0, 0, 1]]), pose)


def box_of(x: float, y: float, radius: float, height: float) -> np.ndarray:
    """The picture's box of an upright cylinder, from its rim circles."""
    cam, a = camera(), np.linspace(0, 2 * np.pi, 90)
    ring = np.stack([x + radius * np.cos(a), y + radius * np.sin(a)], axis=1)
    points = np.concatenate([np.c_[ring, np.zeros(90)], np.c_[ring, np.full(90, height)]])
    local = (points - cam.pose_world[:3, 3]) @ cam.pose_world[:3, :3]
    pixels = (local / local[:, 2:]) @ cam.k.T
    return np.array([*pixels[:, :2].min(axis=0), *pixels[:, :2].max(axis=0)], np.float32)


def policy(boxes: Sequence[np.ndarray]) -> Scripted:
    found = Boxes(
        np.array(boxes, np.float32).reshape(-1, 4), np.ones(len(boxes), np.float32), "cup"
    )
    return Scripted(
        lambda images, phrase, threshold=None: [found for _ in images],
        camera(),
        robots.get("wx250s"),
        5.0,
    )


def look(rgb: Rgb, text: str) -> PolicyInput:
    return PolicyInput(
        {"front": rgb}, text, np.array([0.3, 0, 0.25, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], np.float32)
    )


@pytest.mark.parametrize(
    ("text", "verb", "colour", "category", "goal"),
    [
        ("pick up the red cup", "pick", "red", "cup", ""),
        ("pick up my cup", "pick", None, "cup", ""),
        ("pick up the cup", "pick", None, "cup", ""),
        ("cup", "pick", None, "cup", ""),
        ("put the red cup on the table", "pick", "red", "cup", ""),
        ("take the blue pen holder and lift it", "pick", "blue", "pen holder", ""),
        ("put the blue owl figurine on the plate", "put", "blue", "owl figurine", "plate"),
        ("put my straw cup in the basket", "put", None, "straw cup", "basket"),
        ("put the red pouch into the plastic bowl", "put", "red", "pouch", "plastic bowl"),
        ("move the red bottle near coke can", "near", "red", "bottle", "coke can"),
        ("put my pouch near the blue vase", "near", None, "pouch", "vase"),
        ("put my cup on the blue plate", "put", None, "cup", "plate"),
        ("select my leather bag", "touch", None, "leather bag", ""),
    ],
)
def test_reads_what_is_asked_for(
    text: str, verb: str, colour: str | None, category: str, goal: str
) -> None:
    wish = read(text)
    assert (wish.verb, wish.colour.name if wish.colour else None, wish.category, wish.goal) == (
        verb,
        colour,
        category,
        goal,
    )


@given(st.floats(0.15, 0.45), st.floats(-0.2, 0.2), st.floats(0.012, 0.021), st.floats(0.05, 0.12))
def test_places_an_upright_object_to_within_a_finger(
    x: float, y: float, radius: float, height: float
) -> None:
    place = policy([]).localizer.place(box_of(x, y, radius, height), 0.021)
    assert np.hypot(place[0] - x, place[1] - y) < 0.003
    assert abs(place[3] - height) < 0.005


def test_goes_to_the_coloured_one_and_not_by_luck() -> None:
    boxes = [box_of(0.3, y, 0.02, 0.08) for y in (-0.15, 0.0, 0.15)]
    for index, y in enumerate((-0.15, 0.0, 0.15)):
        rgb = np.full((224, 224, 3), 128, np.uint8)
        x0, y0, x1, y1 = boxes[index].astype(int)
        rgb[y0:y1, x0:x1] = (190, 60, 60)
        for seed in range(3):
            p = policy(boxes)
            (state,), _ = p.plan(
                [p.start(np.random.default_rng(seed))], [look(rgb, "pick up the red cup")]
            )
            assert state.goal is not None
            assert abs(state.goal[1] - y) < 0.02


def test_without_a_colour_any_of_the_category_is_taken_and_kept() -> None:
    boxes, grey = (
        [box_of(0.3, y, 0.02, 0.08) for y in (-0.15, 0.0, 0.15)],
        np.full((224, 224, 3), 128, np.uint8),
    )
    chosen = []
    for seed in range(60):
        p = policy(boxes)
        states, _ = p.plan([p.start(np.random.default_rng(seed))], [look(grey, "pick up my cup")])
        again, _ = p.plan(states, [look(grey, "pick up my cup")])
        assert states[0].goal is not None
        assert again[0].goal is not None
        assert np.allclose(states[0].goal, again[0].goal)
        chosen.append(round(float(states[0].goal[1]) / 0.15))
    assert {-1, 0, 1} == set(chosen)
    assert max(chosen.count(i) for i in (-1, 0, 1)) < 35


def test_an_empty_gripper_after_lifting_means_try_again() -> None:
    p, boxes = policy([box_of(0.3, 0.1, 0.02, 0.08)]), np.array([0.3, 0.1, 0.02, 0.08])
    lifting = ScriptedState(0.5, boxes, "lift", 0.0)
    held, empty = (
        look(np.zeros((224, 224, 3), np.uint8), "pick up my cup"),
        look(np.zeros((224, 224, 3), np.uint8), "pick up my cup"),
    )
    held.state[6], empty.state[6] = 0.5, 0.0
    (kept, again), (_, chunk) = p.plan([lifting, lifting], [held, empty])
    assert (kept.phase, again.phase) == ("lift", "above")
    assert (chunk[:, 6] == 1.0).all()


def test_nothing_seen_means_stand_still() -> None:
    p = policy([])
    (state,), (chunk,) = p.plan(
        [p.start(np.random.default_rng(0))],
        [look(np.zeros((224, 224, 3), np.uint8), "pick up my cup")],
    )
    assert state.goal is None
    assert (chunk[:, :6] == 0).all()


def test_no_action_is_longer_than_a_step() -> None:
    p = policy([box_of(0.3, 0.15, 0.02, 0.08)])
    _, (chunk,) = p.plan(
        [p.start(np.random.default_rng(0))],
        [look(np.full((224, 224, 3), 128, np.uint8), "pick up my cup")],
    )
    assert (np.linalg.norm(chunk[:, :3], axis=1) <= SPEED_M_S / p.hz * 1.0001).all()
    assert len(chunk) == p.execute


def test_a_naturally_grey_scene_is_not_red() -> None:
    rgb = np.full((224, 224, 3), 128, np.uint8)
    boxes = Boxes(np.array([[10, 10, 40, 40]], np.float32), np.ones(1, np.float32), "cup")
    assert coloured(rgb, boxes, RED).tolist() == [0.0]
