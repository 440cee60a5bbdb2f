"""What a prompter does wrong is the error of its episode; the others go on."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.toys import TOYS, MeanColour, personal, unchecked
from vap_core.attend import Attender
from vap_core.base.errors import BadCrop, BadEncoder, BadPart
from vap_core.base.types import Attended, Boxes, Rgb, Track
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import PromptContext, TintPrompter, checked_steps, unchanged
from vap_core.simulation.types import Observation
from vap_core.study.trials import Study, make_trial

STUDY = Study((("simpler-bridge", "pick-shaver"),), ("generic",), policy="random", episodes=3)
ROWS = tuple(replace(row, max_steps=3) for row in STUDY.rows("simpler-bridge", "pick-shaver"))
Result = tuple[int, Attended]
Change = Callable[[list[Result], int], object]


class Faulty:
    """Leaves everything as it is, then does something wrong with the second episode's result."""

    needs_truth = "never"
    highlights = False
    references: Mapping[str, tuple[Rgb, ...]] = {}

    def __init__(self, change: Change) -> None:
        self.change = change
        self.begun = 0

    def start(self, observation: Observation, context: PromptContext) -> Result:
        self.begun += 1
        return self.begun, unchanged(observation.images, context.instruction)

    def steps(
        self,
        states: Sequence[int],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> object:
        results = []
        for state, observation, context in zip(states, observations, contexts, strict=True):
            results.append((state, unchanged(observation.images, context.instruction)))
        return self.change(results, states.index(2)) if 2 in states else results


def shown_as(change: Callable[[Rgb], Rgb], **fields: object) -> Change:
    """Its pictures are changed, under the same name."""

    def changed(results: list[Result], i: int) -> list[Result]:
        state, attended = results[i]
        images = {name: change(image) for name, image in attended.images.items()}
        made = unchecked(attended, images=images, **fields)
        return [*results[:i], (state, made), *results[i + 1 :]]

    return changed


class Fails(MeanColour):
    """Gives numbers that are not finite from one call to another."""

    def __init__(self, first: int, last: int) -> None:
        self.calls = range(first, last + 1)
        self.count = 0

    def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
        self.count += 1
        rows = super().__call__(crops)
        return rows * np.float32(np.nan) if self.count in self.calls else rows


def middle(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
    xyxy = np.array([[60, 60, 120, 120]], np.float32)
    return [Boxes(xyxy, np.ones(1, np.float32), phrase) for _ in images]


class Second:
    """A part whose second answer is another's."""

    def __init__(self, good: Callable[..., object], wrong: Callable[..., object]) -> None:
        self.parts = iter((good, wrong, good))

    def __call__(self, *given: object) -> object:
        return next(self.parts)(*given)


def squares(image: Rgb, boxes: Boxes) -> np.ndarray:
    masks = np.zeros((len(boxes), *image.shape[:2]), bool)
    masks[:, 60:120, 60:120] = True
    return masks


def with_encoder(trial: Trial, encoder: Fails) -> Trial:
    """The trial by the method, with one box in every view."""
    stack = TOYS.with_parts("mine", detector=middle, encoder=encoder)
    mug = personal("mug", "shaver", (200, 30, 30))
    return replace(trial, prompter=TintPrompter(Attender(stack, {"mug": mug})))


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    made = make_trial(STUDY, ROWS, "generic", tmp_path_factory.mktemp("bank"))
    return replace(made, images_every=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda all_, i: all_[:i] + all_[i + 1 :], "0 results for 1 episode; return a list"),
        (lambda all_, i: [*all_, all_[i]], "2 results for 1 episode; return a list"),
        (lambda all_, i: None, "NoneType results for 1 episode; return a list"),
        (lambda all_, i: [*all_[:i], 7, *all_[i + 1 :]], "int as a result; return the state and"),
        (
            lambda all_, i: [*all_[:i], (2, None), *all_[i + 1 :]],
            "tuple as a result; return the state and an Attended",
        ),
        (
            shown_as(lambda image: image[::2]),
            r"pictures {'front': 'ndarray uint8 \(112, 224, 3\)'}; ret",
        ),
        (
            shown_as(np.ma.masked_array),
            r"pictures {'front': 'MaskedArray uint8 \(224, 224, 3\)'}; r",
        ),
        (
            shown_as(np.copy, text=None),
            "tuple as a result; return the state and an Attended with a",
        ),
        (shown_as(np.float32), r"pictures {'front': 'ndarray float32 \(224, 224, 3\)'}; return"),
    ],
)
def test_a_fault_is_the_error_of_its_episode(trial: Trial, change: Change, message: str) -> None:
    faulty = replace(trial, prompter=Faulty(change))
    one, bad, other = rollout(faulty, ROWS, batch=3)
    statuses = [each.outcome.status for each in (one, bad, other)]
    assert statuses == ["failure", "error", "failure"]
    assert [each.outcome.steps for each in (one, bad, other)] == [3, 1, 3]
    last = bad.outcome.detail.strip().splitlines()[-1]
    assert re.search(f"^ValueError: prompter Faulty: steps returned {message}", last)


