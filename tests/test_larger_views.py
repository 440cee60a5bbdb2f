"""Objects are looked for in larger pictures than the policy sees."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.toys import TOYS, personal, scene
from vap_core.attend import Attender, _carry
from vap_core.base.errors import BadViews
from vap_core.base.types import Boxes, Rgb, Views
from vap_core.perception.candidates import Candidates

LINE = scene([(24, 20, (40, 120, 110))])
MEMORY = {"mug": personal("mug", "cup", (40, 120, 110))}


def test_objects_are_looked_for_in_the_larger_views_and_marked_in_the_policys() -> None:
    """Of half a pixel, what the policy sees of the cup is found where the camera gives more."""
    seen: list[tuple[int, ...]] = []

    def found(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
        seen.extend(image.shape for image in images)
        return TOYS.detector(images, phrase, threshold)

    large = scene([(8, 8, (200, 30, 30)), (40, 40, (30, 30, 200))], size=128)
    small = cv2.resize(large, (64, 64), interpolation=cv2.INTER_AREA)
    memory = {"mug": personal("mug", "cup", (30, 30, 200))}
    attender = Attender(replace(TOYS, detector=found), memory)
    state, attended = attender.start({"front": small}, "bring my cup", larger={"front": large})
    (grounding,) = attended.groundings["front"]
    blue = small[..., 2] > 100
    assert seen == [(128, 128, 3)]
    assert grounding.masks.shape[1:] == (64, 64)
    assert (grounding.mask == blue).all()
    assert grounding.candidates.xyxy[grounding.winner].tolist() == [20.0, 20.0, 26.0, 26.0]
    assert attended.images["front"].shape == (64, 64, 3)
    assert ((attended.images["front"] != small).any(axis=2) == blue).all()
    _, after = attender.step(state, {"front": small})
    assert (after.tracks["front"][0].mask == blue).all()


@pytest.mark.parametrize(
    ("larger", "said"),
    [
        ({"back": LINE}, "a larger view of 'back', but the views are of front; name it after one"),
        (
            {"front": LINE[:32]},
            "larger view of 'front' is 64x32, but the view 64x64; give the same",
        ),
    ],
)
def test_a_larger_view_that_is_another_is_refused(larger: Views, said: str) -> None:
    with pytest.raises(BadViews, match=said):
        Attender(TOYS, MEMORY).start({"front": LINE}, "bring my cup", larger=larger)


@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(8, 40))
def test_a_thin_part_survives_where_it_covers_enough_of_a_pixel(
    seed: int, width: int, side: int
) -> None:
    """A mask carried to half the size keeps its area within its border, and is never empty."""
    x, y = np.random.default_rng(seed).integers(0, 60, 2)
    large = np.zeros((1, 128, 128), bool)
    large[0, y : y + width, x : x + side] = True
    boxes = Boxes(np.array([[x, y, x + side, y + width]], np.float32), np.ones(1, np.float32), "")
    found = Candidates(boxes, np.ones((1, 1), np.float32), large, (0,))
    pictures = [np.zeros((n, n, 3), np.uint8) for n in (128, 64)]
    carried = _carry(found, *pictures)
    assert carried.masks.any()
    rows, cols = np.nonzero(carried.masks[0])
    assert rows.min() >= y // 2
    assert rows.max() <= (y + width) // 2
    assert cols.max() - cols.min() + 1 >= side / 2 - 1
