"""The whole method on a world whose every answer is known."""

import inspect
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.toys import TOYS, SameColour, overhead, personal, scene, unchecked
from vap_core.associate import compare_views
from vap_core.attend import Attender, Prompting
from vap_core.base.errors import BadInstruction, BadStudy, BadViews, UnknownName
from vap_core.base.events import is_lost
from vap_core.base.types import Attended, Boxes, Colour, Grounding, Rgb, Views
from vap_core.perception.protocols import Thresholds
from vap_core.perception.stacks import load_stack
from vap_core.policies.protocol import PolicyInput
from vap_core.prompt import PALETTE, Tint, tint
from vap_core.study.forms import NumberedMarker
from vap_core.vote import vote

GREY, TEAL, SAND = (90, 90, 90), (40, 120, 110), (150, 140, 130)
CUP, VASE = personal("mug", "cup", TEAL, TEAL, TEAL), personal("ming", "vase", SAND)
MEMORY = {"mug": CUP, "ming": VASE}
RED, BLUE = PALETTE[0], PALETTE[1]
LINE = scene([(4, 20, GREY), (24, 20, TEAL), (44, 20, SAND)])


def where(rgb: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (rgb == colour).all(axis=2)


def test_the_right_one_is_tinted_and_named() -> None:
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    ballot = grounding.ballot
    assert (grounding.winner, ballot.votes.tolist(), ballot.margin) == (1, [0, 3, 0], 1.0)
    assert attended.text == "bring the red cup"
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert [e.text for e in attended.events] == ["front: elects candidate 1 for mug with 3/3 votes"]


def test_a_wrong_vote_is_not_said_to_be_the_object() -> None:
    """Only a look-alike is in view: it is elected, and no event says that it is the mug."""
    alone = scene([(4, 20, GREY)])
    _, attended = Attender(TOYS, MEMORY).start({"front": alone}, "bring my cup")
    (event,) = attended.events
    assert event.text == "front: elects candidate 0 for mug with 3/3 votes"
    assert "mug is" not in event.text


def test_tracking_follows_and_never_detects_again() -> None:
    calls: list[str] = []

    def counting(images: object, phrase: str, threshold: float | None = None) -> list[Boxes]:
        calls.append(phrase)
        return TOYS.detector(images, phrase)  # type: ignore[arg-type]

    attender = Attender(replace(TOYS, detector=counting), MEMORY)
    state, _ = attender.start({"front": LINE}, "bring my cup")
    moved = scene([(4, 20, GREY), (24, 40, TEAL), (44, 20, SAND)])
    state, attended = attender.step(state, {"front": moved})
    assert (attended.images["front"] == tint(moved, where(moved, TEAL), RED)).all()
    assert calls == ["cup"]


def test_only_what_is_marked_is_followed() -> None:
    """Neither look-alikes nor a robot's hand among the candidates, nor a view without a target."""
    started: list[list[list[int]]] = []

    class OfTargets(SameColour):
        def start_targets(self, images, masks, targets):  # type: ignore[no-untyped-def]
            started.append([list(of_view) for of_view in targets])
            return self.start(images, masks)

    views = {"front": LINE, "side": scene([(4, 20, GREY), (44, 20, SAND)])}
    prompting = Prompting(always_tint=False)
    stack = replace(TOYS, tracker=OfTargets(), thresholds=Thresholds(0.999, 0.999))
    attender = Attender(stack, MEMORY, prompting)
    state, attended = attender.start(views, "bring my cup")
    assert started == [[[1]]]
    assert (list(state.trackers), state.ids) == (["front"], {"front": (1,), "side": (None,)})
    _, attended = attender.step(state, views)
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert attended.tracks["side"][0].mask is None

    marking = replace(prompting, form=NumberedMarker())
    Attender(stack, MEMORY, marking).start({"front": LINE}, "bring my cup")
    assert started[-1] == [[0, 1, 2]]


def test_a_view_without_candidates_passes_unmodified() -> None:
    empty = scene([])
    state, attended = Attender(TOYS, MEMORY).start({"front": LINE, "side": empty}, "bring my cup")
    assert attended.text == "bring the red cup"
    assert attended.images["side"] is empty
    assert attended.groundings["side"][0].winner is None
    assert any(e.level == "WARN" and "side: no cup" in e.text for e in attended.events)
    _, attended = Attender(TOYS, MEMORY).step(state, {"front": LINE, "side": LINE})
    assert (attended.images["side"] == LINE).all()


def test_nothing_found_anywhere_leaves_image_and_words_alone() -> None:
    _, attended = Attender(TOYS, MEMORY).start({"front": scene([])}, "bring my cup")
    assert attended.text == "bring my cup"
    assert not attended.images["front"].any()


def test_a_lost_mask_passes_unmodified_and_comes_back() -> None:
    attender = Attender(TOYS, MEMORY)
    state, _ = attender.start({"front": LINE}, "bring my cup")
    hidden = scene([(4, 20, GREY), (44, 20, SAND)])
    state, lost = attender.step(state, {"front": hidden})
    assert (lost.images["front"] == hidden).all()
    assert lost.tracks["front"][0].mask is None
    assert [e.level for e in lost.events] == ["WARN"]
    state, still = attender.step(state, {"front": hidden})
    assert not still.events
    _, back = attender.step(state, {"front": LINE})
    assert (back.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert ["re-acquired" in e.text for e in back.events] == [True]


def test_two_targets_two_colours() -> None:
    attender = Attender(TOYS, MEMORY)
    state, attended = attender.start({"front": LINE}, "put my cup near my vase")
    expected = tint(tint(LINE, where(LINE, TEAL), RED), where(LINE, SAND), BLUE)
    assert attended.text == "put the red cup near the blue vase"
    assert (attended.images["front"] == expected).all()
    moved = scene([(4, 20, GREY), (24, 40, TEAL), (44, 5, SAND)])
    _, attended = attender.step(state, {"front": moved})
    assert (
        attended.images["front"]
        == tint(tint(moved, where(moved, TEAL), RED), where(moved, SAND), BLUE)
    ).all()


def test_one_object_proposed_for_two_phrases_is_tracked_once() -> None:
    """Two phrases that find the same boxes must not make rival identities of one object."""
    started: list[int] = []

    class Counting(SameColour):
        def start(self, images, masks):  # type: ignore[no-untyped-def]
            started.extend(len(of_view) for of_view in masks)
            return super().start(images, masks)

    attender = Attender(replace(TOYS, tracker=Counting()), MEMORY)
    state, attended = attender.start({"front": LINE}, "put my cup near my vase")
    assert started == [3]
    assert state.ids == {"front": (1, 2)}
    assert not any("share one object" in e.text for e in attended.events)


def test_two_targets_on_one_object_is_a_warning_and_tints_once() -> None:
    memory = {"one": CUP, "two": personal("two", "cup", TEAL)}
    _, attended = Attender(TOYS, memory).start(
        {"front": LINE}, "put my cup near my cup", objects=["one", "two"]
    )
    assert any(
        e.level == "WARN" and "two targets share one object" in e.text for e in attended.events
    )
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), attended.colours[0])).all()


