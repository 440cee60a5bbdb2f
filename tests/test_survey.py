"""The survey of opening frames: who is counted, who is elected, and what a box is worth, on constructed views; then the benchmarks' own frames."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.toys import TOYS, personal, scene
from vap_core.attend import GROUNDING_PX
from vap_core.base.types import Boxes, PersonalObject, Rgb
from vap_core.perception.protocols import Stack
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.types import EpisodeRow, Placement
from vap_core.study.perception import (
    ASSOCIATED,
    OFF,
    RULES,
    Tables,
    View,
    agreements,
    find_candidates,
    match,
    opening_views,
    registered_object,
    survey,
)
from vap_core.study.perception import survey_view as survey_one

RED, GREEN, BLUE = (250, 5, 5), (5, 250, 5), (5, 5, 250)
MINE, HARD, EASY = "cup-personal", "cup-lookalike-3", "cup-lookalike-6"
PLACES = {MINE: (4, 4, RED), HARD: (24, 4, GREEN), EASY: (44, 4, BLUE)}


def view(*names: str, hidden: Sequence[str] = ()) -> View:
    """A flat square per object on a picture of 64 pixels, 144 of them each; what is hidden is placed but not seen."""
    masks = {}
    for name in (*names, *hidden):
        x, y, _ = PLACES[name]
        masks[name] = np.zeros((64, 64), bool)
        masks[name][y : y + 12, x : x + 12] = name not in hidden
    row = EpisodeRow(
        "toys",
        "pick-cup",
        3,
        0,
        "pick my cup",
        "cup",
        tuple(Placement(name, 0.1, 0.1, 0.0) for name in (MINE, HARD, EASY)),
        10,
    )
    return View(row, "front", scene([PLACES[name] for name in names]), masks)


def memory(*colours: tuple[int, int, int]) -> dict[int, PersonalObject]:
    return {5: personal(MINE, "cup", *colours)}


def survey_view(seen: View, stack: Stack, known: dict[int, PersonalObject]) -> Tables:
    return survey_one(seen, stack, known, find_candidates([seen], stack)[0])


def test_tiers_of_the_toys() -> None:
    assert [objects.tier(objects.get_object(name)) for name in (HARD, EASY)] == ["hard", "easy"]


@pytest.mark.parametrize(
    ("references", "elected"),
    [([RED] * 5, MINE), ([GREEN] * 3 + [RED] * 2, HARD), ([BLUE] * 5, EASY)],
)
def test_the_elected_object_is_named(references: list[tuple[int, int, int]], elected: str) -> None:
    tables = survey_view(view(MINE, HARD, EASY), TOYS, memory(*references))
    vote = next(line for line in tables["choices"] if line["rule"] == "vote")
    assert (vote["elected"], vote["right"], vote["right_given_boxes"]) == (
        elected,
        elected == MINE,
        elected == MINE,
    )
    assert vote["mask_iou"] == (1.0 if elected == MINE else None)
    assert [line["rule"] for line in tables["choices"]] == list(RULES)
    (here,) = tables["views"]
    assert (
        here["target_px"],
        here["counts"],
        here["visible_alike"],
        here["tier"],
        here["candidates"],
    ) == (144, True, 3, "hard", 3)
    assert (here["proposed"], here["mask_iou_true_box"]) == (True, 1.0)
    assert [line["hit"] for line in tables["detections"] if line["asked"] == "category"] == [
        True
    ] * 3


def test_objects_carry_tier_and_cosine() -> None:
    lines = {
        line["object"]: line
        for line in survey_view(view(MINE, HARD, EASY), TOYS, memory(RED))["objects"]
    }
    assert [lines[name]["tier"] for name in (MINE, HARD, EASY)] == ["personal", "hard", "easy"]
    assert lines[MINE]["cosine"] == pytest.approx(1.0)
    assert lines[MINE]["cosine"] > lines[HARD]["cosine"]
    assert all(
        line["recalled"] and line["proposed"] and line["px"] == 144 for line in lines.values()
    )


def test_a_view_without_the_target_elects_nobody_and_does_not_count() -> None:
    tables = survey_view(view(EASY, hidden=(MINE,)), TOYS, memory(RED))
    (here,) = tables["views"]
    assert (here["counts"], here["target_px"], here["tier"], here["proposed"]) == (
        False,
        0,
        "standard",
        None,
    )
    assert tables["choices"] == []
    assert [line["object"] for line in tables["objects"]] == [EASY]


def test_a_view_without_candidates_is_a_miss_of_the_detector_alone() -> None:
    blind = replace(
        TOYS, detector=lambda images, phrase, threshold=None: [Boxes.empty(phrase) for _ in images]
    )
    tables = survey_view(view(MINE, HARD), blind, memory(RED))
    vote = tables["choices"][0]
    assert (
        vote["elected"],
        vote["right"],
        vote["right_given_boxes"],
        vote["margin"],
        vote["mask_iou"],
    ) == ("", False, True, 0.0, None)
    assert tables["views"][0]["proposed"] is False
    assert not any(line["recalled"] for line in tables["objects"])
    assert tables["detections"] == []


def test_a_box_on_nothing_is_called_nothing() -> None:
    def astray(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        return [
            Boxes(np.array([[4, 40, 16, 52]], np.float32), np.ones(1, np.float32), phrase)
            for _ in images
        ]

    lit = replace(view(MINE), rgb=scene([PLACES[MINE], (4, 40, RED)]))
    tables = survey_view(lit, replace(TOYS, detector=astray), memory(RED))
    assert tables["choices"][0]["elected"] == "nothing"
    assert [line["hit"] for line in tables["detections"]] == [False] * len(tables["detections"])


def boxes(*corners: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(corners, np.float32).reshape(-1, 4)


def test_a_second_box_on_an_object_is_false_and_one_on_an_ignored_object_counts_neither_way() -> (
    None
):
    here, there = (0.0, 0.0, 10.0, 10.0), (20.0, 0.0, 30.0, 10.0)
    assert match(boxes(here, here, there), boxes(here), boxes(there)) == [True, False, None]
    assert match(boxes(here), boxes(), boxes()) == [False]
    assert match(boxes(), boxes(here), boxes()) == []


@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=6),
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=4),
)
def test_match_agrees_with_a_slow_reference(
    found: list[tuple[int, int]], wanted: list[tuple[int, int]]
) -> None:
    def box(corner: tuple[int, int]) -> tuple[float, float, float, float]:
        return (float(corner[0]), float(corner[1]), corner[0] + 4.0, corner[1] + 4.0)

    def overlap(a: tuple[int, int], b: tuple[int, int]) -> float:
        both = max(0, 4 - abs(a[0] - b[0])) * max(0, 4 - abs(a[1] - b[1]))
        return both / (32 - both)

    free, expected = list(range(len(wanted))), []
    for mine in found:
        best = max(free, key=lambda i: overlap(mine, wanted[i]), default=None)
        expected.append(best is not None and overlap(mine, wanted[best]) >= 0.5)
        if expected[-1]:
            free.remove(best)
    assert match(boxes(*map(box, found)), boxes(*map(box, wanted)), boxes()) == expected


def test_openings_show_each_row_as_its_suite_does() -> None:
    rows = suites.rows("tabletop", "select-vase", 1)
    (first,), (again,) = list(opening_views(rows)), list(opening_views(rows))
    assert [v.camera for v in first] == ["front", "side", "wrist"]
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(first, again, strict=True))
    for v in first:
        assert set(v.masks) == {place.model for place in rows[0].placements}
        assert v.rgb.shape == (GROUNDING_PX, GROUNDING_PX, 3)
        assert v.least_px == 400


def test_agreements_tell_contradiction_and_what_geometry_makes_of_it() -> None:
    """True boxes, and embeddings that say who is who by a hair, but for one view in which they name a look-alike."""
    (episode,) = opening_views(suites.rows("vlabench", "select-shoe", 1))
    target = episode[0].row.target
    names = [name for name in episode[0].masks if objects.get_object(name).category == "shoe"]
    assert all(name in v.visible() for v in episode for name in names)
    other = next(name for name in names if name != target)
    mine = replace(personal(target, "shoe", RED), embeddings=np.array([[1.0, 0.0]], np.float32))

    def asked(favourites: Sequence[str]) -> dict[str, dict[str, Any]]:
        """The favourite of each view in turn is a hair more like the target than the others."""
        turn = itertools.cycle(favourites)

        def found(images: Sequence[Rgb], phrase: str, threshold: Any = None) -> list[Boxes]:
            corners = [np.stack([view.boxes()[name] for name in names]) for view in episode]
            return [Boxes(xyxy, np.ones(len(names), np.float32), phrase) for xyxy in corners]

        class Likes:
            name = TOYS.encoder.name

            def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
                favourite = next(turn)
                side = np.array([0.45 if name == favourite else 0.40 for name in names])
                return np.stack([side, np.sqrt(1 - side**2)], axis=1).astype(np.float32)

        stack = replace(TOYS, detector=found, encoder=Likes())
        return {line["associate"]: line for line in agreements(episode, mine, stack)}

    honest = asked([target] * 3)
    assert list(honest) == [OFF, ASSOCIATED]
    assert all(
        (line["case"], line["right"], line["views"]) == ("right", 3, 3) for line in honest.values()
    )
    torn = asked([target, other, target])
    assert (torn[OFF]["case"], torn[OFF]["right"]) == ("case 2", 2)
    assert (torn[ASSOCIATED]["case"], torn[ASSOCIATED]["right"]) == ("right", 2)


def test_the_list_is_spread_over_splits_and_variants() -> None:
    rows = suites.rows("simpler-fractal", "pick-pen-holder", 60)
    assert {row.split for row in rows} == {"visual matching", "variant aggregation"}
    assert {row.variant for row in rows} == {
        row.variant for row in suites.rows("simpler-fractal", "pick-pen-holder")
    }


def test_survey_fills_every_table_and_keys_every_line() -> None:
    from vap_core.perception.stacks import load_stack

    (episode,) = opening_views(suites.rows("simpler-bridge", "pick-shaver", 1))
    stack = load_stack("embedded")
    tables = survey(episode, stack, ks=(1, 5))
    assert len(tables["views"]) == 1
    assert [(line["k"], line["rule"]) for line in tables["choices"]] == [
        (1, "vote"),
        (1, "average"),
        (5, "vote"),
        (5, "average"),
    ]
    for name, lines in tables.items():
        assert lines, name
        assert all(
            line["suite"] == "simpler-bridge" and line["camera"] == "front" for line in lines
        )
    mine, _ = registered_object(stack, "shaver-personal", 5)
    assert len(mine.crops) == 5
