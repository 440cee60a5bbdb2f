"""The embedded tracker, on small films painted here: who stays, who vanishes, who comes back, and what is remembered meanwhile."""

from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vap_core.base.types import Track
from vap_core.perception.boxes import mask_iou
from vap_core.perception.embedded import cells, identities
from vap_core.perception.embedded import tracker as track

RED, BLUE, TEAL = (200, 40, 40), (40, 60, 200), (20, 150, 140)
SIZE = 128


@cache
def wood() -> np.ndarray:
    grain = np.random.default_rng(0).normal(0, 3, (SIZE, 1)) + np.zeros((SIZE, SIZE))
    return np.clip(np.array([200, 170, 130]) + grain[..., None], 0, 255).astype(np.uint8)


def paint(
    *discs: tuple[tuple[int, int, int], int, int], shape: tuple[int, int] = (SIZE, SIZE)
) -> tuple[np.ndarray, np.ndarray]:
    """Striped discs, 13 pixels in radius, on a wooden table: (colour, x, y) each; the picture and one mask per disc."""
    image, masks = np.resize(wood()[:, 0], (shape[0], 1, 3)).repeat(shape[1], axis=1), []
    rows, cols = np.mgrid[0 : shape[0], 0 : shape[1]]
    for colour, x, y in discs:
        mask = (rows - y) ** 2 + (cols - x) ** 2 <= 13**2
        image[mask] = colour
        image[mask & ((rows - y) // 4 % 3 == 0)] = (240, 235, 225)
        masks.append(mask)
    return image, np.array(masks, bool).reshape(-1, *shape)


def follow(images: list[np.ndarray], masks: np.ndarray) -> list[tuple[Track, ...]]:
    tracker = track.load()
    states, found = tracker.start(images[:1], [masks]), []
    for image in images[1:]:
        states, (tracks,) = tracker.step(states, [image])
        found.append(tracks)
    return found


def same(one: tuple[Track, ...], other: tuple[Track, ...]) -> bool:
    return all(
        a.score == b.score and np.array_equal(a.mask, b.mask)
        if a.mask is not None
        else b.mask is None
        for a, b in zip(one, other, strict=True)
    )


def size(part: Any) -> int:
    """Bytes of everything a state holds, counted wherever it is referred to."""
    if isinstance(part, np.ndarray):
        return part.nbytes
    if isinstance(part, tuple):
        return sum(map(size, part))
    if hasattr(part, "__dataclass_fields__"):
        return sum(size(getattr(part, field.name)) for field in fields(part))
    return 0


def test_a_still_scene_keeps_its_masks_to_the_pixel_and_sensor_noise_moves_none() -> None:
    image, masks = paint((RED, 40, 60), (BLUE, 90, 60))
    rng = np.random.default_rng(1)
    noisy = [
        np.clip(image + rng.normal(0, 2.5, image.shape), 0, 255).astype(np.uint8) for _ in range(3)
    ]
    for tracks in follow([image, image, *noisy], masks):
        assert all(
            np.array_equal(each.mask, mask) and each.score == 1
            for each, mask in zip(tracks, masks, strict=True)
        )


def test_one_moves_and_passes_while_the_other_stays() -> None:
    films = [paint((RED, 30 + 4 * t, 50), (BLUE, 70, 90)) for t in range(8)]
    for (_, masks), tracks in zip(
        films[1:], follow([image for image, _ in films], films[0][1]), strict=True
    ):
        assert all(
            each.mask is not None and mask_iou(each.mask, mask) > 0.7
            for each, mask in zip(tracks, masks, strict=True)
        )
        assert not (tracks[0].mask & tracks[1].mask).any()


def test_hidden_is_a_state_with_a_score_and_the_right_one_is_taken_back() -> None:
    both, (only, _), plate = (
        paint((RED, 40, 60), (BLUE, 90, 60)),
        paint((BLUE, 90, 60)),
        wood().copy(),
    )
    plate[:, :] = only
    plate[42:78, 22:58] = (110, 110, 115)
    back = paint((RED, 48, 66), (BLUE, 90, 60))
    found = follow([both[0], plate, plate, only, back[0], back[0]], both[1])
    for tracks in found[:3]:
        assert tracks[0].mask is None
        assert 0 <= tracks[0].score <= 1
        assert tracks[1].mask is not None
    assert found[2][0].score > 0.5  # nothing there looks like it
    assert found[-1][0].mask is not None
    assert mask_iou(found[-1][0].mask, back[1][0]) > 0.6


def test_what_is_never_seen_again_stays_not_visible_and_its_place_is_not_given_away() -> None:
    both, (only, _) = paint((RED, 40, 60), (TEAL, 90, 60)), paint((TEAL, 90, 60))
    for tracks in follow([both[0]] + [only] * 8, both[1]):
        assert tracks[0].mask is None
        assert mask_iou(tracks[1].mask, both[1][1]) > 0.9


def test_what_is_no_target_is_evidence_and_costs_nothing() -> None:
    """A hand that moves, or a look-alike that is lost, is neither drawn nor searched for."""
    tracker, (image, masks) = track.load(), paint((RED, 40, 60), (BLUE, 90, 60))
    states = tracker.start_targets([image], [masks], [[0]])
    moved, gone = paint((RED, 40, 60), (BLUE, 100, 90)), paint((RED, 40, 60))
    for picture, _ in (moved, gone):
        after, (tracks,) = tracker.step(states, [picture])
        assert after[0] is states[0]
        assert tracks[0].mask is not None
        assert (tracks[1].mask, tracks[1].score) == (None, 0)

    only = paint((BLUE, 60, 62))[0]  # the look-alike moves to where the target was
    for _ in range(6):
        states, (tracks,) = tracker.step(states, [only])
        assert tracks[0].mask is None
        assert tracks[1].mask is None
    back = paint((RED, 92, 66), (BLUE, 60, 62))
    for _ in range(2):
        states, (tracks,) = tracker.step(states, [back[0]])
    assert tracks[0].mask is not None
    assert mask_iou(tracks[0].mask, back[1][0]) > 0.6


def test_order_of_identities_permutes_the_tracks_and_views_do_not_meet() -> None:
    films = [paint((RED, 40 + 5 * t, 60), (BLUE, 90, 90 - 4 * t)) for t in range(3)]
    images, masks = [image for image, _ in films], films[0][1]
    for forth, back in zip(follow(images, masks), follow(images, masks[::-1]), strict=True):
        assert [each.mask is None for each in forth] == [each.mask is None for each in back[::-1]]
        assert all(mask_iou(a.mask, b.mask) > 0.98 for a, b in zip(forth, back[::-1], strict=True))
    tracker = track.load()
    states = tracker.start([images[0], images[2]], [masks, masks[:1]])
    _, (view, _) = tracker.step(states, [images[1], images[0]])
    assert same(view, follow(images[:2], masks)[0])


def test_a_mirrored_film_has_mirrored_tracks() -> None:
    films = [paint((RED, 36 + 5 * t, 60), (BLUE, 92, 76)) for t in range(4)]
    forth = follow([image for image, _ in films], films[0][1])
    back = follow([image[:, ::-1].copy() for image, _ in films], films[0][1][:, :, ::-1].copy())
    for tracks, mirrored in zip(forth, back, strict=True):
        assert all(
            mask_iou(a.mask, b.mask[:, ::-1]) > 0.85 for a, b in zip(tracks, mirrored, strict=True)
        )


def test_memory_does_not_grow() -> None:
    tracker, (image, masks) = track.load(), paint((RED, 40, 60), (BLUE, 90, 60))
    states, seen = tracker.start([image], [masks]), {}
    for t in range(1, 31):
        states, _ = tracker.step(states, [paint((RED, 40 + t % 2, 60), (BLUE, 90, 60))[0]])
        seen[t] = (size(states[0]), [crop.size for crop in states[0].last_crops])
        assert len(states[0].recent) <= identities.RECENT
    assert seen[30][0] - sum(seen[30][1]) == seen[5][0] - sum(seen[5][1])
    assert (
        max(sum(of) for _, of in seen.values()) <= 2 * 3 * SIZE * SIZE
    )  # crops are never larger than the picture


def test_an_unchanged_view_costs_no_features(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, (image, masks) = track.load(), paint((RED, 40, 60))
    states = tracker.start([image], [masks])
    elsewhere = image.copy()
    elsewhere[100:, 100:] = 0
    after, _ = tracker.step(states, [elsewhere])
    assert after[0] is states[0]
    nearby = image.copy()
    nearby[60:70, 54:60] = 0
    after, _ = tracker.step(states, [nearby])
    assert after[0] is not states[0]


@given(hnp.arrays(np.float32, int(np.prod(cells.BINS)), elements=st.floats(0, 1, width=16)))
def test_whatever_is_familiar_stays_so_when_colours_spread(shares: np.ndarray) -> None:
    tone = (shares / max(float(shares.sum()), 1e-6)).astype(np.float32)
    wide = cells.blur_shares(tone)
    assert (wide >= tone).all()
    assert abs(cells.familiar_share(tone, wide) - tone.sum()) < 1e-4
    assert cells.familiar_share(tone, np.zeros_like(tone)) == 0


def test_a_third_of_an_object_is_as_familiar_as_the_whole_and_a_plate_is_not() -> None:
    image, (mask,) = paint((RED, 64, 64))
    known, part = cells.colour_shares(image, mask), mask & (np.arange(SIZE)[:, None] > 68)
    assert cells.familiar_share(cells.colour_shares(image, part), known) > 0.9
    assert cells.familiar_share(cells.colour_shares(wood(), mask), known) < 0.3
    assert not cells.colour_shares(image, np.zeros_like(mask)).any()


def test_appearances_are_measured_against_bare_surroundings_and_against_each_other() -> None:
    rows = np.eye(3, dtype=np.float32)[:2]
    known = cells.Appearances(rows, np.array([0.4, 0.4], np.float32))
    tilted = np.array([0.5, 0.6, np.sqrt(0.39)], np.float32)
    assert known.accept(tilted, rows[1], 1)
    assert not known.accept(tilted, rows[0], 0)  # more like the other
    assert known.accept(tilted, tilted, 0)  # but it has looked like this of late
    assert not known.accept(
        np.array([0.3, 0.0, np.sqrt(0.91)], np.float32), rows[0], 0
    )  # like nothing in particular
    boxes = np.array([[0, 0, 40, 40], [88, 0, 128, 40]], np.float32)
    assert cells.background_crop(
        np.arange(SIZE * SIZE * 3, dtype=np.uint8).reshape(SIZE, SIZE, 3), boxes
    ).shape[:2] <= (44, 44)


def test_cells_lead_where_they_belong() -> None:
    keys = np.eye(4, dtype=np.float32)
    memory = [cells.FrameMemory(keys, np.array([[0, 1, 1, 1], [1, 0, 0, 0]], np.float32))]
    assert cells.cosine_lead(keys, np.array([1, 0, 0, 0], np.float32), memory, 0) == 1
    assert cells.cosine_lead(keys, np.array([0, 1, 0, 0], np.float32), memory, 0) == -1
    rows = cells.cells_near(
        [cells.FrameMemory(np.zeros((400, 2), np.float32), np.eye(2, 400, dtype=np.float32))],
        (20, 20),
        np.array([0]),
    )
    assert rows.reshape(20, 20).sum() == (1 + cells.RADIUS) * (
        2 + cells.RADIUS
    )  # identity 0 was in cell 1 of the first row


def test_changes_near_an_identity_are_noticed() -> None:
    image, masks = paint((RED, 40, 60))
    begun = identities.initial_state(image, masks, track.load().network)
    assert not identities.changed_nearby(begun, identities.thumbnail_of(image)).any()
    assert not identities.changed_nearby(
        begun, identities.thumbnail_of(np.clip(image.astype(int) + 5, 0, 255).astype(np.uint8))
    ).any()
    assert identities.changed_nearby(
        begun, identities.thumbnail_of(np.roll(image, 1, axis=1))
    ).all()


def test_the_largest_numbers_of_every_row_are_those_that_sorting_finds() -> None:
    rows = np.random.default_rng(0).standard_normal((7, 60)).astype(np.float32)
    rows[0] = 0.5
    expected = np.sort(rows, axis=1)[:, :-6:-1]
    columns, values = cells.largest(rows.copy(), 5)
    assert np.array_equal(values, expected)
    assert np.array_equal(np.take_along_axis(rows, columns, axis=1), expected)
    assert columns[0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("shape", [(112, 224), (224, 112)])
def test_a_picture_that_is_not_square_is_followed_as_well(shape: tuple[int, int]) -> None:
    height, width = shape
    down = 3 if height > width else 1

    def film(t: int) -> tuple[np.ndarray, np.ndarray]:
        red = (RED, width - 50 + 3 * t, height // 2 - 20 + down * t)
        return paint(red, (BLUE, 30, height - 30 - 2 * t), shape=shape)

    films = [film(t) for t in range(6)]
    for (_, masks), tracks in zip(
        films[1:], follow([i for i, _ in films], films[0][1]), strict=True
    ):
        for found, mask in zip(tracks, masks, strict=True):
            assert found.mask is not None
            assert mask_iou(found.mask, mask) > 0.7


def test_a_target_that_is_not_the_first_identity_is_followed() -> None:
    films = [paint((BLUE, 90, 40), (RED, 30 + 4 * t, 60)) for t in range(6)]
    tracker = track.load()
    states = tracker.start_targets([films[0][0]], [films[0][1]], [[1]])
    for image, masks in films[1:]:
        states, ((other, target),) = tracker.step(states, [image])
        assert other.mask is None
        assert target.mask is not None
        assert mask_iou(target.mask, masks[1]) > 0.7
