"""Proposals of any object: what the phrase adds, which of them are candidates, and who is not in view."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.toys import TOYS, MeanColour, detector, overhead, personal, scene
from vap_core.attend import MOST_ASKED, Attender, Prompting
from vap_core.base.types import Boxes, Rgb
from vap_core.memory import load, reference_box, register, save
from vap_core.perception.boxes import box_cover
from vap_core.perception.candidates import MOST_CANDIDATES
from vap_core.perception.embedded import proposer
from vap_core.perception.embedded.encoder import stretch_contrast
from vap_core.perception.embedded.networks import FOLDER, MANIFEST
from vap_core.perception.embedded.proposer import (
    BINS,
    PROPOSER_SIDE,
    OpenDetector,
    Proposer,
    decode_proposals,
    tiles_of,
)
from vap_core.perception.protocols import Detector, Stack, Thresholds
from vap_core.prompt import PALETTE, tint
from vap_core.vote import RULES, shortlist, vote

TEAL, SAND = (40, 120, 110), (150, 140, 130)
CUP_BOX, BOWL_BOX = (4, 20, 16, 32), (24, 20, 36, 32)
DESK = scene([(4, 20, TEAL), (24, 20, TEAL), (44, 20, SAND)])
MUG = personal("mug", "cup", TEAL, TEAL, TEAL)


def boxes(*xyxy: Sequence[float], phrase: str = "cup", score: float = 0.5) -> Boxes:
    corners = np.array(xyxy, np.float32).reshape(-1, 4)
    return Boxes(corners, np.full(len(corners), score, np.float32), phrase)


def knows_cups(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
    """A phrase head that knows where the cup is, and no other word."""
    found = boxes(CUP_BOX) if phrase == "cup" else Boxes.empty(phrase)
    return [found] * len(images)


class AllSquares:
    """Proposes every square, and between the first two a box of both."""

    def __call__(self, rgb: Rgb, *limits: float) -> tuple[np.ndarray, np.ndarray]:
        xyxy = np.array([(4, 20, 36, 32), BOWL_BOX, CUP_BOX, (44, 20, 56, 32)], np.float32)
        return xyxy, np.full(4, 0.5, np.float32)


DETECTOR = OpenDetector(AllSquares(), knows_cups)
OPEN = replace(TOYS, detector=DETECTOR, by_category=knows_cups)


def elected(stack: Stack, phrase: str, obj: object = None) -> tuple[float, ...]:
    """The box that is elected for "my phrase"."""
    mine = replace(obj or MUG, category=phrase)
    _, attended = Attender(stack, {"mug": mine}).start({"front": DESK}, f"bring my {phrase}")
    (grounding,) = attended.groundings["front"]
    return tuple(grounding.candidates.xyxy[grounding.winner])


def unsure_of(*xyxy: Sequence[float]) -> Detector:
    """A phrase head that is too unsure for the view to be familiar."""
    return lambda images, phrase, threshold=None: [boxes(*xyxy, score=0.2)] * len(images)


def test_an_unknown_word_rejects_nothing() -> None:
    known, unsure, unknown = (
        OpenDetector(AllSquares(), head)([DESK], phrase)[0]
        for head, phrase in ((knows_cups, "cup"), (unsure_of(CUP_BOX), "cup"), (knows_cups, "x"))
    )
    assert (known.xyxy == unknown.xyxy).all()
    assert [found.familiar for found in (known, unsure, unknown)] == [True, False, False]
    assert elected(OPEN, "ornament", personal("mug", "cup", SAND)) == (44, 20, 56, 32)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 12), k=st.integers(1, 6))
def test_a_vote_among_the_candidates_is_one_among_all_proposals(seed: int, n: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    near = rng.uniform(0, 50, (n, 2))
    xyxy = np.concatenate([near, near + rng.uniform(5, 30, (n, 2))], axis=1).astype(np.float32)
    offered = Boxes(xyxy, np.ones(n, np.float32), "cup")
    cosine = rng.uniform(0, 1, (n, k)).astype(np.float32)
    kept = shortlist(offered, cosine, MOST_CANDIDATES)
    whole, few = vote(cosine), vote(cosine[kept])
    assert kept[few.winner] == whole.winner
    assert few.votes.tolist() == whole.votes[kept].tolist()
    assert (few.margin, whole.votes.sum()) == (whole.margin, few.votes.sum())
    for rule in RULES:
        assert kept[vote(cosine[kept], rule).winner] == vote(cosine, rule).winner
    assert len(kept) <= max(MOST_CANDIDATES, 1 + len(np.unique(cosine.argmax(axis=0))))
    others = [i for i in kept if not whole.votes[i] and i != cosine.mean(axis=1).argmax()]
    cover = box_cover(xyxy[others], xyxy[kept])
    assert n <= MOST_CANDIDATES or ((cover > 0.5).sum(axis=1) == 1).all()


def test_boxes_of_one_category_are_all_candidates() -> None:
    def nested(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        return [boxes(CUP_BOX, (4, 20, 16, 31))] * len(images)

    attender = Attender(replace(TOYS, detector=nested), {"mug": MUG})
    _, attended = attender.start({"front": DESK}, "bring my cup")
    assert len(attended.groundings["front"][0].candidates) == 2


UNLIKE = scene([(4, 20, SAND)])


@pytest.mark.parametrize(("nested", "apart", "kept"), [(0, 9, 4), (3, 6, 6), (9, 2, 8), (3, 0, 3)])
def test_a_familiar_view_keeps_boxes_until_there_are_candidates_in_four_places(
    nested: int, apart: int, kept: int
) -> None:
    """Of some boxes, each within the one before, and then some others."""
    inside = [(0, 40, 512 / 2**i, 48) for i in range(nested)]
    found = boxes(*inside, *((x, 0, x + 5, 8) for x in range(0, 6 * apart, 6)))

    class Given:
        def __call__(self, rgb: Rgb, *limits: float) -> tuple[np.ndarray, np.ndarray]:
            return found.xyxy, np.linspace(0.9, 0.5, len(found)).astype(np.float32)

    (seen,) = OpenDetector(Given(), lambda *_: [boxes(CUP_BOX)])([DESK], "cup")
    assert len(seen) == kept
    assert (seen.xyxy == found.xyxy[:kept]).all()


STRICT = replace(TOYS, thresholds=Thresholds(familiar=0.99, unfamiliar=0.98))


def test_what_is_unlike_the_references_is_not_tinted_and_not_named() -> None:
    _, attended = Attender(STRICT, {"mug": MUG}).start({"front": UNLIKE}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    assert (grounding.winner, grounding.rejected, grounding.threshold) == (None, 0, 0.99)
    assert (grounding.ballot.winner, grounding.overruled) == (0, False)
    assert attended.images["front"] is UNLIKE
    assert attended.text == "bring my cup"
    likeness = float(grounding.likeness[0])
    assert f"mug not in view, cosine {likeness:.2f} below 0.99" in attended.events[0].text
    assert attended.events[0].level == "WARN"


def test_an_object_is_in_no_view_unless_one_is_as_like_it_as_its_photos_are_alike() -> None:
    """The mug's photos are one colour: a look-alike (cosine .70) is like enough for any single view."""
    cameras = ("front", "side")
    rust = (200, 110, 60)
    shown = {"front": scene([(4, 20, rust)]), "side": scene([(24, 20, rust)])}

    def winners(together: float | None, views: dict[str, Rgb], **how: object) -> list[int | None]:
        stack = replace(TOYS, thresholds=Thresholds(0.5, 0.5, together))
        _, attended = Attender(stack, {"mug": MUG}, Prompting(**how)).start(views, "bring my cup")
        of = [attended.groundings[camera][0] for camera in cameras]
        assert [g.rejected is None for g in of] == [g.winner is not None for g in of]
        assert all(g.rejected is None or g.likeness[g.rejected] < g.threshold for g in of)
        return [g.winner for g in of]

    assert winners(None, shown) == [0, 0]
    assert winners(0.28, shown) == [None, None]
    assert winners(0.28, shown, always_tint=True) == [0, 0]
    assert winners(0.28, shown, references=1) == [0, 0]  # one photo is alike to none
    assert winners(0.28, {**shown, "side": scene([(4, 20, TEAL)])}) == [0, 0]  # seen in one view


