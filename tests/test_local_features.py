"""Points of crops and references: what counts as verified, and what the method makes of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.toys import TOYS, MeanColour, personal, scene
from vap_core.attend import Attender
from vap_core.base.events import describe_rejection
from vap_core.base.types import Boxes
from vap_core.memory import remember
from vap_core.perception.candidates import CERTAIN, GAIN, OF_USUAL, proof, usual_points
from vap_core.perception.embedded import encoder
from vap_core.perception.embedded.encoder import count_verified, find_points, is_view
from vap_core.perception.protocols import Thresholds, Verifier

RED, BLUE = (150, 40, 40), (40, 40, 150)


def print_of(seed: int, size: int = 160) -> np.ndarray:
    """A label of random discs and bars in many colours."""
    rng = np.random.default_rng(seed)
    rgb = np.full((size, size, 3), 230, np.uint8)
    for _ in range(40):
        x, y, r = rng.integers(size, size=3)
        colour = tuple(int(v) for v in rng.integers(256, size=3))
        cv2.circle(rgb, (int(x), int(y)), 3 + int(r) % 12, colour, -1)
        cv2.rectangle(rgb, (int(y), int(r)), (int(y) + 9, int(r) + 5), colour, -1)
    return rgb


def turned(rgb: np.ndarray, angle: float = 15, scale: float = 0.8) -> np.ndarray:
    """The label seen turned and from farther away, in less light."""
    h, w = rgb.shape[:2]
    affine = cv2.getRotationMatrix2D((w / 2, h / 2), angle, scale)
    moved = cv2.warpAffine(rgb, affine, (w, h), borderValue=(90, 90, 90))
    return (moved * 0.8).astype(np.uint8)


def test_the_same_print_is_verified_and_another_is_not():
    label = find_points(print_of(0))
    assert count_verified(label, find_points(turned(print_of(0)))) >= 3 * CERTAIN
    assert count_verified(label, find_points(turned(print_of(1)))) < CERTAIN


def test_the_same_print_in_other_colours_counts_less():
    label, same = find_points(print_of(0)), find_points(turned(print_of(0)))
    swapped = find_points(turned(print_of(0)[..., [1, 2, 0]]))
    assert count_verified(label, swapped) < count_verified(label, same) / 2


def test_without_texture_nothing_is_verified():
    plain = np.full((80, 80, 3), RED, np.uint8)
    assert count_verified(find_points(plain), find_points(plain)) == 0
    assert len(find_points(np.zeros((1, 3, 3), np.uint8))) == 0


@pytest.mark.parametrize(
    ("linear", "possible"),
    [
        (((1, 0), (0, 1)), True),
        (((0, -2), (2, 0)), True),
        (((-1, 0), (0, 1)), False),
        (((1, 0), (0, 0.2)), False),
        (((0.01, 0), (0, 0.01)), False),
        (((0, 0), (0, 0)), False),
    ],
)
def test_which_maps_a_view_may_have(linear, possible):
    assert is_view(np.array(linear, np.float64)) == possible


def test_the_verifier_keeps_its_protocol_and_the_latest_points(monkeypatch):
    monkeypatch.setattr(encoder, "MOST_KEPT", 2)
    verify = encoder.PointVerifier()
    assert isinstance(verify, Verifier)
    crops = [print_of(0), turned(print_of(0)), print_of(1)]
    counts = verify(crops, crops[:1])
    assert counts.shape == (3, 1)
    assert (counts == verify(crops, crops[:1])).all()
    assert len(verify._known) == 2
    assert verify([], crops).shape == (0, 3)


def test_what_points_say():
    verified = np.array([0, CERTAIN // 2, CERTAIN, 9 * CERTAIN, 0])
    compared = np.array([True, True, True, True, False])
    assert proof(verified, compared, float(CERTAIN)) == pytest.approx([-GAIN, 0, GAIN, GAIN, 0])
    assert proof(verified, compared, 0.0) == pytest.approx([0, GAIN / 2, GAIN, GAIN, 0])
    many = 2 * CERTAIN / OF_USUAL
    assert proof(verified, compared, many) == pytest.approx([-GAIN, -GAIN / 2, 0, GAIN, 0])


def test_the_usual_points_are_those_of_references_of_one_print():
    verify = encoder.PointVerifier()
    same = [print_of(0), turned(print_of(0)), turned(print_of(0), 40)]
    assert usual_points(remember("a", "box", same, MeanColour()), verify) >= 2 * CERTAIN
    several = [print_of(i) for i in range(3)]
    assert usual_points(remember("b", "box", several, MeanColour()), verify) < CERTAIN
    assert usual_points(remember("c", "box", same[:1], MeanColour()), verify) == 0


def counts_red(crops, references):
    """A verifier that finds points where a crop is red."""
    found = [[20 * int(crop[..., 0].mean() > crop[..., 2].mean())] for crop in crops]
    return np.array(found, np.int64).reshape(len(crops), 1).repeat(len(references), axis=1)


def both(images, phrase, threshold=None):
    xyxy = np.array([[10, 10, 90, 90], [110, 10, 190, 90]], np.float32)
    score = np.ones(2, np.float32)
    return [Boxes(xyxy, score, phrase, familiar=False)]


def attended(**parts):
    """Two squares of one colour for the encoder, of which one is red for the verifier."""
    rgb = scene([(10, 10, RED), (110, 10, BLUE)], size=200, side=80)
    stack = replace(TOYS, detector=both, verifier=counts_red, **parts)
    mug = personal("mug", "cup", (95, 40, 95), (95, 40, 95))
    _, result = Attender(stack, {"mug": mug}).start({"front": rgb}, "bring my cup")
    return result.groundings["front"][0]


def test_points_decide_between_look_alikes_of_an_unfamiliar_view():
    grounding = attended()
    assert grounding.candidates.verified[grounding.winner] == 20
    x0 = grounding.candidates.xyxy[grounding.winner][0]
    assert x0 == 10
    assert grounding.likeness.max() - grounding.likeness.min() == pytest.approx(GAIN, abs=1e-3)


def test_a_look_alike_without_the_print_is_not_in_view():
    strict = Thresholds(familiar=0.99, unfamiliar=0.99)

    def only_blue(images, phrase, threshold=None):
        return [found.take(np.array([1])) for found in both(images, phrase)]

    printed = replace(TOYS, detector=only_blue, verifier=PrintedRed(), thresholds=strict)
    rgb = scene([(10, 10, RED), (110, 10, BLUE)], size=200, side=80)
    mug = personal("mug", "cup", BLUE, BLUE)
    _, result = Attender(printed, {"mug": mug}).start({"front": rgb}, "bring my cup")
    grounding = result.groundings["front"][0]
    assert grounding.winner is None
    assert describe_rejection(grounding).endswith("below 0.99, 0 points verified")


class PrintedRed:
    """References agree with each other, and crops with none of them."""

    def __call__(self, crops, references):
        same = len(crops) == len(references) and len(crops) > 1
        return np.full((len(crops), len(references)), 20 if same else 0, np.int64)


def test_familiar_views_are_not_compared():
    def refuse(crops, references):
        raise AssertionError("compared")

    def known(images, phrase, threshold=None):
        return [replace(found, familiar=True) for found in both(images, phrase)]

    stack = replace(TOYS, detector=known, verifier=refuse)
    rgb = scene([(10, 10, RED), (110, 10, BLUE)], size=200, side=80)
    mug = personal("mug", "cup", RED)
    _, result = Attender(stack, {"mug": mug}).start({"front": rgb}, "bring my cup")
    assert result.groundings["front"][0].candidates.verified is None