def unseen_colours(attended: Attended, views: Views) -> set[str]:
    """The colours of the text that no view was tinted in."""
    unseen = set()
    for colour in PALETTE:
        if colour.name not in attended.text.split():
            continue
        tinted = 0
        for camera, rgb in views.items():
            shown = attended.images[camera]
            everywhere = tint(rgb, np.ones(rgb.shape[:2], bool), colour)
            changed = (shown != rgb).any(axis=2)
            tinted += ((shown == everywhere).all(axis=2) & changed).sum()
        if not tinted:
            unseen.add(colour.name)
    return unseen


TWICE = "pick up my vase, then put my vase on the shelf"
TWO = "put my cup near my vase"
ALIKE = {"mug": CUP, "ming": personal("ming", "vase", TEAL)}
"""Both elect the teal square."""


def test_an_object_that_is_named_twice_is_one_target() -> None:
    attender = Attender(TOYS, MEMORY)
    state, attended = attender.start({"front": LINE}, TWICE)
    assert attended.text == "pick up the red vase, then put the red vase on the shelf"
    assert attended.colours == (RED,)
    assert [g.object for g in attended.groundings["front"]] == ["ming"]
    assert len(attended.tracks["front"]) == 1
    assert [e.text for e in attended.events] == [
        "front: elects candidate 2 for ming with 1/1 votes"
    ]
    assert (attended.images["front"] == tint(LINE, where(LINE, SAND), RED)).all()
    moved = scene([(24, 40, SAND)])
    _, attended = attender.step(state, {"front": moved})
    assert (attended.images["front"] == tint(moved, where(moved, SAND), RED)).all()
    assert attended.text == state.text


def test_mentions_of_two_objects_in_turn_keep_their_colours() -> None:
    text = "put my cup near my vase, then my vase near my cup"
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, text)
    assert attended.text == (
        "put the red cup near the blue vase, then the blue vase near the red cup"
    )
    assert attended.colours == (RED, BLUE)


def test_an_object_that_is_named_more_often_than_there_are_colours() -> None:
    text = ", ".join(["my vase"] * (len(PALETTE) + 1))
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, text)
    assert attended.text == text.replace("my", "the red")


