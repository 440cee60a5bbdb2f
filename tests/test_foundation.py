"""The foundation stack with the real classes at toy size and random weights, loaded as a cluster without internet loads them.

What depends on trained weights (that the right box is found) is not tested here; that every number goes the right way in and comes
the right way out is, against transformers' own image predictor, video session and post-processing.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from torch.nn import functional as F  # noqa: N812

import vap_core
from tests import tiny_foundation
from tests.contract import kept
from vap_core import attend, memory
from vap_core.base.errors import MissingWeights, UnknownName
from vap_core.base.types import Boxes, Rgb
from vap_core.contracts import test_detector, test_encoder, test_segmenter, test_tracker
from vap_core.contracts.given import RenderedScene
from vap_core.perception import foundation
from vap_core.perception.boxes import MAX_BOXES, NMS_IOU, box_iou
from vap_core.perception.foundation import architectures, models
from vap_core.perception.foundation import models as dino
from vap_core.perception.foundation import models as grounding
from vap_core.perception.foundation import models as sam
from vap_core.perception.foundation import tracker as video
from vap_core.perception.foundation import weights as hub
from vap_core.perception.protocols import Stack, Thresholds, keep_thresholds
from vap_core.perception.stacks import load_stack

MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
BATCHED = models.Runtime(torch.device("cpu"), None, batched=True)
"""As on a GPU, but in single precision."""
Pair = tuple[np.ndarray, np.ndarray, Boxes]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_foundation.store(tmp_path_factory.mktemp("foundation"))


@pytest.fixture(scope="module")
def parts(weights: Path) -> Stack:
    return foundation.load("foundation", "cpu", weights)


@pytest.fixture(scope="module")
def scene() -> Pair:
    """Two coloured discs on a blurred wall."""
    rgb = blurred(3, 120, 160)
    masks = np.zeros((2, 120, 160), np.uint8)
    for mask, x, y, colour in zip(
        masks, (45, 110), (60, 70), ((200, 40, 40), (30, 60, 200)), strict=True
    ):
        cv2.circle(mask, (x, y), 22, 1, -1)
        rgb[mask > 0] = colour
    xyxy = np.array([[23, 38, 68, 83], [88, 48, 133, 93]], np.float32)
    return rgb, masks > 0, Boxes(xyxy, np.ones(2, np.float32), "cup")


def blurred(seed: int, h: int, w: int) -> Rgb:
    """Noise with structure at the scale of a few pixels, from 0 to 255."""
    soft = cv2.GaussianBlur(np.random.default_rng(seed).random((h, w, 3)), (0, 0), 3)
    return ((soft - soft.min()) / np.ptp(soft) * 255).astype(np.uint8)


# --- The contracts of the four protocols; with random weights there is no sanity -------------------------------------------


def test_contract_of_the_encoder(parts: Stack, scene: Pair) -> None:
    kept(test_encoder, encoder=parts.encoder, scene=RenderedScene(*scene))


def test_contract_of_the_detector(parts: Stack, scene: Pair) -> None:
    kept(test_detector, sanity=False, detector=parts.detector, scene=RenderedScene(*scene))


def test_contract_of_the_segmenter(parts: Stack, scene: Pair) -> None:
    kept(test_segmenter, sanity=False, segmenter=parts.segmenter, scene=RenderedScene(*scene))


def test_contract_of_the_tracker(parts: Stack, scene: Pair) -> None:
    kept(test_tracker, sanity=False, tracker=parts.tracker, scene=RenderedScene(*scene))


# --- Pre-processing, against a few readable lines each -------------------------------------------------------------------


def resized(image: Rgb, w: int, h: int, how: Image.Resampling) -> np.ndarray:
    """PIL's resampling, ImageNet's normalisation, channels first."""
    return ((np.asarray(Image.fromarray(image).resize((w, h), how)) / 255 - MEAN) / STD).transpose(
        2, 0, 1
    )


class Watch:
    """What a network is given, call by call."""

    def __init__(self, net: torch.nn.Module) -> None:
        self.given: list[torch.Tensor] = []
        self._hook = net.register_forward_pre_hook(self._keep, with_kwargs=True)

    def _keep(self, net: torch.nn.Module, args: tuple, kwargs: dict) -> None:
        self.given.append(args[0] if args else kwargs["pixel_values"])

    def __enter__(self) -> "Watch":
        return self

    def __exit__(self, *error: object) -> None:
        self._hook.remove()


@pytest.mark.parametrize(
    ("hw", "seen"), [((120, 160), (800, 1066)), ((300, 100), (1333, 444)), ((90, 90), (800, 800))]
)
def test_the_detector_sees_800_pixels_normalised(
    parts: Stack, hw: tuple[int, int], seen: tuple[int, int]
) -> None:
    """The shorter side becomes 800 pixels, or less where the longer one would exceed 1333."""
    image = blurred(0, *hw)
    with Watch(parts.detector.model) as watch:
        parts.detector([image], "cup")
    (given,) = watch.given
    assert tuple(given.shape[2:]) == seen
    assert np.allclose(
        given[0].numpy(), resized(image, seen[1], seen[0], Image.Resampling.BILINEAR), atol=1e-5
    )


def test_the_encoder_sees_the_whole_crop_in_a_grey_square(parts: Stack) -> None:
    crop = blurred(1, 50, 100)
    with Watch(parts.encoder.model) as watch:
        parts.encoder([crop])
    framed = np.full((100, 100, 3), np.round(MEAN * 255), np.uint8)
    framed[25:75] = crop
    assert np.allclose(
        watch.given[0][0].numpy(), resized(framed, 224, 224, Image.Resampling.BICUBIC), atol=1e-5
    )


@pytest.mark.parametrize("hw", [(96, 128), (300, 200), (7, 90)])
def test_sam_sees_the_image_stretched_to_a_square(hw: tuple[int, int]) -> None:
    image = blurred(2, *hw)
    given = sam.to_model(image, 128, torch.device("cpu"))[0].numpy()
    assert (
        np.abs(given - resized(image, 128, 128, Image.Resampling.BILINEAR)).max()
        <= 1.01 / 255 / STD.min()
    )  # one grey level


@pytest.mark.parametrize(
    ("phrase", "read"),
    [("cup", "cup."), ("  Owl  Statue ", "owl statue."), ("Dr. Pepper.", "dr pepper.")],
)
def test_phrases_are_read_in_lower_case_with_one_dot(phrase: str, read: str) -> None:
    assert grounding.text_query(phrase) == read


# --- Detector ------------------------------------------------------------------------------------------------------------


def test_boxes_are_those_of_transformers_post_processing(parts: Stack, scene: Pair) -> None:
    from transformers import GroundingDinoProcessor

    rgb, detector = scene[0], parts.detector
    caught: list = []
    hook = detector.model.register_forward_hook(lambda net, args, out: caught.append(out))
    found = detector([rgb], "Owl statue")[0]
    hook.remove()
    kept = GroundingDinoProcessor.post_process_grounded_object_detection(
        _Decoder(detector.tokenizer),
        caught[0],
        detector.tokenizer(["owl statue."], return_tensors="pt").input_ids,
        0.25,
        target_sizes=[rgb.shape[:2]],
    )[0]
    theirs = np.clip(kept["boxes"].numpy(), 0, (160, 120, 160, 120))
    scores = kept["scores"].numpy()
    assert len(found) > 1
    for box, score in zip(found.xyxy, found.score, strict=True):
        match = np.abs(theirs - box).max(axis=1).argmin()
        assert np.allclose(theirs[match], box, atol=1e-3)
        assert scores[match] == pytest.approx(score, abs=1e-6)
    assert found.score[0] == pytest.approx(scores.max())
    assert found.phrase == "Owl statue"


class _Decoder:
    """All that the post-processing needs of a processor."""

    def __init__(self, tokenizer: object) -> None:
        self.batch_decode = tokenizer.batch_decode  # type: ignore[attr-defined]


def test_the_threshold_is_the_detectors_own_or_the_one_given(parts: Stack, scene: Pair) -> None:
    own, strict, all_of_them = (
        parts.detector([scene[0]], "cup", threshold)[0] for threshold in (None, 0.99, 0.0)
    )
    assert (own.score >= grounding.THRESHOLD).all()
    assert (strict.score >= 0.99).all()
    assert len(strict) <= len(own) <= len(all_of_them)
    assert len(parts.detector([scene[0]], "cup", 1.01)[0]) == 0


def test_images_of_different_sizes_keep_their_order_and_answers(parts: Stack) -> None:
    images = [blurred(0, 60, 80), blurred(1, 90, 70), blurred(2, 60, 80)]
    alone = parts.detector
    together = grounding.GroundingDino(alone.model, alone.tokenizer, BATCHED)
    with Watch(together.model) as watch:
        found = together(images, "cup")
    assert [len(given) for given in watch.given] == [2, 1]
    for boxes, single in zip(found, alone(images, "cup"), strict=True):
        assert np.allclose(boxes.xyxy, single.xyxy, atol=1e-2)
        assert np.allclose(boxes.score, single.score, atol=1e-5)


def test_selection_keeps_the_best_clips_and_drops_overlaps() -> None:
    xyxy = np.array(
        [[-5, 0, 10, 10], [0, 0, 10, 11], [20, 20, 30, 30], [40, 40, 40.5, 60], [0, 0, 50, 50]],
        np.float32,
    )
    score = np.array([0.5, 0.9, 0.7, 0.8, 0.2], np.float32)
    kept = grounding.select_boxes(xyxy, score, (25, 40), "cup", 0.3)
    assert kept.xyxy.tolist() == [[0, 0, 10, 11], [20, 20, 30, 25]]
    assert kept.score.tolist() == pytest.approx([0.9, 0.7])
    assert len(grounding.select_boxes(xyxy, score, (25, 40), "cup", 0.95)) == 0


@given(
    hnp.arrays(np.float32, (30, 4), elements=st.floats(-20, 120, width=16)),
    hnp.arrays(np.float32, (30,), elements=st.floats(0, 1, width=16)),
)
def test_chosen_boxes_are_always_few_sorted_inside_and_apart(
    xyxy: np.ndarray, score: np.ndarray
) -> None:
    kept = grounding.select_boxes(xyxy, score, (100, 80), "cup", 0.25)
    assert len(kept) <= MAX_BOXES
    assert (np.diff(kept.score) <= 0).all()
    assert ((kept.xyxy >= 0) & (kept.xyxy <= (80, 100, 80, 100))).all()
    overlap = box_iou(kept.xyxy, kept.xyxy) - np.eye(len(kept))
    assert (overlap <= NMS_IOU).all()


# --- Any image -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hw", [(1, 1), (1, 300), (211, 3)])
def test_any_image_size_and_aspect(parts: Stack, hw: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*hw, 3), dtype=np.uint8)
    image.setflags(write=False)
    flipped = image[::-1, ::-1]
    (boxes,) = parts.detector([flipped], "cup")
    assert (boxes.xyxy <= (hw[1], hw[0], hw[1], hw[0])).all()
    assert parts.encoder([flipped]).shape == (1, 48)
    whole = Boxes(np.array([[0, 0, hw[1], hw[0]]], np.float32), np.ones(1, np.float32), "cup")
    masks = parts.segmenter(flipped, whole)
    assert masks.shape == (1, *hw)
    _, tracks = parts.tracker.step(parts.tracker.start([flipped], [masks]), [flipped])
    assert tracks[0][0].mask is None or tracks[0][0].mask.shape == hw


@given(st.integers(1, 90), st.integers(1, 90))
def test_strips_are_padded_and_nothing_else(h: int, w: int) -> None:
    image = np.full((h, w, 3), 7, np.uint8)
    padded = grounding.pad_strip(image)
    assert max(padded.shape[:2]) <= grounding.MAX_ASPECT * min(padded.shape[:2])
    assert (padded[:h, :w] == 7).all()
    assert padded.astype(int).sum() == 7 * 3 * h * w
    assert padded is image or max(h, w) > grounding.MAX_ASPECT * min(h, w)


@given(st.integers(1, 400), st.integers(1, 400))
def test_square_keeps_all_of_a_crop(h: int, w: int) -> None:
    framed = dino.pad_to_square(np.full((h, w, 3), 255, np.uint8))
    side = framed.shape[0]
    assert framed.shape == (side, side, 3)
    assert side == min(max(h, w), dino.SIDE)
    white = (framed == 255).all(axis=2)
    scale = side / max(h, w)
    assert white.sum() == max(1, round(h * scale)) * max(1, round(w * scale))


# --- SAM 2.1 -------------------------------------------------------------------------------------------------------------


def test_masks_are_those_of_transformers_image_model(
    parts: Stack, weights: Path, scene: Pair
) -> None:
    from transformers import Sam2Model

    rgb, _, boxes = scene
    with architectures.quiet_transformers():
        theirs = Sam2Model.from_pretrained(weights / hub.MODELS["sam2.1-hiera-large"].folder).eval()
    corners = torch.from_numpy(boxes.xyxy * (128 / 160, 128 / 120, 128 / 160, 128 / 120)).float()[
        None
    ]
    with torch.inference_mode():
        out = theirs(
            pixel_values=sam.to_model(rgb, 128, torch.device("cpu")),
            input_boxes=corners,
            multimask_output=False,
        )
    ours = parts.segmenter.decode_boxes(rgb, boxes)
    assert torch.allclose(ours.logits, out.pred_masks[0], atol=1e-4)
    assert torch.allclose(ours.quality, out.iou_scores[0], atol=1e-5)
    assert (ours.logits[0] - ours.logits[1]).abs().max() > 0.01
    expected = F.interpolate(out.pred_masks[0], rgb.shape[:2], mode="bilinear")[:, 0] > 0
    assert expected.any()
    assert (parts.segmenter(rgb, boxes) == expected.numpy()).mean() > 0.9999


def test_a_box_without_a_likely_pixel_gets_its_most_likely_ones() -> None:
    chance = np.full((20, 30), 0.001, np.float32)
    chance[5:8, 5:9], chance[15, 25] = 0.2, 0.4
    mask = sam._threshold(chance, np.array([4.2, 4.0, 12.0, 10.0], np.float32))
    assert mask.sum() == 12
    assert mask[5:8, 5:9].all()


def test_the_backbone_runs_once_per_opening_frame_and_once_per_step(
    parts: Stack, scene: Pair
) -> None:
    _, masks, boxes = scene
    views = [blurred(seed, 120, 160) for seed in (11, 12, 13)]
    shared = sam.Sam(parts.tracker.sam.model, BATCHED)
    segmenter, tracker = sam.SamSegmenter(shared), video.SamTracker(shared)
    with Watch(shared.model.vision_encoder) as watch:
        for view in views:
            segmenter(view, boxes)
            segmenter(view, boxes)
        states = tracker.start(views, [masks, masks[:1], masks[:0]])
        assert [len(given) for given in watch.given] == [1, 1, 1]
        states, together = tracker.step(states, views)
    assert [len(given) for given in watch.given] == [1, 1, 1, 2]
    _, alone = parts.tracker.step(parts.tracker.start(views, [masks, masks[:1], masks[:0]]), views)
    for one, other in zip(sum(together, ()), sum(alone, ()), strict=True):
        assert one.score == pytest.approx(other.score, abs=1e-4)
        assert (one.mask is None) == (other.mask is None)
        assert one.mask is None or (one.mask == other.mask).mean() > 0.999


def test_encoding_in_batches_changes_nothing_but_last_bits(parts: Stack) -> None:
    crops = [blurred(seed, 30 + seed, 50) for seed in range(dino.ENCODER_BATCH + 3)]
    together = dino.CropEncoder(parts.encoder.model, dino.DINO, "batched", BATCHED)
    with Watch(together.model) as watch:
        assert np.allclose(together(crops), parts.encoder(crops), atol=1e-5)
    assert [len(given) for given in watch.given[:2]] == [dino.ENCODER_BATCH, 3]


def session(
    ours: sam.Sam, frames: list[Rgb], masks: np.ndarray
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """transformers' own streaming session: every frame's mask logits and presence logits; it keeps all frames."""
    import transformers

    kind = type(ours.model).__name__.replace("Model", "InferenceSession")
    theirs = getattr(transformers, kind)(
        video_height=masks.shape[1], video_width=masks.shape[2], dtype=torch.float32
    )
    for i, mask in enumerate(masks):
        given = F.interpolate(
            torch.from_numpy(mask)[None, None].float(),
            (ours.side, ours.side),
            mode="bilinear",
            antialias=True,
        )
        theirs.add_mask_inputs(theirs.obj_id_to_idx(i), 0, (given >= 0.5).float())
    theirs.obj_with_new_inputs = list(range(len(masks)))
    for frame in frames:
        out = ours.model(theirs, frame=ours.pixels(frame))
        yield out.pred_masks.clone(), out.object_score_logits.flatten().clone()


def test_tracks_are_those_of_transformers_video_session(parts: Stack, scene: Pair) -> None:
    """Longer than every memory (16 pointers), with identities that come and go, one that was never there, and a second view."""
    rgb, masks, _ = scene
    masks = np.concatenate([masks, np.zeros((1, 120, 160), bool)])
    frames = [np.roll(rgb, 4 * k, axis=1) for k in range(20)]
    other = blurred(8, 100, 60)
    states = parts.tracker.start([frames[0], other], [masks, np.ones((1, 100, 60), bool)])
    seen, sizes = set(), []
    for k, (logits, presence) in enumerate(session(parts.tracker.sam, frames, masks)):
        if k == 0:
            continue
        states, (tracks, _) = parts.tracker.step(states, [frames[k], np.roll(other, k, axis=0)])
        assert np.allclose([t.score for t in tracks], presence.sigmoid().numpy(), atol=1e-3)
        for track, logit in zip(
            tracks, F.interpolate(logits, (120, 160), mode="bilinear")[:, 0], strict=True
        ):
            assert (track.mask is None) == (not bool((logit > 0).any()))
            seen.add(track.mask is None)
            assert track.mask is None or ((logit > 0).numpy() == track.mask).mean() > 0.999
        sizes.append(stored(states))
    assert seen == {True, False}
    assert len(set(sizes[16:])) == 1
    assert sizes[16][0] == 2 * (2 + 2 * 6 + 15)


def stored(states: list[video.SamTrackState]) -> tuple[int, int]:
    """Tensors and bytes that the states hold."""
    frames = [
        frame
        for state in states
        if state.first is not None
        for frame in (state.first, *state.recent)
    ]
    tensors = [tensor for frame in frames for tensor in (frame.cells, frame.pointer)] + [
        tensor for state in states for tensor in state.pointers
    ]
    return len(tensors), sum(tensor.untyped_storage().nbytes() for tensor in tensors)


def test_absence_is_said_with_a_low_score(parts: Stack, scene: Pair) -> None:
    rgb, masks, _ = scene
    bias = parts.tracker.sam.model.mask_decoder.pred_obj_score_head.proj_out.bias
    before = bias.clone()
    try:
        for shift, there in ((-30.0, False), (30.0, True)):
            bias.data.copy_(before + shift)
            _, (tracks,) = parts.tracker.step(parts.tracker.start([rgb], [masks]), [rgb])
            assert [t.mask is not None for t in tracks] == [there] * 2
            assert all((t.score > 0.99) if there else (t.score < 0.01) for t in tracks)
    finally:
        bias.data.copy_(before)


def test_wrong_shapes_are_refused(parts: Stack, scene: Pair) -> None:
    rgb, masks, _ = scene
    with pytest.raises(ValueError, match="must agree"):
        parts.tracker.start([rgb], [masks[:, :100]])
    with pytest.raises(ValueError, match="keeps its size"):
        parts.tracker.step(parts.tracker.start([rgb], [masks]), [rgb[:100]])


# --- Precision and device ------------------------------------------------------------------------------------------------


def test_half_precision_changes_little_and_ends_with_the_call(parts: Stack, scene: Pair) -> None:
    rgb, masks, boxes = scene
    half = models.Runtime(torch.device("cpu"), torch.bfloat16, batched=True)
    exact = parts.encoder([rgb])
    encoder = dino.CropEncoder(parts.encoder.model, dino.DINO, "half", half)
    assert (encoder([rgb]) @ exact.T).item() > 0.995
    assert encoder([rgb]).dtype == np.float32
    detector = grounding.GroundingDino(parts.detector.model, parts.detector.tokenizer, half)
    assert detector([rgb], "cup", 0.0)[0].score.dtype == np.float32
    both = sam.Sam(parts.tracker.sam.model, half)
    found, whole = sam.SamSegmenter(both)(rgb, boxes), parts.segmenter(rgb, boxes)
    assert (found.shape, found.dtype) == (
        whole.shape,
        whole.dtype,
    )  # random weights put logits about zero: which pixels round over is the CPU's
    tracker = video.SamTracker(both)
    states, _ = tracker.step(tracker.start([rgb], [masks]), [rgb])
    assert states[0].recent[0].pointer.dtype == torch.float32
    assert not torch.is_autocast_enabled("cpu")
    assert not torch.is_inference_mode_enabled()


def test_the_device_is_chosen_or_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert models.select_runtime("cpu") == models.Runtime(torch.device("cpu"), None, batched=False)
    monkeypatch.setenv("VAP_DEVICE", "cpu")
    assert models.select_runtime().device == torch.device("cpu")
    monkeypatch.setenv("VAP_DEVICE", "abacus")
    with pytest.raises(UnknownName, match="device 'abacus' is not on this machine"):
        models.select_runtime()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("stack", ["embedded", "foundation"])
def test_a_gpu_that_is_asked_for_and_not_there_is_an_error(
    monkeypatch: pytest.MonkeyPatch, stack: str
) -> None:
    """Also for the embedded stack, which computes on the CPU whatever is asked for."""
    monkeypatch.setenv("VAP_DEVICE", "cuda")
    with pytest.raises(UnknownName, match=r"device 'cuda' is not on this machine .* VAP_DEVICE"):
        load_stack(stack)


# --- The whole stack -----------------------------------------------------------------------------------------------------


def test_the_stack_has_the_thresholds_that_calibrate_kept(weights: Path) -> None:
    stack = foundation.load("foundation", "cpu", weights)
    assert stack.thresholds is None
    path = keep_thresholds(weights, "foundation", stack.encoder.name, Thresholds(0.6, 0.6))
    try:
        assert foundation.load("foundation", "cpu", weights).thresholds == Thresholds(0.6, 0.6)
    finally:
        path.unlink()


def test_a_stack_is_kept_for_its_own_store(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(hub.VARIABLE, str(weights))
    monkeypatch.setenv("VAP_DEVICE", "cpu")
    load_stack("foundation")
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    with pytest.raises(MissingWeights, match="weights pull --stack foundation"):
        load_stack("foundation")


def test_the_whole_attender_runs_and_repeats_its_bits(
    weights: Path, scene: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(hub.VARIABLE, str(weights))
    monkeypatch.setenv("VAP_DEVICE", "cpu")
    stack = load_stack("foundation")
    assert stack.name == "foundation"
    assert stack.encoder.name.startswith("dinov2-base-")
    rgb = scene[0]
    mug, _ = memory.register(
        "mug",
        "cup",
        [rgb[20:100, 10:80].copy(), rgb[30:90, 15:75].copy()],
        stack.detector,
        stack.encoder,
    )
    assert mug.encoder == stack.encoder.name
    attender = attend.Attender(stack, {"mug": mug})
    views = {"front": rgb, "side": blurred(5, 90, 70)}

    def run() -> list[attend.Attended]:
        state, first = attender.start(views, "bring my cup")
        shown = [first]
        for k in range(1, 4):
            state, attended = attender.step(
                state, {name: np.roll(image, k, axis=1) for name, image in views.items()}
            )
            shown.append(attended)
        return shown

    once, again = run(), run()
    assert once[0].text.startswith("bring the ")
    for a, b in zip(once, again, strict=True):
        for name in views:
            assert np.array_equal(a.images[name], b.images[name])
            assert [t.score for t in a.tracks[name]] == [t.score for t in b.tracks[name]]
    for k, attended in enumerate(once):
        for name, image in views.items():
            (track,) = attended.tracks[name]
            outside = np.ones(image.shape[:2], bool) if track.mask is None else ~track.mask
            assert np.array_equal(
                attended.images[name][outside], np.roll(image, k, axis=1)[outside]
            )


def test_without_weights_both_ways_to_get_them_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(hub.VARIABLE, str(tmp_path))
    with pytest.raises(
        MissingWeights,
        match=r"sam2\.1-hiera-tiny \(lacks config\.json, model\.safetensors\).*weights pull --stack .*--from DIR",
    ) as caught:
        load_stack("foundation-small")
    assert "\n" not in str(caught.value)


def test_weights_of_another_architecture_are_named(weights: Path) -> None:
    _, encoder, _ = hub.verify_stack("foundation", weights)
    with pytest.raises(
        MissingWeights, match="lacks .* tensors of Sam2VideoModel|cannot be read as Sam2VideoModel"
    ):
        architectures.read_part("tracker", "sam2.1-hiera-large", encoder, BATCHED)


@pytest.mark.parametrize(("part", "name", "published"), [
    ("detector", "grounding-dino-tiny", 689_359_096), ("encoder", "dinov2-small", 88_249_960), ("tracker", "sam2.1-hiera-tiny", 155_908_064),
])  # fmt: skip
def test_random_networks_have_the_published_sizes(part: str, name: str, published: int) -> None:
    """Bytes of model.safetensors at the pinned revisions: four a parameter, and its header."""
    with torch.device("meta"):
        net = architectures.random_network(part, name)
    assert 4 * sum(p.numel() for p in net.parameters()) == pytest.approx(published, rel=2e-3)


def test_transformers_is_imported_by_the_foundation_stack_and_the_policies_alone() -> None:
    package = Path(vap_core.__file__).parent
    importers = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            wanted = (
                [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else []
            )
            if any(name.split(".")[0] == "transformers" for name in wanted):
                importers.add(path.relative_to(package).parent.as_posix())
    assert importers == {"perception/foundation", "policies/lerobot", "policies/mini_pi0"}