def test_a_prompter_that_errs_in_batches_alone_is_asked_one_by_one(trial: Trial) -> None:
    faulty = Faulty(lambda results, i: results if len(results) == 1 else [])
    episodes = rollout(replace(trial, prompter=faulty), ROWS, batch=3)
    assert [episode.outcome.status for episode in episodes] == ["failure"] * 3


def paint(results: list[Result], i: int) -> list[Result]:
    for image in results[i][1].images.values():
        image[:] = 0
    return results


def test_a_prompter_cannot_write_into_what_it_is_given(trial: Trial) -> None:
    """The recording shows what the cameras saw. It may paint copies."""
    one, bad, other = rollout(replace(trial, prompter=Faulty(paint)), ROWS, batch=3)
    statuses = [each.outcome.status for each in (one, bad, other)]
    assert statuses == ["failure", "error", "failure"]
    assert "read-only" in bad.outcome.detail.strip().splitlines()[-1]
    good = replace(trial, prompter=Faulty(shown_as(np.zeros_like)))
    _, episode, _ = rollout(good, ROWS, batch=3, keep_images=True)
    assert episode.outcome.status == "failure"
    last = episode.frames[-1]
    assert all(image.any() for image in last.images.values())
    assert not any(image.any() for image in last.prompted.values())


def test_the_number_of_episodes_is_in_the_message() -> None:
    line = "prompter Faulty: steps returned 0 results for 2 episodes; return a list, one for each"
    seen = Observation({}, np.zeros(7, np.float32))
    with pytest.raises(ValueError, match=line):
        checked_steps([], Faulty(lambda results, i: results), [seen, seen])


def test_a_crop_that_cannot_be_embedded_is_the_error_of_its_episode(trial: Trial) -> None:
    """The encoder still embeds the references; in a batch or alone."""
    for batch in (1, 3):
        one, bad, other = rollout(with_encoder(trial, Fails(2, 2)), ROWS, batch=batch)
        statuses = [each.outcome.status for each in (one, bad, other)]
        assert statuses == ["failure", "error", "failure"]
        assert "gave numbers that are not finite; test it with pytest" in bad.outcome.detail


def ends(*_: object) -> object:
    raise GeneratorExit