def test_an_object_given_by_hand_for_two_mentions_is_one_target() -> None:
    attender = Attender(TOYS, {**MEMORY, "other": personal("other", "cup", GREY)})
    text = "put my cup near my cup"
    _, one = attender.start({"front": LINE}, text, objects=["other", "other"])
    assert (one.text, len(one.colours)) == ("put the red cup near the red cup", 1)
    _, two = attender.start({"front": LINE}, text, objects=["other", "mug"])
    assert (two.text, len(two.colours)) == ("put the red cup near the blue cup", 2)


def test_a_second_object_in_the_box_of_the_first_keeps_its_words() -> None:
    """At most one of the two is right, and no pixel has the second one's colour."""
    state, attended = Attender(TOYS, ALIKE).start({"front": LINE}, TWO)
    assert attended.text == state.text == "put the red cup near my vase"
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()
    assert any("front: two targets share one object" in e.text for e in attended.events)


def test_a_second_object_that_another_view_shows_has_its_colour() -> None:
    """In the side view the vase is SAND, nearer to its references than GREY is."""
    memory = {"mug": CUP, "ming": personal("ming", "vase", SAND)}
    views = {"front": scene([(24, 20, TEAL)]), "side": scene([(4, 20, TEAL), (44, 20, SAND)])}
    _, attended = Attender(TOYS, memory).start(views, TWO)
    assert attended.text == "put the red cup near the blue vase"
    assert not unseen_colours(attended, views)


