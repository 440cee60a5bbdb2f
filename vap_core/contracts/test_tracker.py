"""The contract of a tracker: every identity of each view, whatever the other views are."""

from collections.abc import Sequence

import numpy as np

from vap_core.base.types import Rgb, Track
from vap_core.contracts.given import RenderedScene
from vap_core.perception.boxes import mask_iou
from vap_core.perception.protocols import TargetTracker, Tracker


def follow(
    tracker: Tracker, images: Sequence[Rgb], masks: Sequence[np.ndarray]
) -> list[tuple[Track, ...]]:
    """The tracks one frame later, in which everything has moved by two pixels."""
    states = tracker.start(images, masks)
    return tracker.step(states, [np.roll(image, 2, axis=0) for image in images])[1]


def assert_same(tracks: Sequence[Track], others: Sequence[Track]) -> None:
    """The same scores and masks, bit for bit."""
    for a, b in zip(tracks, others, strict=True):
        assert a.score == b.score
        if a.mask is None or b.mask is None:
            assert a.mask is b.mask
        else:
            assert np.array_equal(a.mask, b.mask)


def test_every_identity_has_a_track_in_order(tracker: Tracker, scene: RenderedScene) -> None:
    first, second = follow(tracker, [scene.rgb, scene.rgb], [scene.masks, scene.masks[:1]])
    assert (len(first), len(second)) == (len(scene.masks), 1)
    for track in (*first, *second):
        assert isinstance(track, Track)
        if track.mask is not None:
            assert track.mask.shape == scene.rgb.shape[:2]


def test_a_view_without_identities_has_no_tracks(tracker: Tracker, scene: RenderedScene) -> None:
    assert follow(tracker, [scene.rgb], [scene.masks[:0]]) == [()]


def test_no_view_has_no_tracks(tracker: Tracker) -> None:
    """Where no view shows a target, nothing is followed."""
    assert tracker.start([], []) == []
    states, tracks = tracker.step([], [])
    assert (list(states), list(tracks)) == ([], [])
    if isinstance(tracker, TargetTracker):
        assert tracker.start_targets([], [], []) == []


def test_views_may_differ_in_size(tracker: Tracker, scene: RenderedScene) -> None:
    """In one call; a wrist camera need not be as large as the others."""
    h, w = scene.rgb.shape[:2]
    smaller = np.ascontiguousarray(scene.rgb[: h - 16, : w - 32])
    masks = np.ascontiguousarray(scene.masks[:2, : h - 16, : w - 32])
    first, second = follow(tracker, [scene.rgb, smaller], [scene.masks[:2], masks])
    assert_same(first, follow(tracker, [scene.rgb], [scene.masks[:2]])[0])
    assert_same(second, follow(tracker, [smaller], [masks])[0])


def test_the_targets_of_a_view_keep_their_places(tracker: Tracker, scene: RenderedScene) -> None:
    """Of `start_targets`, where the tracker has it: what is not asked for has no mask."""
    if not isinstance(tracker, TargetTracker):
        return
    n = len(scene.masks)
    moved = [np.roll(scene.rgb, 2, axis=0)]
    (tracks,) = tracker.step(tracker.start_targets([scene.rgb], [scene.masks], [[1]]), moved)[1]
    assert len(tracks) == n
    assert all(track.mask is None for i, track in enumerate(tracks) if i != 1)
    states = tracker.start_targets([scene.rgb], [scene.masks], [range(n)])
    (every,) = tracker.step(states, moved)[1]
    assert_same(every, follow(tracker, [scene.rgb], [scene.masks])[0])


def test_views_are_independent_and_repeat_their_bits(
    tracker: Tracker, scene: RenderedScene
) -> None:
    shifted = np.roll(scene.rgb, 3, axis=1)
    both = follow(tracker, [scene.rgb, shifted], [scene.masks[:2], scene.masks[1:2]])
    assert_same(both[0], follow(tracker, [scene.rgb], [scene.masks[:2]])[0])


def test_a_step_leaves_the_states_it_is_given(tracker: Tracker, scene: RenderedScene) -> None:
    """Where one episode fails a batch, the rollout steps the states of the others again."""
    states = tracker.start([scene.rgb], [scene.masks])
    moved = [np.roll(scene.rgb, 2, axis=0)]
    (once,) = tracker.step(states, moved)[1]
    (again,) = tracker.step(states, moved)[1]
    assert_same(once, again)


def test_sanity_a_still_scene_keeps_its_masks(tracker: Tracker, scene: RenderedScene) -> None:
    states = tracker.start([scene.rgb], [scene.masks])
    for _ in range(3):
        states, (tracks,) = tracker.step(states, [scene.rgb])
    kept = [
        0.0 if track.mask is None else mask_iou(track.mask, mask)
        for track, mask in zip(tracks, scene.masks, strict=True)
    ]
    assert np.mean(kept) >= 0.7


def test_sanity_what_is_gone_has_no_mask_and_what_is_back_has_one(
    tracker: Tracker, scene: RenderedScene
) -> None:
    states = tracker.start([scene.rgb], [scene.masks])
    for _ in range(3):
        states, (gone,) = tracker.step(states, [np.full_like(scene.rgb, 127)])
    assert all(track.mask is None for track in gone)
    for _ in range(2):
        states, (back,) = tracker.step(states, [scene.rgb])
    right = [
        track.mask is not None and mask_iou(track.mask, mask) > 0.5
        for track, mask in zip(back, scene.masks, strict=True)
    ]
    assert np.mean(right) >= 0.6