def far(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
    return [Boxes(boxes.xyxy + 900, boxes.score, phrase) for boxes in middle(images, phrase)]


def boxed(xyxy: Sequence[float], score: float) -> Callable[..., object]:
    """A detector of one box of every picture."""

    def detector(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> object:
        corners, scores = np.array([xyxy], np.float32), np.array([score], np.float32)
        return [Boxes(corners, scores, phrase) for _ in images]

    return detector


@pytest.mark.parametrize(
    ("role", "wrong", "cause"),
    [
        (
            "detector",
            lambda *_: None,
            "BadPart: detect: detector 'Second' gave None, not Boxes insid",
        ),
        ("detector", lambda *_: [], "'Second' gave \\[\\], not Boxes inside each of 1 views; test"),
        ("detector", lambda *_: "boxes", "'Second' gave 'boxes', not Boxes .* --detector MOD"),
        ("detector", far, r"'Second' gave \[Boxes\(xyxy=array\(\[\[ 960., "),
        ("detector", boxed((9, 9, np.inf, 20), 1), "far corner must exceed near corner"),
        ("detector", boxed((9, 9, 20, 20), np.nan), r"scores are in \[0, 1\], got \[nan\]"),
        ("detector", boxed((9, 9, 20, 20), 5), r"scores are in \[0, 1\], got \[5.0\]"),
        ("detector", ends, "GeneratorExit"),
        (
            "segmenter",
            lambda *_: None,
            "'Second' gave NoneType, not ndarray bool .1, 448, 448.; t",
        ),
        (
            "segmenter",
            lambda image, boxes: squares(image, boxes)[:0],
            r"gave ndarray bool \(0, 448, 448\), not ndarray bool \(1, 448, 448\); test",
        ),
        (
            "segmenter",
            lambda image, boxes: squares(image, boxes).astype(np.uint8),
            r"gave ndarray uint8 \(1, 448, 448\), not ndarray bool",
        ),
        (
            "segmenter",
            lambda image, boxes: np.ma.masked_array(squares(image, boxes), mask=True),
            "segmenter 'Second' gave MaskedArray bool .* --segmenter MODULE:NAME",
        ),
        ("segmenter", ends, "GeneratorExit"),
    ],
)
def test_what_a_part_gives_against_its_protocol_is_the_error_of_its_episode(
    trial: Trial, role: str, wrong: Callable[..., object], cause: str
) -> None:
    """The last line of its detail names the part."""
    parts: dict[str, Any] = {"detector": middle, "segmenter": squares}
    parts[role] = Second(parts[role], wrong)
    stack = TOYS.with_parts("mine", **parts)
    mug = personal("mug", "shaver", (200, 30, 30))
    tinted = replace(trial, prompter=TintPrompter(Attender(stack, {"mug": mug})))
    rows = [replace(row, max_steps=0) for row in ROWS]
    one, bad, other = rollout(tinted, rows, batch=3)
    statuses = [each.outcome.status for each in (one, bad, other)]
    assert statuses == ["failure", "error", "failure"]
    assert re.search(cause, bad.outcome.detail.strip().splitlines()[-1])


class WrongMasks:
    """Follows as `TOYS` does, and its second step gives masks that are changed."""

    def __init__(self, change: Callable[[np.ndarray], object]) -> None:
        self.start = TOYS.tracker.start
        self.change = change
        self.calls = 0

    def step(self, states: Sequence[Any], images: Sequence[Rgb]) -> object:
        self.calls += 1
        after, tracks = TOYS.tracker.step(states, images)
        if self.calls == 2:
            wrong = self.change(np.ones(images[0].shape[:2], bool))
            tracks = [tuple(unchecked(track, mask=wrong) for track in view) for view in tracks]
        return after, tracks


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (np.uint8, "ndarray uint8 (24, 32)"),
        (np.transpose, "ndarray bool (32, 24)"),
        (np.ndarray.tolist, "list"),
    ],
)
def test_a_mask_that_a_tracker_gives_against_its_protocol_is_refused_with_its_name(
    change: Callable[[np.ndarray], object], found: str
) -> None:
    rgb = np.full((24, 32, 3), (200, 30, 30), np.uint8)
    box = Boxes(np.array([[4, 4, 16, 16]], np.float32), np.ones(1, np.float32), "cup")
    stack = TOYS.with_parts("mine", tracker=WrongMasks(change))
    attender = Attender(stack, {"mug": personal("mug", "cup", (200, 30, 30))})
    state, _ = attender.start({"front": rgb}, "bring my cup", boxes={"front": box})
    state, _ = attender.step(state, {"front": rgb})
    line = f"step: tracker 'WrongMasks' gave {found} as a mask, not ndarray bool (24, 32); test it"
    with pytest.raises(BadPart, match=re.escape(line)):
        attender.step(state, {"front": rgb})


@pytest.mark.parametrize("score", [np.nan, 7.0, -0.1])
def test_a_track_has_a_score_from_0_to_1_and_its_mask_counts(score: float) -> None:
    with pytest.raises(ValueError, match="outside"):
        Track(None, float(score))
    with pytest.raises(ValueError, match="masked array"):
        Track(np.ma.masked_array(np.ones((2, 2), bool), mask=True), 1.0)


def test_an_encoder_that_fails_for_everything_ends_the_run_in_one_line(trial: Trial) -> None:
    with pytest.raises(BadEncoder, match="gave numbers that are not finite; test") as caught:
        list(rollout(with_encoder(trial, Fails(1, 99)), ROWS, batch=1))
    assert not isinstance(caught.value, BadCrop)
    assert "\n" not in str(caught.value)