def test_a_box_that_is_wider_for_the_second_object_is_the_same_object() -> None:
    """Its tracker follows one identity, so that what its mask has more is not tinted either."""

    def wider(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        x1 = 34 if phrase == "cup" else 36
        return [given_by_hand((24, 20, x1, 32))["front"] for _ in images]

    attender = Attender(replace(TOYS, detector=wider), ALIKE)
    state, attended = attender.start({"front": LINE}, TWO)
    assert state.ids == {"front": (0, 0)}
    assert attended.text == "put the red cup near my vase"
    first = where(LINE, TEAL) & (np.arange(64) < 34)
    assert (attended.images["front"] == tint(LINE, first, RED)).all()
    one, other = attended.tracks["front"]
    assert (one.mask == other.mask).all()
    _, attended = attender.step(state, {"front": LINE})
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()


def test_a_second_object_inside_the_first_keeps_its_words() -> None:
    """Its box is one of its own, and every pixel of it is the first one's already."""
    boxes = given_by_hand((24, 20, 36, 32), (26, 22, 32, 28))

    def parted(image: Rgb, of_view: Boxes) -> np.ndarray:
        masks = np.zeros((len(of_view), *image.shape[:2]), bool)
        for mask, (x0, y0, x1, y1) in zip(masks, of_view.xyxy.astype(int), strict=True):
            mask[y0:y1, x0:x1] = True
        return masks

    view = LINE.copy()
    view[22:28, 26:32] = SAND
    memory = {"mug": personal("mug", "cup", (68, 122, 105)), "ming": MEMORY["ming"]}
    attender = Attender(replace(TOYS, segmenter=parted), memory)
    state, attended = attender.start({"front": view}, TWO, boxes=boxes)
    assert state.ids == {"front": (0, 1)}
    assert attended.text == "put the red cup near my vase"
    assert not unseen_colours(attended, {"front": view})
    warned = [e.text for e in attended.events if e.level == "WARN"]
    assert warned == ["front: ming is inside another target, it is not marked in this view"]


squares = st.lists(st.sampled_from([GREY, TEAL, SAND, (200, 40, 40)]), max_size=3)


@given(
    shown=st.lists(squares, min_size=1, max_size=2),
    alike=st.booleans(),
    text=st.sampled_from(["bring my cup", TWICE, TWO, f"{TWO}, then my vase near my cup"]),
    unlike=st.booleans(),
)
def test_every_colour_that_is_named_is_visible(
    shown: list[list[tuple[int, int, int]]], alike: bool, text: str, unlike: bool
) -> None:
    views = {}
    for number, colours in enumerate(shown):
        placed = [(4 + 20 * i, 20, colour) for i, colour in enumerate(colours)]
        views[f"view {number}"] = scene(placed)
    stack = TOYS if unlike else replace(TOYS, thresholds=Thresholds(0.999, 0.999))
    _, attended = Attender(stack, ALIKE if alike else MEMORY).start(views, text)
    assert not unseen_colours(attended, views)


def test_mirrored_views_mirror_the_answer() -> None:
    _, one = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup")
    _, two = Attender(TOYS, MEMORY).start({"front": LINE[:, ::-1].copy()}, "bring my cup")
    assert (one.images["front"][:, ::-1] == two.images["front"]).all()


@pytest.mark.parametrize(
    ("prompting", "tinted", "text"),
    [
        (Prompting(highlight=False), False, "bring the red cup"),
        (Prompting(rewrite=False), True, "bring my cup"),
        (Prompting(form=Tint(0.0)), False, "bring the red cup"),
    ],
)
def test_switches(prompting: Prompting, tinted: bool, text: str) -> None:
    _, attended = Attender(TOYS, MEMORY, prompting).start({"front": LINE}, "bring my cup")
    assert ((attended.images["front"] != LINE).any(), attended.text) == (tinted, text)


@pytest.mark.parametrize(
    ("field", "wrong", "error", "said"),
    [
        ("rule", "mean", UnknownName, "Prompting: rule 'mean' is unknown; known: average, best"),
        ("references", 0, BadStudy, "references is 0; give 1 or more, or None for all"),
    ],
)
def test_what_is_no_switch_is_refused(
    field: str, wrong: Any, error: type[Exception], said: str
) -> None:
    """Set past the check of signatures, which users do not have."""
    prompting = Prompting()
    object.__setattr__(prompting, field, wrong)
    with pytest.raises(error, match=said):
        prompting.__post_init__()


def test_boxes_by_hand_replace_the_detector() -> None:
    by_hand = Boxes(
        np.array([[44, 20, 56, 32], [4, 20, 16, 32]], np.float32), np.ones(2, np.float32), "by hand"
    )
    _, attended = Attender(TOYS, MEMORY).start(
        {"front": LINE}, "bring my cup", boxes={"front": by_hand}
    )
    assert len(attended.groundings["front"][0].candidates) == 2


def test_a_view_without_boxes_by_hand_passes_unmodified() -> None:
    one = Boxes(np.array([[4, 20, 16, 32]], np.float32), np.ones(1, np.float32), "by hand")
    views = {"front": LINE, "wrist": LINE}
    _, attended = Attender(TOYS, MEMORY).start(views, "bring my cup", boxes={"front": one})
    assert (attended.images["front"] != LINE).any()
    assert np.array_equal(attended.images["wrist"], LINE)
    assert attended.groundings["wrist"][0].ballot.winner is None


def test_a_view_keeps_its_size() -> None:
    attender = Attender(TOYS, MEMORY)
    state, _ = attender.start({"front": LINE}, "bring my cup")
    with pytest.raises(BadViews, match="'front' is 80x64, but the episode started with 64x64"):
        attender.step(state, {"front": np.zeros((64, 80, 3), np.uint8)})


@pytest.mark.parametrize(
    ("views", "said"),
    [
        ({}, "no views; give the picture of every camera, by its name"),
        (LINE, "no views"),
        ({"front": None}, "view 'front' is NoneType; give RGB, height x width x 3, uint8"),
        (
            {"front": LINE.astype(np.float32)},
            "view 'front' is ndarray float32 (64, 64, 3); give RGB",
        ),
        ({"front": LINE.transpose(2, 0, 1)}, "view 'front' is ndarray uint8 (3, 64, 64); give RGB"),
        (
            {"front": np.dstack([LINE, LINE[..., :1]])},
            "view 'front' is ndarray uint8 (64, 64, 4); give RGB",
        ),
        ({"front": LINE[..., 0]}, "view 'front' is ndarray uint8 (64, 64); give RGB"),
        ({"front": LINE[None]}, "view 'front' is ndarray uint8 (1, 64, 64, 3); give RGB"),
        ({"front": LINE[:0]}, "view 'front' is ndarray uint8 (0, 64, 3); give RGB"),
        ({"front": LINE, "wrist": LINE.tolist()}, "view 'wrist' is list; give RGB"),
    ],
)
def test_a_view_that_is_no_rgb_picture_is_refused_at_every_step(views: Any, said: str) -> None:
    """Without the check of signatures, which users do not have."""
    attender = Attender(TOYS, MEMORY)
    state, _ = attender.start({"front": LINE}, "bring my cup")
    start, steps = inspect.unwrap(Attender.start), inspect.unwrap(Attender.steps)
    with pytest.raises(BadViews, match=re.escape(said)):
        start(attender, views, "bring my cup")
    with pytest.raises(BadViews, match=re.escape(said)):
        steps(attender, [state], [views])


def test_boxes_of_an_unknown_camera_are_refused() -> None:
    one = Boxes(np.array([[4, 20, 16, 32]], np.float32), np.ones(1, np.float32), "by hand")
    with pytest.raises(BadViews, match="boxes of fornt, but the views are of front, side; name"):
        Attender(TOYS, MEMORY).start(
            {"front": LINE, "side": LINE}, "bring my cup", boxes={"fornt": one}
        )


def given_by_hand(*xyxy: tuple[float, float, float, float]) -> dict[str, Boxes]:
    return {"front": Boxes(np.array(xyxy, np.float32), np.ones(len(xyxy), np.float32), "by hand")}


def test_boxes_by_hand_are_clipped_to_their_view() -> None:
    """What crops and masks are cut from; a box inside its view stays as it is."""
    inside = (4.3, 20.7, 16.1, 32.9)
    boxes = given_by_hand(inside, (24, -9e9, 36, 9e9), (-5, -5, 64.5, 70))
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup", boxes=boxes)
    found = attended.groundings["front"][0].candidates.xyxy
    assert np.array_equal(found[0], np.array(inside, np.float32))
    assert found[1:].tolist() == [[24, 0, 36, 64], [0, 0, 64, 64]]
    assert found.dtype == np.float32


@pytest.mark.parametrize(
    "box",
    [(64, 0, 90, 20), (-20, -20, 0, 0), (63.5, 0, 80, 20), (10, 1e12, 20, 2e12), (0, 3, 9, 3.5)],
)
def test_a_box_by_hand_without_a_pixel_of_its_view_is_refused(
    box: tuple[float, float, float, float],
) -> None:
    """There is nothing to embed in it, and a mask of it would be empty."""
    attender = Attender(TOYS, MEMORY)
    with pytest.raises(BadViews, match=r"of view 'front' has less than one .* 64x64 picture") as it:
        attender.start({"front": LINE}, "bring my cup", boxes=given_by_hand((4, 20, 16, 32), box))
    assert str(np.array(box, np.float32).tolist()) in str(it.value)


def test_what_cannot_be_matched_is_said() -> None:
    attender = Attender(TOYS, {**MEMORY, "other": personal("other", "cup", GREY)})
    with pytest.raises(UnknownName, match="2 objects are a cup: mug, other; choose with --object"):
        attender.start({"front": LINE}, "bring my cup")
    with pytest.raises(UnknownName, match="no 'shoe' is remembered"):
        attender.start({"front": LINE}, "bring my shoe")
    with pytest.raises(UnknownName, match="'mug' is the name of a cup; say \"my cup\""):
        attender.start({"front": LINE}, "bring my mug")
    with pytest.raises(UnknownName, match=r"'nobody' is unknown; known: ming, mug, other"):
        attender.start({"front": LINE}, "bring my cup", objects=["nobody"])
    with pytest.raises(BadInstruction, match="one each"):
        attender.start({"front": LINE}, "bring my cup", objects=["mug", "ming"])
    _, attended = attender.start({"front": LINE}, "bring my cup", objects=["other"])
    assert attended.groundings["front"][0].winner == 0


DIM, TEALISH, MOSS = (60, 80, 70), (55, 115, 100), (50, 115, 95)
CAMERAS = {
    "front": overhead("front", 0.0),
    "side": overhead("side", 0.25),
    "wrist": overhead("wrist", 0.5),
}
"""Each sees the table 16 pixels further left than the one before."""
CONTRADICTING = {
    "front": scene([(4, 20, DIM), (36, 20, TEAL)]),
    "side": scene(
        [(20, 20, TEALISH), (4, 45, MOSS)]
    ),  # the one at x = 20 is the front's at 36; the other, from beyond its edge, looks more like it
    "wrist": scene([(24, 8, DIM)]),  # and this is neither of them
}


def same(one: Attended, two: Attended) -> bool:
    """Bit for bit, but for the associations."""

    def flat(g: Grounding) -> list[object]:
        return [
            g.candidates.xyxy.tolist(),
            g.similarity.tolist(),
            g.ballot.votes.tolist(),
            g.winner,
            g.ballot.winner,
            g.overruled,
            g.ballot.margin,
            g.ballot.cosine_margin,
            g.masks.tolist(),
        ]

    return (
        (one.text, [e.text for e in one.events], list(one.images))
        == (two.text, [e.text for e in two.events], list(two.images))
        and all((one.images[c] == two.images[c]).all() for c in one.images)
        and all(
            [flat(g) for g in one.groundings[c]] == [flat(g) for g in two.groundings[c]]
            for c in one.groundings
        )
    )


def test_views_by_themselves_contradict_each_other_and_together_agree() -> None:
    _, alone = Attender(TOYS, MEMORY).start(CONTRADICTING, "bring my cup", cameras=CAMERAS)
    assert [alone.groundings[c][0].winner for c in CONTRADICTING] == [1, 0, 0]
    assert alone.associations == ()
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    state, attended = attender.start(CONTRADICTING, "bring my cup", cameras=CAMERAS)
    front, side, wrist = (attended.groundings[c][0] for c in CONTRADICTING)
    assert [(g.winner, g.ballot.winner, g.overruled) for g in (front, side, wrist)] == [
        (1, 1, False),
        (1, 0, True),
        (None, 0, True),
    ]
    assert (side.ballot.votes.tolist(), side.ballot.margin) == (
        [3, 0],
        1.0,
    )  # the ballot stays as it was
    (found,) = attended.associations
    assert found.chosen == {"front": 1, "side": 1, "wrist": None}
    assert found.margin > 0
    assert set(found.terms) == {"references", "geometry"}
    assert (
        attended.images["side"]
        == tint(CONTRADICTING["side"], where(CONTRADICTING["side"], TEALISH), RED)
    ).all()
    assert attended.images["wrist"] is CONTRADICTING["wrist"]
    assert attended.text == "bring the red cup"
    said = [e.text for e in attended.events]
    assert any(
        text.startswith(
            "side: takes candidate 1 for mug with 0/3 votes by association, over candidate 0 with 3"
        )
        for text in said
    )
    assert any(text.startswith("wrist: mug is none of 1 candidate by association") for text in said)
    assert any(text.startswith("mug: views associated, margin") for text in said)
    moved = {**CONTRADICTING, "side": scene([(30, 30, TEALISH), (4, 45, MOSS)])}
    _, followed = attender.step(state, moved)
    assert (
        followed.images["side"] == tint(moved["side"], where(moved["side"], TEALISH), RED)
    ).all()
    assert followed.tracks["wrist"][0].mask is None
    assert followed.associations == attended.associations


def test_association_off_and_cameras_given_is_the_paper_bit_for_bit() -> None:
    _, plain = Attender(TOYS, MEMORY).start(CONTRADICTING, "bring my cup")
    _, off = Attender(TOYS, MEMORY, Prompting()).start(
        CONTRADICTING, "bring my cup", cameras=CAMERAS
    )
    assert same(plain, off)


def test_one_view_is_the_plain_vote() -> None:
    """Also with a second view that shows nothing: one has nobody to agree with."""
    associating = Attender(TOYS, MEMORY, Prompting(associate=True))
    for views in ({"front": LINE}, {"front": LINE, "side": scene([])}):
        _, plain = Attender(TOYS, MEMORY).start(views, "bring my cup")
        _, attended = associating.start(views, "bring my cup")
        assert same(plain, attended)
        assert attended.associations == (None,)


def test_each_of_several_targets_is_associated_by_itself() -> None:
    sandy = {camera: rgb.copy() for camera, rgb in CONTRADICTING.items()}
    for x, view in ((40, "front"), (24, "side"), (8, "wrist")):
        sandy[view][48:60, x : x + 12] = SAND
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    _, attended = attender.start(sandy, "put my cup near my vase", cameras=CAMERAS)
    cup, vase = attended.associations
    assert [g.object for g in attended.groundings["front"]] == ["mug", "ming"]
    chosen = {
        camera: [None if g.mask is None else tuple(sandy[camera][g.mask][0]) for g in gs]
        for camera, gs in attended.groundings.items()
    }
    assert chosen == {"front": [TEAL, SAND], "side": [TEALISH, SAND], "wrist": [None, SAND]}
    assert {camera: g[0].winner for camera, g in attended.groundings.items()} == cup.chosen
    assert {camera: g[1].winner for camera, g in attended.groundings.items()} == vase.chosen


def test_views_that_cannot_be_associated_are_said() -> None:
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    with pytest.raises(
        BadViews, match="associate: needs calibrated cameras; give Attender.start cameras="
    ):
        attender.start(CONTRADICTING, "bring my cup")
    misnamed = {name.upper(): camera for name, camera in CAMERAS.items()}
    with pytest.raises(BadViews, match=r"for front, side, wrist \(given: FRONT, SIDE, WRIST\)"):
        attender.start(CONTRADICTING, "bring my cup", cameras=misnamed)
    small = {**CAMERAS, "side": replace(CAMERAS["side"], width=32)}
    with pytest.raises(
        BadViews, match="camera 'side' is calibrated for 32x64 pixels, but its view has 64x64"
    ):
        attender.start(CONTRADICTING, "bring my cup", cameras=small)


def in_millimetres(pose: np.ndarray) -> np.ndarray:
    return np.block([[pose[:3, :3], 1000 * pose[:3, 3:]], [pose[3:]]])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"pose_world": in_millimetres}, "stands 1000 m above the table"),
        ({"pose_world": lambda pose: pose * np.nan}, "has numbers that are not finite"),
        ({"pose_world": lambda pose: 2.0 * pose}, "has a pose_world without a rotation"),
        ({"pose_world": lambda pose: pose @ np.diag([-1.0, 1, 1, 1])}, "has a pose_world without"),
        ({"k": np.zeros_like}, "has a k that cannot be inverted"),
        ({"k": lambda k: k[:2]}, "has a k that is not 3 x 3"),
    ],
)
def test_a_camera_that_cannot_stand_so_is_refused(change: Any, said: str) -> None:
    """Its rays meet the objects of no other view: every other one would lose its tint."""
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    ((field, how),) = change.items()
    side = unchecked(CAMERAS["side"], **{field: how(getattr(CAMERAS["side"], field))})
    with pytest.raises(BadViews, match=f"camera 'side' {said}.*with the table at z = 0"):
        attender.start(CONTRADICTING, "bring my cup", cameras={**CAMERAS, "side": side})


