"""Colours have one meaning each, and stay apart for colour-blind eyes and in grey."""

import numpy as np
import pytest

from tests.colour_vision import VISIONS, delta_e, least_difference, lightness
from vap_core.base import pictures

ROLES = [pictures.TARGET, pictures.ELECTED, pictures.GOAL, *pictures.LOOKALIKES]
METHODS = [colour for colour, _ in pictures.METHODS.values()]
SUITES = [colour for colour, _ in pictures.SUITES.values()]
TIERS = list(pictures.TIERS.values())
PALETTES = {
    "roles": (ROLES, 13),
    "methods": ([pictures.TARGET, *METHODS], 18),
    "suites": ([pictures.TARGET, *SUITES], 16),
    "tiers": (TIERS, 20),
    "cases": ([pictures.TARGET, *pictures.CASES.values()], 11),
    "cameras": ([pictures.TARGET, *pictures.CAMERAS], 17),
}
"""Every palette beside the target's colour, and the least CIEDE2000 of any two of it."""
IN_GREY = {"methods": METHODS, "suites": SUITES, "tiers": TIERS, "cameras": pictures.CAMERAS}


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.0, 2.0), (50.0, 0.0, 0.0), 2.3669),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_difference_is_that_of_the_published_pairs(
    one: tuple[float, ...], other: tuple[float, ...], expected: float
) -> None:
    assert delta_e(np.array(one), np.array(other)) == pytest.approx(expected, abs=1e-4)
    assert delta_e(np.array(other), np.array(one)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("name", PALETTES)
def test_no_two_colours_of_a_palette_look_alike(name: str, vision: str) -> None:
    colours, least = PALETTES[name]
    found, one, other = least_difference(colours, vision)
    assert found >= least, f"{name}: {one} and {other} differ by {found:.1f} with {vision}"


@pytest.mark.parametrize("name", IN_GREY)
def test_palettes_are_readable_in_grey(name: str) -> None:
    levels = sorted(lightness(colour) for colour in IN_GREY[name])
    assert np.diff(levels).min() >= 7, levels


def test_every_method_and_suite_has_a_marker_of_its_own() -> None:
    many = [*pictures.METHODS, *"abcde"]
    marks = pictures.method_marks(many)
    assert len(set(marks.values())) == len(many)
    assert len({marker for _, marker in marks.values()}) == len(many)
    assert len({marker for _, marker in pictures.SUITES.values()}) == len(pictures.SUITES)


def test_every_policy_of_a_method_has_a_marker_of_its_own() -> None:
    own = {marker for _, marker in pictures.METHODS.values()}
    further = pictures.FURTHER_POLICY_MARKERS
    assert len(set(further) | own) == len(further) + len(own), "they stand beside a method's own"
    assert len(set(pictures.POLICY_MARKERS)) == len(pictures.POLICY_MARKERS)


def test_only_the_target_is_orange_and_only_the_goal_rose() -> None:
    names = ["cup", "mine", "tray", "pot"]
    colours = pictures.object_colours(names, target="mine", goal="tray")
    assert colours["mine"] == pictures.TARGET
    assert colours["tray"] == pictures.GOAL
    assert {colours["cup"], colours["pot"]} == set(pictures.LOOKALIKES[:2])
    assert pictures.rgb8(pictures.TARGET) == (242, 142, 43)
