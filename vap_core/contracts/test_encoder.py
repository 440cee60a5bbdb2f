"""The contract of an encoder: a row of length 1 for each crop, the same whatever else is asked."""

import numpy as np

from vap_core.contracts.given import RenderedScene, noise
from vap_core.perception.boxes import crop
from vap_core.perception.protocols import Encoder
from vap_core.vote import similarity


def test_it_has_a_name_for_the_memories_that_it_makes(encoder: Encoder) -> None:
    assert isinstance(encoder.name, str)
    assert encoder.name


def test_rows_are_float32_of_length_1(encoder: Encoder) -> None:
    rows = encoder([noise(0), noise(1, 40, 24), noise(2, 224, 224)])
    assert rows.dtype == np.float32
    assert rows.shape[0] == 3
    assert np.allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-4)


def test_no_crop_gives_no_row(encoder: Encoder) -> None:
    assert encoder([]).shape == (0, encoder([noise(0)]).shape[1])


def test_a_batch_equals_one_by_one_and_repeats_its_bits(encoder: Encoder) -> None:
    crops = [noise(0), noise(1, 40, 24), noise(2, 224, 224)]
    rows = encoder(crops)
    assert np.allclose(rows, np.concatenate([encoder([rgb]) for rgb in crops]), atol=1e-4)
    assert np.array_equal(rows, encoder(crops))


def test_sanity_an_object_is_most_like_itself(encoder: Encoder, scene: RenderedScene) -> None:
    rows = encoder([crop(scene.rgb, box) for box in scene.boxes.xyxy])
    nearby = scene.boxes.xyxy + np.array([-2, -1, 1, 2], np.float32)
    again = encoder([crop(scene.rgb, box) for box in nearby])
    assert (similarity(again, rows).argmax(axis=1) == np.arange(len(rows))).all()