def test_one_camera_may_look_up_and_not_all() -> None:
    """A hand looks where it turns; OpenGL's axes turn every camera away."""
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    turned = {}
    for name, camera in CAMERAS.items():
        turned[name] = replace(camera, pose_world=camera.pose_world @ np.diag([1.0, -1, -1, 1]))
    _, attended = attender.start(
        CONTRADICTING, "bring my cup", cameras={**CAMERAS, "wrist": turned["wrist"]}
    )
    assert [attended.groundings[c][0].winner for c in CONTRADICTING] == [1, 1, None]
    with pytest.raises(BadViews, match="'front' looks away from the table, as all do.*OpenCV axes"):
        attender.start(CONTRADICTING, "bring my cup", cameras=turned)


def test_on_a_rendered_desk_with_three_cameras_no_view_contradicts_another() -> None:
    """From the true boxes of the real models; the mug is remembered by what the front camera sees, so that its own view is beyond doubt."""
    from vap_core.memory import remember
    from vap_core.perception.boxes import crop
    from vap_core.rollout.loop import Trial, rollout
    from vap_core.rollout.prompters import TintPrompter
    from vap_core.simulation.env import Env
    from vap_core.simulation.scenes import build
    from vap_core.simulation.suites import rows, suite
    from vap_core.study.methods import METHODS

    desk, row = suite("tabletop"), rows("tabletop", "select-cup")[3]
    stack = load_stack("embedded")
    with build(desk.robot, [place.model for place in row.placements]) as world:
        env = Env(world, cameras=row.cameras, control=desk.control, sensor=desk.sensor)
        env.reset(row)
        views, truth = env.observe().images, env.truth(masks=True).masks
        shown = {
            c: [name for name, mask in masks.items() if mask.sum() > 40]
            for c, masks in truth.items()
        }
        boxes = {
            c: Boxes(
                np.array([around(truth[c][name]) for name in shown[c]], np.float32),
                np.ones(len(shown[c]), np.float32),
                "",
            )
            for c in views
        }
        mine = remember(
            "mug",
            "cup",
            [crop(views["front"], boxes["front"].xyxy[shown["front"].index(row.target)])],
            stack.encoder,
        )

        def true_boxes(images: Sequence[Rgb], phrase: str, threshold: Any = None) -> list[Boxes]:
            scale = np.float32(images[0].shape[0] / views["front"].shape[0])
            return [replace(boxes[c], xyxy=scale * boxes[c].xyxy) for c in row.cameras]

        by_hand = replace(stack, detector=true_boxes)
        # one reference from one side is less like the other views than the threshold for five
        prompting = replace(METHODS["vap-associated"], always_tint=True)
        attender = Attender(by_hand, {"mug": mine}, prompting)
        trial = Trial(
            method="vap-associated",
            scene=world,
            policy=Still(),
            prompter=TintPrompter(attender),
            control=desk.control,
            sensor=desk.sensor,
        )
        (episode,) = rollout(trial, [replace(row, max_steps=1)])
    assert episode.outcome.status == "failure", episode.outcome.detail
    groundings = {camera: of_view[0] for camera, of_view in episode.header.groundings.items()}
    prompted = {
        camera: None if g.winner is None else shown[camera][g.winner]
        for camera, g in groundings.items()
    }
    assert compare_views(prompted, row.target) == "right"
    assert list(prompted.values()).count(row.target) >= 2
    (found,) = episode.header.associations
    assert found.chosen == {camera: g.winner for camera, g in groundings.items()}
    assert [g.ballot.winner for g in groundings.values()] == [
        vote(g.similarity).winner for g in groundings.values()
    ]