@pytest.mark.parametrize(
    ("seen", "others", "is_there"),
    [
        ((150, 100, 60), (), True),  # likeness .77
        ((200, 110, 60), (), False),  # .70
        ((200, 110, 60), ((200, 60, 20),), True),  # what has two sides is less alike from each
    ],
)
def test_references_that_agree_ask_for_more_but_not_for_their_own_agreement(
    seen: tuple[int, int, int], others: tuple[tuple[int, int, int], ...], is_there: bool
) -> None:
    """Equal photos of a pen holder once asked for .87 of every view, which renders do not reach."""
    teal = (40, 120, 110)
    memory = {"mug": personal("mug", "cup", teal, *(others or [teal]))}
    stack = replace(TOYS, thresholds=Thresholds(0.5, 0.54, together=0.165))
    _, attended = Attender(stack, memory).start({"front": scene([(4, 20, seen)])}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    assert (grounding.winner is not None) == is_there
    assert grounding.threshold == (0.5 if is_there else MOST_ASKED)


def test_recordings_and_signals_say_not_in_view() -> None:
    from vap_core.base.pictures import result_line

    _, attended = Attender(STRICT, {"mug": MUG}).start({"front": UNLIKE}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    assert result_line(grounding).startswith("#0 not in view, cosine ")


def test_always_tint_is_the_papers_rule_and_so_is_a_stack_without_thresholds() -> None:
    expected = tint(UNLIKE, UNLIKE.any(axis=2), PALETTE[0])
    for stack, prompting in ((STRICT, Prompting(always_tint=True)), (TOYS, Prompting())):
        _, attended = Attender(stack, {"mug": MUG}, prompting).start(
            {"front": UNLIKE}, "bring my cup"
        )
        assert (attended.images["front"] == expected).all()
        assert attended.text == "bring the red cup"
        assert attended.groundings["front"][0].threshold is None


def test_what_is_in_view_is_tinted_as_ever() -> None:
    _, attended = Attender(STRICT, {"mug": MUG}).start(
        {"front": DESK, "side": UNLIKE}, "bring my cup"
    )
    front, side = (attended.groundings[camera][0] for camera in ("front", "side"))
    assert (front.rejected, side.rejected) == (None, 0)
    assert attended.images["side"] is UNLIKE
    assert attended.text == "bring the red cup"


def test_association_does_not_tint_what_is_unlike() -> None:
    prompting = Prompting(associate=True)
    cameras = {"front": overhead("front", 0.0), "side": overhead("side", 0.25)}
    _, attended = Attender(STRICT, {"mug": MUG}, prompting).start(
        {"front": UNLIKE, "side": UNLIKE}, "bring my cup", cameras=cameras
    )
    assert [of[0].winner for of in attended.groundings.values()] == [None, None]
    assert attended.text == "bring my cup"


def test_unfamiliar_views_have_their_own_encoder_and_threshold() -> None:
    """Its rows of the references come from the crops that the memory keeps."""
    asked: list[int] = []

    class Other(MeanColour):
        name = "other"

        def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
            asked.append(len(crops))
            return super().__call__(crops)[:, ::-1].copy()

    stack = replace(
        OPEN, unfamiliar_encoder=Other(), thresholds=Thresholds(familiar=0.5, unfamiliar=0.6)
    )
    mug = personal("mug", "cup", TEAL, TEAL, SAND)
    _, attended = Attender(stack, {"mug": mug}).start({"front": DESK}, "bring my cup")
    (grounding,) = attended.groundings["front"]
    assert (asked, grounding.threshold) == ([], 0.5)
    assert np.allclose(grounding.likeness, grounding.similarity.mean(axis=1))
    memory = {"mug": replace(mug, category="thing")}
    for _ in range(2):
        _, attended = Attender(stack, memory).start({"front": DESK}, "bring my thing")
    (grounding,) = attended.groundings["front"]
    assert sorted(asked) == [3, 4, 4]  # the references once, the view's proposals each time
    assert grounding.threshold == 0.6
    assert np.allclose(grounding.likeness, grounding.similarity.max(axis=1))


def test_cameras_of_one_robot_see_one_world() -> None:
    def knows_the_front(images: Sequence[Rgb], phrase: str, threshold: float) -> list[Boxes]:
        return [boxes(CUP_BOX) if images[0] is DESK else boxes()]

    stack = replace(OPEN, detector=OpenDetector(AllSquares(), knows_the_front))
    _, attended = Attender(stack, {"mug": MUG}).start(
        {"front": DESK, "side": DESK.copy()}, "bring my cup"
    )
    assert all(of[0].candidates.familiar for of in attended.groundings.values())


def test_boxes_by_hand_are_judged_too() -> None:
    memory = {"mug": replace(MUG, category="thing")}
    for obj, phrase in (({"mug": MUG}, "cup"), (memory, "thing")):
        _, attended = Attender(OPEN, obj).start(
            {"front": DESK}, f"bring my {phrase}", boxes={"front": boxes(CUP_BOX, BOWL_BOX)}
        )
        assert attended.groundings["front"][0].candidates.familiar == (phrase == "cup")


class Coarse:
    """Sees nothing under a tenth of its picture's width, and what its picture cuts as it is cut."""

    def __call__(self, rgb: Rgb, *limits: float) -> tuple[np.ndarray, np.ndarray]:
        (found,) = detector([rgb], "thing")
        large = found.xyxy[:, 2] - found.xyxy[:, 0] >= rgb.shape[1] / 10
        return found.xyxy[large], found.score[large]


@pytest.mark.parametrize(("size", "phrase", "n"), [(1000, "x", 2), (990, "x", 0), (1000, "cup", 0)])
def test_an_unfamiliar_picture_of_a_megapixel_is_looked_at_in_tiles(
    size: int, phrase: str, n: int
) -> None:
    """What several tiles show, whole or cut, is one box."""
    rgb = scene([(350, 150, TEAL), (470, 560, SAND)], size=size, side=70)
    (found,) = OpenDetector(Coarse(), knows_cups)([rgb], phrase)
    assert sorted(found.xyxy.tolist()) == [[350, 150, 420, 220], [470, 560, 540, 630]][:n]
    covered = np.zeros((61, 100), int)
    for x, y in tiles_of(rgb[:61, :100]):
        covered[y : y + 31, x : x + 50] += 1
    assert (covered.min(), covered[0, 0], covered[20, 40]) == (1, 1, 4)


# --- Registering ------------------------------------------------------------------------------------------------------


def test_a_reference_is_the_most_likely_box_that_holds_the_photos_centre() -> None:
    photo = scene([(26, 26, TEAL), (2, 2, SAND)])

    class Some:
        def __call__(self, rgb: Rgb, *limits: float) -> tuple[np.ndarray, np.ndarray]:
            xyxy = np.array([(2, 2, 14, 14), (20, 20, 60, 60), (26, 26, 38, 38)], np.float32)
            return xyxy, np.array([0.9, 0.5, 0.6], np.float32)

    detector = OpenDetector(Some(), lambda *a: [boxes()])
    box = reference_box(photo, "ornament", detector)
    assert box is not None
    assert box.tolist() == [26, 26, 38, 38]
    assert reference_box(np.zeros((200, 200, 3), np.uint8), "ornament", detector) is None
    mine, whole = register("it", "ornament", [photo], detector, MeanColour())
    assert mine.crops[0].shape == (14, 14, 3)
    assert whole == ()


def test_where_the_phrase_head_knows_a_reference_its_own_box_is_taken() -> None:
    def named(box: tuple[int, ...], score: float) -> object:
        detector = OpenDetector(AllSquares(), lambda *a: [boxes(box, score=score)])
        return reference_box(DESK[:, 18:42].copy(), "cup", detector)

    holding = (4, 20, 36, 32)  # of the four proposals the only one with the centre, (12, 32)
    assert named((4, 19, 36, 32), 0.5).tolist() == [4, 19, 36, 32]  # type: ignore[attr-defined]
    assert tuple(named((4, 19, 36, 32), 0.3)) == holding  # type: ignore[call-overload]
    assert tuple(named((40, 0, 50, 10), 0.5)) == holding  # type: ignore[call-overload]


def test_a_memory_keeps_its_format_and_its_rows(tmp_path: Path) -> None:
    """Rows of unfamiliar views are not stored: an old memory serves as it is."""
    path = save(tmp_path, MUG)
    assert load(path, MeanColour.name).embeddings.tolist() == MUG.embeddings.tolist()


# --- The shipped parts ------------------------------------------------------------------------------------------------


def test_decode_reads_expectations_of_edges() -> None:
    """One cell of stride 8 in row 2, column 5, whose edges lie 1, 2, 3 and 4 strides away."""
    n_cells = sum((PROPOSER_SIDE // stride) ** 2 for stride in proposer.STRIDES)
    scores = np.zeros((n_cells, 80), np.float32)
    edges = np.zeros((n_cells, 4 * BINS), np.float32)
    cell = 2 * (PROPOSER_SIDE // 8) + 5
    scores[cell, 7] = 0.8
    for side, strides in enumerate((1, 2, 3, 4)):
        edges[cell, side * BINS + strides] = 50.0
    xyxy, score = decode_proposals(scores, edges)
    assert len(score) == proposer.CELLS
    assert score[0] == np.float32(0.8)
    assert np.allclose(xyxy[0], [44 - 8, 20 - 16, 44 + 24, 20 + 32], atol=1e-3)


def test_proposals_scale_with_the_picture() -> None:
    """Boxes are in the picture's pixels whatever its aspect, inside it, and none fills it."""

    def network(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert pixels.shape == (1, 3, PROPOSER_SIDE, PROPOSER_SIDE)
        n_cells = sum((PROPOSER_SIDE // stride) ** 2 for stride in proposer.STRIDES)
        scores = np.zeros((1, n_cells, 80), np.float32)
        edges = np.full((1, n_cells, 4 * BINS), -50.0, np.float32)
        edges[..., BINS - 1 :: BINS] = 50.0
        scores[0, 0, 0] = 0.9  # the corner's cell: clipped to 84 x 84 of 416
        scores[0, 52 * 52 - 1, 0] = 0.8  # the last cell of stride 8, in the far corner: 84 x 84
        return scores, edges

    xyxy, score = Proposer(network)(np.zeros((100, 200, 3), np.uint8))
    assert np.allclose(score, [0.9, 0.8])
    assert np.allclose(
        xyxy[0], np.array([0, 0, 84, 84]) / PROPOSER_SIDE * [200, 100, 200, 100], atol=1e-3
    )
    assert (xyxy[1][2:] == [200, 100]).all()


def test_the_shipped_detector_proposes_every_object_of_a_rendered_table() -> None:
    from vap_core.perception.boxes import box_iou
    from vap_make.films.scenes import boxes_of, stage

    shots = stage(3, 2, held_out=True, views=1)
    true = np.array([box for _, box in boxes_of(shots.ids[0], len(shots.names), 300)], np.float32)
    detector: Detector = proposer.load_open()
    (found,) = detector([shots.rgb[0]], "cup")
    assert len(found) <= proposer.MOST_UNFAMILIAR
    overlap = box_iou(true, found.xyxy).max(axis=1)
    assert (overlap >= 0.5).mean() >= 0.8, overlap


def test_the_proposer_ships_with_its_licence_and_source() -> None:
    entry = json.loads((FOLDER / MANIFEST).read_text())[proposer.PROPOSER_GRAPH]
    assert "Apache-2.0" in entry["licence"]
    assert "RangiLyu" in (FOLDER / "nanodet-coco.md").read_text()
    assert "Apache License" in (FOLDER / "nanodet-coco.LICENSE").read_text()


def test_contrast_is_stretched_by_one_line_for_all_channels() -> None:
    dim = np.zeros((10, 10, 3), np.uint8)
    dim[:, :5] = 60
    dim[:, 5:] = (140, 130, 120)
    bright = stretch_contrast(dim)
    assert bright[0, 0].tolist() == [15, 15, 15]
    scale = 220 / 70
    expected = [(level - 60) * scale + 15 for level in (140, 130, 120)]
    assert bright[0, 9].tolist() == [min(255, int(level)) for level in expected]
    flat = np.full((10, 10, 3), 100, np.uint8)
    flat[0, 0] = 104
    assert stretch_contrast(flat)[5, 5].tolist() == [15, 15, 15]
    assert stretch_contrast(flat).max() <= 15 + 4 * 220 / 40 + 1


def test_stretched_contrast_is_to_the_bit_what_its_definition_says():
    rng = np.random.default_rng(0)
    for _ in range(200):
        h, w = rng.integers(1, 40, 2)
        middle, spread = rng.uniform(0, 255), rng.uniform(0, 60)
        rgb = np.clip(rng.normal(middle, spread, (h, w, 3)), 0, 255).astype(np.uint8)
        dark, bright = np.percentile(rgb.mean(axis=2), [3.0, 97.0])
        wanted = (rgb.astype(np.float64) - dark) * (220 / max(bright - dark, 40)) + 15
        assert (stretch_contrast(rgb) == np.clip(wanted, 0, 255).astype(np.uint8)).all()


@pytest.mark.parametrize("familiar", [True, False])
def test_the_shipped_encoders_share_a_network_and_differ_in_name(familiar: bool) -> None:
    from vap_core.perception.embedded import encoder

    one, other = encoder.load(), encoder.load_unfamiliar()
    assert one.network is other.network
    assert one.name != other.name
    rgb = np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8)
    chosen = one if familiar else other
    assert np.allclose(np.linalg.norm(chosen([rgb]), axis=1), 1, atol=1e-4)
