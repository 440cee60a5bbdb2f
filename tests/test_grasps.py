"""Grasps of bodies whose every measure is known: width, centre, axis and taper exact; neighbours in the way counted to the millimetre."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from vap_core.base.types import Rgb, value
from vap_core.simulation import grasps, robots
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.shapes import Hull, Mesh, Solid, Texture
from vap_core.simulation.grasps import FINGER_M, HALF_PAD_M, PAD_M, TIGHT_M, TIP_M, YAWS

PANDA = robots.get("panda")
REACH_M = PANDA.opening_m / 2 + FINGER_M
"""From the middle of the grasp to the outside of an open finger."""
PAINT = Texture((200, 200, 200), (20, 20, 20), (90, 90, 90), "dot", "row")
NUMBER = count()


@value
class Body:
    """Collision solids and no picture."""

    parts: tuple[Solid, ...] | tuple[Hull, ...]

    def mesh(self) -> Mesh:
        raise NotImplementedError

    def solids(self) -> tuple[Solid, ...] | tuple[Hull, ...]:
        return self.parts

    def picture(self) -> Rgb:
        raise NotImplementedError


@pytest.fixture
def make(monkeypatch):
    """Enter a body into the registry for one test; returns its name."""

    def enter(*parts: Solid | Hull) -> str:
        name = f"brick-{next(NUMBER)}"
        monkeypatch.setitem(
            objects.BAKED,
            name,
            objects.ObjectModel(name, "brick", "prop", {}, PAINT, 0.1, Body(parts)),
        )
        return name

    return enter


def box(x: float, y: float, z: float) -> Solid:
    """A box of those full extents, standing on its origin."""
    return Solid("box", (x / 2, y / 2, z / 2), (0, 0, z / 2))


def at(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> np.ndarray:
    return np.array([x, y, z, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def along(grasp: grasps.Grasp, axis_rad: float) -> bool:
    """Whether the fingers close along that direction of the world."""
    return bool(np.isclose(np.cos(2 * (grasp.axis_rad - axis_rad)), 1.0))


@pytest.mark.parametrize("yaw", YAWS[::2])
def test_a_box_is_taken_across_its_thin_side(yaw, make):
    brick = make(box(0.04, 0.07, 0.06))
    found = grasps.grasps(PANDA, brick, {brick: at(0.45, -0.12, float(yaw))})
    first = found[0]
    assert along(first, yaw)
    assert first.width_m == pytest.approx(0.04)
    assert first.tcp_world == pytest.approx([0.45, -0.12, 0.55 * 0.06])
    assert first.taper == pytest.approx(0, abs=1e-9)
    assert first.clear_m == 1.0, "nothing else is there"


def test_every_grasp_has_the_width_of_the_box_along_its_axis_and_no_other_fits(make):
    brick = make(box(0.04, 0.07, 0.06))
    found = grasps.grasps(PANDA, brick, {brick: at(0.45, 0.0)})
    widths = {
        round(yaw, 6): 0.04 * abs(np.cos(yaw)) + 0.07 * abs(np.sin(yaw)) for yaw in YAWS.tolist()
    }
    for grasp in found:
        assert grasp.width_m == pytest.approx(widths[round(grasp.axis_rad, 6)])
        assert grasp.tcp_world[:2] == pytest.approx([0.45, 0.0])
    fitting = {yaw for yaw, width in widths.items() if width <= PANDA.opening_m - TIGHT_M}
    assert {round(grasp.axis_rad, 6) for grasp in found} == fitting
    assert [grasp.width_m for grasp in found] == sorted(grasp.width_m for grasp in found)


@pytest.mark.parametrize("robot", sorted(robots.ROBOTS))
def test_what_is_just_too_wide_cannot_be_taken_and_what_just_fits_can(robot, make):
    arm = robots.get(robot)
    limit = arm.opening_m - TIGHT_M
    for width, fits in ((limit - 1e-4, True), (limit + 1e-4, False)):
        brick = make(box(width, 0.2, 0.05))
        found = grasps.grasps(arm, brick, {brick: at(0.3, 0.0)})
        assert bool(found) is fits
        assert all(along(grasp, 0.0) for grasp in found)


def test_a_cylinder_is_taken_from_any_side(make):
    can = make(Solid("cylinder", (0.03, 0.05), (0, 0, 0.05)))
    found = grasps.grasps(PANDA, can, {can: at(0.4, 0.1, 0.3)})
    assert {round(grasp.axis_rad, 6) for grasp in found} == {round(yaw, 6) for yaw in YAWS.tolist()}
    for grasp in found:
        assert grasp.width_m == pytest.approx(0.06, rel=0.01)
        assert grasp.tcp_world[:2] == pytest.approx([0.4, 0.1], abs=5e-4)


@pytest.mark.parametrize("height", [0.012, 0.03, 0.06, 0.12, 0.25])
def test_the_fingertips_stay_off_the_table_and_the_palm_above_the_top(height, make):
    brick = make(box(0.04, 0.05, height))
    for grasp in grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0)}):
        assert grasp.tcp_world[2] >= TIP_M
        assert grasp.tcp_world[2] + PANDA.palm_m > height


def test_a_pyramids_taper_is_how_fast_it_narrows(make):
    """Corners of a frustum that narrows by 2 x 0.25 m a metre across x, and not at all across y."""
    low, high, half_y, height = 0.03, 0.015, 0.02, 0.06
    corners = [
        (sx * half, sy * half_y, z)
        for half, z in ((low, 0.0), (high, height))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    frustum = make(Hull(np.array(corners), 1e-4))
    found = grasps.grasps(PANDA, frustum, {frustum: at(0.4, 0.0)})
    (across_x, *_), (across_y, *_) = (
        [grasp for grasp in found if along(grasp, axis)] for axis in (0.0, np.pi / 2)
    )
    assert across_x.taper == pytest.approx(2 * (low - high) / height)
    assert across_x.width_m == pytest.approx(
        2 * (low - (low - high) / height * across_x.tcp_world[2])
    )
    assert across_y.taper == pytest.approx(0, abs=1e-9)
    assert along(found[0], np.pi / 2), "what does not slip comes first"


@pytest.mark.parametrize("gap", [0.003, 0.01, 0.03])
def test_a_neighbour_reduces_the_clearance_by_as_much_and_turns_the_best_axis(gap, make):
    """A post narrower than a finger, `gap` beyond the open finger on the x side."""
    brick, post = make(box(0.04, 0.042, 0.06)), make(box(0.02, 0.02, 0.06))
    face = REACH_M + gap
    alone = grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0)})
    beside = grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0), post: at(0.4 + face + 0.01, 0.0)})
    assert len(alone) == len(beside)
    assert along(alone[0], 0.0)
    crowded, free = ([grasp for grasp in beside if along(grasp, axis)] for axis in (0.0, np.pi / 2))
    assert [grasp.clear_m for grasp in crowded] == pytest.approx([gap] * len(crowded))
    assert [grasp.clear_m for grasp in free] == pytest.approx([face - PAD_M] * len(free))
    assert along(beside[0], np.pi / 2 if gap < grasps.ROOM_M else 0.0)


def test_a_post_inside_the_fingers_reach_counts_as_negative(make):
    brick, post = make(box(0.04, 0.04, 0.06)), make(box(0.01, 0.01, 0.06))
    beside = grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0), post: at(0.4 + REACH_M, 0.0)})
    hit = [grasp for grasp in beside if along(grasp, 0.0)]
    assert all(grasp.clear_m < 0 for grasp in hit)
    assert not along(beside[0], 0.0)
    assert beside[0].clear_m > 0


def test_the_palm_counts_only_for_what_is_as_high(make):
    """The hand above reaches further along its axis than the fingers: a tall post meets it, a low one does not."""
    brick, low, tall = (
        make(box(0.04, 0.04, 0.06)),
        make(box(0.02, 0.02, 0.07)),
        make(box(0.02, 0.02, 0.15)),
    )
    first = [
        grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0), post: at(0.53, 0.0)})
        for post in (low, tall)
    ]
    clear = [max(grasp.clear_m for grasp in found if along(grasp, 0.0)) for found in first]
    assert clear == pytest.approx([0.12 - REACH_M, 0.12 - PANDA.hand_m[0]])


def test_what_is_lower_than_the_fingertips_is_no_obstacle(make):
    brick, mat = make(box(0.04, 0.04, 0.06)), make(box(0.3, 0.3, 0.004))
    found = grasps.grasps(PANDA, brick, {brick: at(0.4, 0.0, z=0.004), mat: at(0.4, 0.0)})
    assert found[0].clear_m == 1.0


@pytest.mark.parametrize("length", [0.06, 0.2])
def test_a_long_neighbour_is_in_the_way_although_its_corners_are_not(length, make):
    brick, wall = make(box(0.04, 0.04, 0.06)), make(box(0.02, length, 0.06))
    beside = grasps.grasps(
        PANDA, brick, {brick: at(0.4, 0.0), wall: at(0.4 + REACH_M + 0.005 + 0.01, 0.0)}
    )
    assert [grasp.clear_m for grasp in beside if along(grasp, 0.0)] == pytest.approx(
        [0.005] * sum(along(grasp, 0.0) for grasp in beside)
    )


@pytest.mark.parametrize("yaw", [0.0, np.deg2rad(60)])
def test_a_lying_object_is_taken_where_it_lies(yaw, make):
    """A 4 x 5 x 12 cm box tipped over onto its side: 12 cm long along its yaw, 4 cm high."""
    brick = make(box(0.04, 0.05, 0.12))
    turn, tip = np.array([np.cos(yaw / 2), np.sin(yaw / 2)]), np.sqrt(0.5)
    pose = np.array([0.4, 0.1, 0.02, turn[0] * tip, -turn[1] * tip, turn[0] * tip, turn[1] * tip])
    found = grasps.grasps(PANDA, brick, {brick: pose})
    first = found[0]
    assert all(along(grasp, yaw + np.pi / 2) for grasp in found), (
        "it fits the hand in one direction only"
    )
    assert first.width_m == pytest.approx(0.05)
    assert first.tcp_world == pytest.approx(
        [0.4 + 0.06 * np.cos(yaw), 0.1 + 0.06 * np.sin(yaw), 0.55 * 0.04]
    )


def test_a_cut_is_the_outline_at_that_height_and_empty_beyond(make):
    brick = make(box(0.04, 0.06, 0.1))
    outline = grasps.cut(brick, at(0.0, 0.0, z=0.5), 0.55)
    assert np.abs(outline).max(axis=0) == pytest.approx([0.02, 0.03])
    assert len(grasps.cut(brick, at(0.0, 0.0, z=0.5), 0.49)) == 0
    assert len(grasps.cut(brick, at(0.0, 0.0, z=0.5), 0.61)) == 0


def test_a_handle_counts_for_the_width_only_where_it_is(make):
    """Two parts: a block, and a bar across its foot that no height tried meets."""
    block, bar = box(0.04, 0.04, 0.2), replace(box(0.12, 0.02, 0.02), pos=(0.0, 0.0, 0.01))
    found = grasps.grasps(PANDA, both := make(block, bar), {both: at(0.4, 0.0)})
    assert found[0].width_m == pytest.approx(0.04)
    assert found[0].tcp_world[2] > 0.02 + HALF_PAD_M


def test_the_order_of_the_neighbours_changes_nothing(make):
    brick, one, other = (
        make(box(0.04, 0.04, 0.06)),
        make(box(0.02, 0.02, 0.06)),
        make(Solid("cylinder", (0.02, 0.03), (0, 0, 0.03))),
    )
    poses = {brick: at(0.4, 0.0), one: at(0.48, 0.02), other: at(0.4, 0.09)}
    first = grasps.grasps(PANDA, brick, poses)
    second = grasps.grasps(PANDA, brick, dict(reversed(poses.items())))
    assert [(g.axis_rad, g.clear_m, g.width_m) for g in first] == [
        (g.axis_rad, g.clear_m, g.width_m) for g in second
    ]