class Still:
    """A policy that never moves."""

    label, execute = "still", 1

    def start(self, rng: np.random.Generator) -> None:
        return None

    def plan(
        self, states: Sequence[None], inputs: Sequence[PolicyInput]
    ) -> tuple[list[None], list[np.ndarray]]:
        return list(states), [
            np.zeros((1, len(one.state) - 6), np.float32) for one in inputs
        ]  # joints and gripper


def around(mask: np.ndarray) -> list[int]:
    rows, columns = np.nonzero(mask)
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


def test_unknown_stack() -> None:
    with pytest.raises(UnknownName, match="embedded"):
        load_stack("psychic")


def test_episodes_that_are_stepped_together_are_as_if_alone():
    attender = Attender(TOYS, MEMORY)
    other = scene([(4, 4, GREY), (24, 44, TEAL), (44, 4, SAND)])
    states = [
        attender.start({"front": LINE}, "bring my cup")[0],
        attender.start({"front": other}, "bring my vase")[0],
    ]
    views = [{"front": LINE[:, ::-1].copy()}, {"front": other[::-1].copy()}]
    together = attender.steps(states, views)
    for (_, attended), state, seen in zip(together, states, views, strict=True):
        alone = attender.step(state, seen)[1]
        assert (attended.images["front"] == alone.images["front"]).all()
        assert attended.text == alone.text


