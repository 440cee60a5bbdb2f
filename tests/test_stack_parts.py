"""A stack with parts of one's own, and a mixed one: what goes with the parts that are replaced."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.toys import MeanColour, SameColour, segmenter
from vap_core.attend import Attender, Prompting
from vap_core.base.files import DATA
from vap_core.base.media import load_photo, photos_in
from vap_core.base.types import Boxes, Rgb
from vap_core.memory import remember
from vap_core.perception import foundation
from vap_core.perception.embedded import segmenter as embedded_segmenter
from vap_core.perception.protocols import FamiliarityJudge, JudgedDetector, ReferenceCropper, Stack
from vap_core.perception.stacks import load_mixed, load_stack

PHOTOS = DATA / "photo-set"
ENCODER = MeanColour()
TRACKER = SameColour()
LOADED: dict[str, dict[str, Any]] = {
    "detector": {"by_category": None},
    "encoder": {"encoder": ENCODER, "unfamiliar_encoder": None},
    "tracker": {"segmenter": segmenter, "tracker": TRACKER},
}
"""What a foundation model fills of a stack, by role; the detector is `left_half`."""
OF_ROLE = {
    "detector": "grounding-dino-tiny",
    "encoder": "dinov2-small",
    "tracker": "sam2.1-hiera-tiny",
}


def left_half(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
    """One box of every picture, as a detector finds it that knows nothing of familiar views."""
    found = []
    for image in images:
        h, w = image.shape[:2]
        xyxy = np.array([[0, 0, w // 2, h]], np.float32)
        found.append(Boxes(xyxy, np.ones(1, np.float32), phrase))
    return found


LOADED["detector"]["detector"] = left_half


@pytest.fixture(scope="module")
def embedded() -> Stack:
    return load_stack("embedded")


@pytest.fixture(scope="module")
def photo() -> Rgb:
    return load_photo(PHOTOS / "scenes" / "box_in_scene.png", long_side=None)


def mixture(roles: Sequence[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Stack:
    """The mixed stack of these roles, as if their weights were there."""
    loaded: dict[str, Any] = {}
    for role in roles:
        loaded |= LOADED[role]
    monkeypatch.setattr(foundation, "load_parts", lambda name, device: loaded)
    monkeypatch.setenv("VAP_WEIGHTS", str(tmp_path))
    changes = ",".join(f"{role}={OF_ROLE[role]}" for role in roles)
    return load_mixed(f"embedded:{changes}")


def test_the_embedded_judge_says_of_anothers_boxes_whether_a_view_is_familiar(
    embedded: Stack, photo: Rgb
) -> None:
    stack = embedded.with_parts("mine", detector=left_half)
    judge = embedded.detector
    assert isinstance(judge, FamiliarityJudge)
    assert isinstance(stack.detector, FamiliarityJudge)
    rendered = np.full((224, 224, 3), 90, np.uint8)
    found = stack.detector([photo, rendered], "cookies")
    for image, boxes in zip((photo, rendered), found, strict=True):
        assert boxes.familiar == judge.is_familiar(image, "cookies")
        assert np.array_equal(boxes.xyxy, left_half([image], "cookies")[0].xyxy)
    assert not found[0].familiar


@pytest.mark.parametrize("way", ["with_parts", "mixed"])
def test_a_photo_has_its_encoder_and_grabcut_with_another_detector(
    way: str,
    embedded: Stack,
    photo: Rgb,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Any,
) -> None:
    """They are chosen by `Boxes.familiar`, which is true where nobody says otherwise."""
    if way == "mixed":
        stack = mixture(["detector"], monkeypatch, tmp_path)
    else:
        stack = embedded.with_parts("mine", detector=left_half)
    refined = []

    def refine(image: Rgb, box: np.ndarray, probability: np.ndarray) -> None:
        refined.append(box)

    monkeypatch.setattr(embedded_segmenter, "refine", refine)
    crops = [load_photo(path) for path in photos_in(PHOTOS / "references" / "cookies")]
    memory = {"cookies": remember("cookies", "cookies", crops, stack.encoder)}
    _, attended = Attender(stack, memory, Prompting()).start({"front": photo}, "bring my cookies")
    (grounding,) = attended.groundings["front"]
    assert not grounding.candidates.familiar
    assert stack.encoder_of(grounding.candidates) is embedded.unfamiliar_encoder
    assert len(refined) == len(grounding.candidates) == 1


@pytest.mark.parametrize(
    "roles",
    [
        ["detector"],
        ["encoder"],
        ["tracker"],
        ["detector", "encoder"],
        ["detector", "tracker"],
        ["encoder", "tracker"],
    ],
)
def test_a_mixed_stack_keeps_what_with_parts_keeps(
    roles: list[str], embedded: Stack, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """Nothing that was measured for a part that another replaces, the verifier above all."""
    mixed = mixture(roles, monkeypatch, tmp_path)
    parts = {
        field: part for role in roles for field, part in LOADED[role].items() if part is not None
    }
    own = embedded.with_parts("mine", **parts)
    for field in ("encoder", "segmenter", "tracker", "unfamiliar_encoder", "thresholds"):
        assert getattr(mixed, field) is getattr(own, field), field
    assert mixed.verifier is own.verifier
    assert (mixed.verifier is None) == ("detector" in roles or "encoder" in roles)
    assert type(mixed.detector) is type(own.detector)
    assert isinstance(mixed.detector, JudgedDetector) == ("detector" in roles)


def test_where_nothing_depends_on_it_nothing_is_judged(embedded: Stack) -> None:
    own = embedded.with_parts("mine", detector=left_half, encoder=ENCODER, segmenter=segmenter)
    assert own.detector is left_half
    again = embedded.with_parts("mine", detector=embedded.detector)
    assert again.detector is embedded.detector


def test_a_detector_that_crops_references_still_does(embedded: Stack, photo: Rgb) -> None:
    class Cropper:
        def __call__(
            self, images: Sequence[Rgb], phrase: str, threshold: float | None = None
        ) -> list[Boxes]:
            return left_half(images, phrase, threshold)

        def reference_boxes(
            self, photo: Rgb, phrase: str, threshold: float
        ) -> tuple[Boxes, np.ndarray]:
            return left_half([photo], f"reference {phrase}")[0], np.ones(1, np.float32)

    detector = embedded.with_parts("mine", detector=Cropper()).detector
    assert isinstance(detector, ReferenceCropper)
    assert detector.reference_boxes(photo, "cup", 0.1)[0].phrase == "reference cup"
    plain = embedded.with_parts("mine", detector=left_half).detector
    assert not isinstance(plain, ReferenceCropper)
