"""The whole method on a world whose every answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from tests.toys import TOYS, SameColour, personal, scene
from vap_core.attend import Attender, Prompting, load_stack
from vap_core.errors import BadInstruction, UnknownName
from vap_core.prompt import PALETTE, tint
from vap_core.values import Boxes

GREY, TEAL, SAND = (90, 90, 90), (40, 120, 110), (150, 130, 90)
CUP, VASE = personal("mug", "cup", TEAL, TEAL, TEAL), personal("ming", "vase", SAND)
MEMORY = {"mug": CUP, "ming": VASE}
RED, BLUE = PALETTE[0], PALETTE[1]
LINE = scene([(4, 20, GREY), (24, 20, TEAL), (44, 20, SAND)])


def where(rgb: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (rgb == colour).all(axis=2)


def test_the_right_one_is_tinted_and_named() -> None:
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    assert (grounding.winner, grounding.votes.tolist(), grounding.margin) == (1, [0, 3, 0], 1.0)
    assert attended.text == "bring the red cup"
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), RED)).all()


def test_tracking_follows_and_never_detects_again() -> None:
    calls: list[str] = []

    def counting(images: object, phrase: str, threshold: float | None = None) -> list[Boxes]:
        calls.append(phrase)
        return TOYS.detector(images, phrase)  # type: ignore[arg-type]

    attender = Attender(TOYS.__class__("toys", counting, TOYS.encoder, TOYS.segmenter, TOYS.tracker, ""), MEMORY)
    state, _ = attender.start({"front": LINE}, "bring my cup")
    moved = scene([(4, 20, GREY), (24, 40, TEAL), (44, 20, SAND)])
    state, attended = attender.step(state, {"front": moved})
    assert (attended.images["front"] == tint(moved, where(moved, TEAL), RED)).all()
    assert calls == ["cup"]


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
    assert (attended.images["front"] == tint(tint(moved, where(moved, TEAL), RED), where(moved, SAND), BLUE)).all()


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
    _, attended = Attender(TOYS, memory).start({"front": LINE}, "put my cup near my cup", objects=["one", "two"])
    assert any(e.level == "WARN" and "two targets share one object" in e.text for e in attended.events)
    assert (attended.images["front"] == tint(LINE, where(LINE, TEAL), attended.colours[0])).all()


def test_mirrored_views_mirror_the_answer() -> None:
    _, one = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup")
    _, two = Attender(TOYS, MEMORY).start({"front": LINE[:, ::-1].copy()}, "bring my cup")
    assert (one.images["front"][:, ::-1] == two.images["front"]).all()


@pytest.mark.parametrize(
    ("prompting", "tinted", "text"),
    [
        (Prompting(highlight=False), False, "bring the red cup"),
        (Prompting(rewrite=False), True, "bring my cup"),
        (Prompting(alpha=0.0), False, "bring the red cup"),
    ],
)
def test_switches(prompting: Prompting, tinted: bool, text: str) -> None:
    _, attended = Attender(TOYS, MEMORY, prompting).start({"front": LINE}, "bring my cup")
    assert ((attended.images["front"] != LINE).any(), attended.text) == (tinted, text)


def test_boxes_by_hand_replace_the_detector() -> None:
    by_hand = Boxes(np.array([[44, 20, 56, 32], [4, 20, 16, 32]], np.float32), np.ones(2, np.float32), "by hand")
    _, attended = Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup", boxes={"front": by_hand})
    assert len(attended.groundings["front"][0].candidates) == 2


def test_what_cannot_be_matched_is_said() -> None:
    attender = Attender(TOYS, {**MEMORY, "other": personal("other", "cup", GREY)})
    with pytest.raises(UnknownName, match="2 objects are a 'cup': mug, other; choose with --object"):
        attender.start({"front": LINE}, "bring my cup")
    with pytest.raises(UnknownName, match="no 'shoe' is remembered"):
        attender.start({"front": LINE}, "bring my shoe")
    with pytest.raises(UnknownName, match=r"'nobody' is unknown; known: ming, mug, other"):
        attender.start({"front": LINE}, "bring my cup", objects=["nobody"])
    with pytest.raises(BadInstruction, match="one each"):
        attender.start({"front": LINE}, "bring my cup", objects=["mug", "ming"])
    _, attended = attender.start({"front": LINE}, "bring my cup", objects=["other"])
    assert attended.groundings["front"][0].winner == 0


def test_unknown_stack() -> None:
    with pytest.raises(UnknownName, match="embedded"):
        load_stack("psychic")