def test_the_palette_gives_the_colour():
    attender = Attender(TOYS, MEMORY, Prompting(palette=PALETTE[2:3]))
    assert attender.start({"front": LINE}, "bring my cup")[1].text == "bring the green cup"


@pytest.mark.parametrize(
    ("name", "rgb"), [("white", (255, 255, 255)), ("black", (0, 0, 0)), ("pale", (255, 200, 200))]
)
def test_a_colour_without_a_hue_is_refused(name: str, rgb: tuple[int, int, int]) -> None:
    """Every grey has the hue of red: a white object would be measured as not white."""
    with pytest.raises(BadStudy, match=f"palette's '{name}' .* take a vivid one"):
        Prompting(palette=(*PALETTE, Colour(name, rgb)))


def test_a_colour_that_is_named_twice_is_refused() -> None:
    with pytest.raises(BadStudy, match="the palette has 'red' twice"):
        Prompting(palette=(*PALETTE, Colour("red", (200, 40, 40))))


@pytest.mark.parametrize("cameras", [("front", "side"), ("side", "front")])
def test_a_colour_that_any_view_shows_is_not_chosen(cameras):
    red = scene([(4, 20, (250, 10, 10)), (24, 20, TEAL)])
    views = dict(zip(cameras, (LINE, red), strict=True))
    assert Attender(TOYS, MEMORY).start(views, "bring my cup")[1].text == "bring the blue cup"


