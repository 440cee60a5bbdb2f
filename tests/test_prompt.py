"""The tint, pixel by pixel, and the choice of colours."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.colors import hsv_to_rgb, rgb_to_hsv

from vap_core.base.errors import BadInstruction
from vap_core.prompt import PALETTE, choose_colours, has_colour, tint
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.study.perception import opening_views

RED = PALETTE[0]
images = arrays(np.uint8, (7, 9, 3))
masks = arrays(bool, (7, 9))


@given(images, masks, st.floats(0, 1))
def test_outside_is_bit_identical_and_inside_is_the_blend(
    rgb: np.ndarray, mask: np.ndarray, alpha: float
) -> None:
    before = rgb.copy()
    out = tint(rgb, mask, RED, alpha)
    assert (out[~mask] == rgb[~mask]).all()
    assert (out[mask] == np.rint((1 - alpha) * rgb[mask] + alpha * np.array(RED.rgb))).all()
    assert (rgb == before).all()


def test_golden_pixel() -> None:
    rgb = np.full((1, 1, 3), (100, 50, 201), np.uint8)
    assert tint(rgb, np.ones((1, 1), bool), RED).tolist() == [[[178, 25, 100]]]


@given(images, masks)
def test_alpha_zero_is_identity(rgb: np.ndarray, mask: np.ndarray) -> None:
    assert (tint(rgb, mask, RED, 0.0) == rgb).all()


@given(images, masks)
def test_commutes_with_mirroring(rgb: np.ndarray, mask: np.ndarray) -> None:
    assert (
        tint(rgb[:, ::-1].copy(), mask[:, ::-1].copy(), RED) == tint(rgb, mask, RED)[:, ::-1]
    ).all()


def test_sizes_and_opacity_are_checked() -> None:
    rgb = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(ValueError, match="differ in size"):
        tint(rgb, np.zeros((3, 4), bool), RED)
    with pytest.raises(ValueError, match="outside"):
        tint(rgb, np.zeros((4, 4), bool), RED, 1.5)


@pytest.mark.parametrize("colour", PALETTE, ids=lambda c: c.name)
def test_every_colour_looks_like_itself_alone_even_tinted_over_grey(colour: object) -> None:
    tinted = tint(np.full((2, 2, 3), 128, np.uint8), np.ones((2, 2), bool), colour)  # type: ignore[arg-type]
    assert [c.name for c in PALETTE if has_colour(tinted, c).all()] == [colour.name]  # type: ignore[attr-defined]


def test_nobody_calls_grey_a_colour() -> None:
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    assert not any(has_colour(grey, colour).any() for colour in PALETTE)


def test_a_colour_in_view_is_not_chosen() -> None:
    rgb = np.zeros((8, 8, 3), np.uint8)
    rgb[:4] = (220, 10, 10)
    top = np.zeros((8, 8), bool)
    top[:4] = True
    assert choose_colours(1, [(rgb, [top])])[0].name == "blue"
    assert choose_colours(1, [(rgb, [~top])])[0].name == "blue"
    assert choose_colours(1, [(rgb * np.uint8(0), [top])])[0].name == "red"
    assert choose_colours(1, [])[0].name == "red"


@given(st.integers(0, 359), st.integers(26, 100), st.integers(24, 100))
def test_no_hue_is_without_a_name(hue: int, saturation: int, brightness: int) -> None:
    """What an object of one hue is called, or may be called, is never chosen beside it."""
    paint = hsv_to_rgb([hue / 360, saturation / 100, brightness / 100])
    rgb = np.full((32, 32, 3), 128, np.uint8)
    rgb[4:12, 4:12] = np.rint(255 * paint)
    (chosen,) = choose_colours(1, [(rgb, [])])
    assert away(hue, chosen.name) >= 75


def test_an_object_between_two_names_has_both() -> None:
    """A blue toy: a twelfth of it is called blue, a tenth cyan."""
    rgb = np.full((200, 200, 3), 90, np.uint8)
    toy = np.zeros((200, 200), bool)
    toy[50:60, 50:60] = True
    rgb[50:60, 50] = 40, 80, 200
    rgb[50:59, 51] = 40, 170, 200
    assert choose_colours(1, [(rgb, [toy])])[0].name in ("red", "yellow")


def test_a_second_tint_is_no_neighbour_of_the_first() -> None:
    first, second, third = choose_colours(3, [(np.full((8, 8, 3), 128, np.uint8), [])])
    assert (first.name, second.name, third.name) == ("red", "blue", "green")


ROWS = [
    *(("simpler-fractal", "pick-pen-holder"), ("simpler-fractal", "move-bottle-near-coke-can")),
    *(("simpler-bridge", "pick-shaver"), ("simpler-bridge", "put-camera")),
    *(("vlabench", "select-cup"), ("tabletop", "select-vase")),
]


def test_a_name_in_a_scene_fits_nothing_else_there() -> None:
    """Hue by matplotlib over the simulator's masks; the chooser has those of the category alone."""
    for views in opening_views([suites.rows(*which, n=1)[0] for which in ROWS]):
        row = views[0].row
        scenes = [
            (v.rgb, [m for n, m in v.visible().items() if get_object(n).category == row.category])
            for v in views
        ]
        (chosen,) = choose_colours(1, scenes)
        for view in views:
            for name, mask in view.visible().items():
                hue, saturation, brightness = rgb_to_hsv(view.rgb[mask] / 255).T
                fits = (away(360 * hue, chosen.name) <= 40) & (saturation > 0.3)
                assert name == row.target or (fits & (brightness > 0.25)).mean() < 0.12, name


def away(hue_deg: Any, name: str) -> Any:
    """Degrees to the hue of a name."""
    named = ("red", "yellow", "green", "cyan", "blue", "magenta").index(name) * 60
    return abs((hue_deg - named + 180) % 360 - 180)


def test_several_targets_get_different_colours() -> None:
    assert len({c.name for c in choose_colours(len(PALETTE), [])}) == len(PALETTE)
    with pytest.raises(BadInstruction, match="name fewer objects"):
        choose_colours(len(PALETTE) + 1, [])


def test_when_every_colour_is_taken_the_least_present_is_used() -> None:
    rgb = np.concatenate(
        [np.full((1, 100 + 10 * i, 3), c.rgb, np.uint8) for i, c in enumerate(reversed(PALETTE))],
        axis=1,
    )
    chosen = choose_colours(1, [(rgb, [np.ones(rgb.shape[:2], bool)])])
    assert chosen[0].name == PALETTE[-1].name