def test_a_small_rivals_colour_is_not_chosen():
    wide = scene([(4, 20, (250, 10, 10)), (100, 100, TEAL)], size=256)
    shown = Attender(TOYS, MEMORY).start({"front": wide}, "bring my cup")[1]
    assert shown.text == "bring the blue cup"


def test_a_calibrated_view_may_be_oblong():
    wide = np.pad(LINE, ((0, 0), (0, 32), (0, 0)))
    cameras = {name: replace(overhead(name, 0.0), width=96) for name in ("a", "b")}
    attender = Attender(TOYS, MEMORY, Prompting(associate=True))
    attender.start(dict.fromkeys(cameras, wide), "bring my cup", cameras=cameras)


def test_a_view_that_shows_another_target_is_not_called_unmodified() -> None:
    """The first step and the next; a view without any target still passes unmodified."""
    both = scene([(4, 4, (200, 30, 30)), (30, 30, (30, 30, 200))])
    one = scene([(4, 4, (200, 30, 30))])
    none = np.zeros_like(one)
    memory = {
        "mug": personal("mug", "cup", (30, 30, 200)),
        "bag": personal("bag", "bag", (200, 30, 30)),
    }
    attender = Attender(TOYS, memory)
    state, _ = attender.start({"front": both}, "put my cup near my bag")
    state, attended = attender.step(state, {"front": one})
    assert (attended.images["front"] != one).any()
    (event,) = attended.events
    assert event.text == "front: target 0 not visible, it is not marked in this view"
    assert is_lost(event)
    _, attended = attender.step(state, {"front": none})
    (event,) = attended.events
    assert event.text == "front: target 1 not visible, the view passes unmodified"
    assert is_lost(event)

    def found(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        """Bags alone."""
        if phrase == "cup":
            return [Boxes.empty(phrase) for _ in images]
        return TOYS.detector(images, phrase, threshold)

    attender = Attender(replace(TOYS, detector=found), memory)
    _, attended = attender.start({"front": both}, "put my cup near my bag")
    assert attended.events[0].text == "front: no cup found, it is not marked in this view"
    _, attended = attender.start({"front": none}, "put my cup near my bag")
    assert attended.events[0].text == "front: no cup found, the view passes unmodified"
