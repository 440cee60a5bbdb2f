"""SAM 3 and EdgeTAM: the real classes at toy size with random weights, in every role that they have.

SAM 3 is one repository with a detector and a tracker that share a backbone, and is stored here as that is. What depends on trained
weights is not tested here; that every input is what transformers' own processors make, and every answer that of its own models, is.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers as hf
from safetensors.torch import save_file
from torch.nn import functional as F  # noqa: N812

from tests.contract import kept
from tests.test_foundation import BATCHED, Pair, Watch, blurred, scene, session
from tests.tiny_foundation import draw
from vap_core.base.errors import MissingWeights
from vap_core.contracts import test_detector, test_segmenter, test_tracker
from vap_core.contracts.given import RenderedScene
from vap_core.perception import foundation
from vap_core.perception.foundation import models
from vap_core.perception.foundation.architectures import quiet_transformers, random_network
from vap_core.perception.foundation.tracker import backbone_without_hub
from vap_core.perception.foundation.weights import MODELS, TENSORS, models_of, pull, weights_table
from vap_core.perception.stacks import mixed

__all__ = ["scene"]
# timm compiles a few functions as it is imported.
pytestmark = pytest.mark.filterwarnings(
    "ignore:`torch.jit.script` is deprecated:DeprecationWarning"
)
TRACKERS = ["sam3", "edgetam"]
SIZES = [[32, 32], [16, 16], [8, 8]]
TRACKING: dict[str, Any] = {
    "memory_attention_hidden_size": 128,
    "memory_attention_num_layers": 2,
    "memory_encoder_hidden_size": 128,
    "mask_downsampler_embed_dim": 128,
    "memory_fuser_embed_dim": 128,
    "memory_fuser_intermediate_dim": 128,
}
DECODER = {"hidden_size": 128, "mlp_dim": 64, "num_attention_heads": 4, "iou_head_hidden_dim": 32}
IMAGE_MODELS = {"sam3": "Sam3TrackerModel", "edgetam": "EdgeTamModel"}


def sam3_network() -> Any:
    """Detector and tracker in one, as published: 112 pixels are 8 x 8 patches, and its memory is of 128 x 128."""
    vit = hf.Sam3ViTConfig(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2, image_size=112, window_size=4,
        global_attn_indexes=[1], pretrain_image_size=56,
    )  # fmt: skip
    vision = {
        "backbone_config": vit.to_dict(),
        "fpn_hidden_size": 128,
        "backbone_feature_sizes": SIZES,
    }
    text = {
        "vocab_size": 600, "hidden_size": 32, "intermediate_size": 64, "projection_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2,
        "max_position_embeddings": 32, "hidden_act": "gelu",
    }  # fmt: skip
    small = {"hidden_size": 128, "num_attention_heads": 4}
    layers = {**small, "num_layers": 1, "intermediate_size": 64}
    detector = hf.Sam3Config(
        vision_config=vision, text_config=text, geometry_encoder_config=layers, detr_encoder_config=layers,
        detr_decoder_config={**layers, "num_layers": 2, "num_queries": 30}, mask_decoder_config=small,
    )  # fmt: skip
    tracker = hf.Sam3TrackerVideoConfig(
        vision_config=vision, prompt_encoder_config={"hidden_size": 128, "image_size": 112}, mask_decoder_config=DECODER, image_size=112,
        memory_attention_feed_forward_hidden_size=64, **TRACKING,
    )  # fmt: skip
    return hf.Sam3VideoModel(hf.Sam3VideoConfig(detector_config=detector, tracker_config=tracker))


def edgetam_network() -> Any:
    """timm's RepViT, narrow and shallow; without the encodings that the published weights lack, too."""
    repvit = hf.TimmWrapperConfig(
        architecture="repvit_m1",
        model_args={
            "features_only": True,
            "out_indices": [0, 1, 2, 3],
            "embed_dim": [8, 16, 32, 64],
            "depth": [1, 1, 1, 1],
        },
    )
    vision = hf.EdgeTamVisionConfig(
        backbone_config=repvit,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=SIZES,
        fpn_hidden_size=128,
    )
    config = hf.EdgeTamVideoConfig(
        vision_config=vision, prompt_encoder_config={"hidden_size": 128, "image_size": 128}, mask_decoder_config=DECODER, image_size=128,
        memory_attention_mlp_hidden_size=64, memory_attention_rope_feat_sizes=[8, 8], memory_attention_rope_k_sizes=[4, 4],
        perceiver_resampler_num_latents=8, perceiver_resampler_num_latents_2d=16, enable_occlusion_spatial_embedding=False,
        enable_temporal_pos_encoding_for_object_pointers=False, **TRACKING,
    )  # fmt: skip
    return hf.EdgeTamVideoModel(config)


def clip_tokenizer() -> Any:
    """CLIP's tokenizer with single letters for words."""
    letters = "abcdefghijklmnopqrstuvwxyz"
    words = ["<|startoftext|>", *letters, *(f"{letter}</w>" for letter in letters), "<|endoftext|>"]
    return hf.CLIPTokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[])


def save(net: Any, folder: Path) -> None:
    """Tensors under the names of their modules, as in the published files (`save_pretrained` of 5.5 gives SAM 3's others)."""
    folder.mkdir(parents=True)
    net.config.to_json_file(folder / "config.json")
    tensors = {name: tensor.contiguous() for name, tensor in net.state_dict().items()}
    save_file(tensors, folder / TENSORS, metadata={"format": "pt"})


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store filled from a folder as on a machine without internet."""
    folder = tmp_path_factory.mktemp("sam3")
    with quiet_transformers(), backbone_without_hub(), torch.random.fork_rng():
        torch.manual_seed(0)
        for name, net, presence in (
            ("sam3", sam3_network(), -50.0),
            ("edgetam", edgetam_network(), 14.5),
        ):
            draw(net, presence)
            save(net, folder / "origin" / MODELS[name].repo)
    clip_tokenizer().save_pretrained(folder / "origin" / MODELS["sam3"].repo)
    pull(TRACKERS, folder / "store", origin=folder / "origin", unpinned=True, say=lambda line: None)
    return folder / "store"


@pytest.fixture(scope="module")
def parts(store: Path) -> dict[str, dict[str, Any]]:
    """What each of the two models fills of a stack; SAM 3 is detector and tracker."""
    loaded = {}
    for name, roles in (("sam3", ("detector", "tracker")), ("edgetam", ("tracker",))):
        stack = mixed("embedded", **dict.fromkeys(roles, name))
        assert models_of(stack) == (name,)
        loaded[name] = foundation.load_parts(stack, "cpu", store)
    return loaded


@pytest.fixture
def detector(parts: dict[str, dict[str, Any]]) -> Any:
    return parts["sam3"]["detector"]


@pytest.fixture(params=TRACKERS)
def tracking(parts: dict[str, dict[str, Any]], request: pytest.FixtureRequest) -> dict[str, Any]:
    """Segmenter and tracker of one model."""
    return {**parts[request.param], "name": request.param}


# --- Contracts -----------------------------------------------------------------------------------


def test_the_detector_keeps_the_contract(detector: Any, scene: Pair) -> None:
    assert type(detector.model) is hf.Sam3Model
    kept(test_detector, sanity=False, detector=detector, scene=RenderedScene(*scene))


def test_segmenters_keep_the_contract(tracking: dict[str, Any], scene: Pair) -> None:
    segmenter = tracking["segmenter"]
    kept(test_segmenter, sanity=False, segmenter=segmenter, scene=RenderedScene(*scene))


def test_trackers_keep_the_contract(tracking: dict[str, Any], scene: Pair) -> None:
    kept(test_tracker, sanity=False, tracker=tracking["tracker"], scene=RenderedScene(*scene))


# --- What goes in --------------------------------------------------------------------------------


def published(tokenizer: Any, side: int) -> Any:
    size = {"height": side, "width": side}
    return hf.Sam3Processor(hf.Sam3ImageProcessor(size=size), tokenizer)


@pytest.mark.parametrize("phrase", ["owl statue", "a very long phrase of more than thirty letters"])
def test_the_detector_sees_and_reads_what_the_published_processor_makes(
    detector: Any, phrase: str
) -> None:
    image = blurred(1, 90, 140)
    theirs = published(detector.tokenizer, 112)(
        images=torch.from_numpy(image).permute(2, 0, 1), return_tensors="pt"
    )
    with Watch(detector.model.vision_encoder) as watch:
        detector([image], f" {phrase}  ")
    assert (watch.given[0] - theirs["pixel_values"]).abs().max() <= 1.01 * 2 / 255  # one grey level
    words = detector.words(f" {phrase}  ")
    read = detector.tokenizer(
        phrase, padding="max_length", max_length=32, truncation=True, return_tensors="pt"
    )
    assert words["input_ids"].tolist() == read["input_ids"].tolist()
    assert words["attention_mask"].tolist() == read["attention_mask"].tolist()
    assert words["input_ids"].shape == (1, 32)
    if phrase == "owl statue":
        theirs = published(detector.tokenizer, 112)(text=[phrase], return_tensors="pt")
        assert words["input_ids"].tolist() == theirs["input_ids"].tolist()


def test_trackers_see_what_the_published_processor_makes(tracking: dict[str, Any]) -> None:
    image, seen = blurred(2, 90, 140), tracking["tracker"].sam
    kind = hf.Sam3ImageProcessor if tracking["name"] == "sam3" else hf.Sam2ImageProcessor
    published = kind(size={"height": seen.side, "width": seen.side})
    theirs = published(images=torch.from_numpy(image).permute(2, 0, 1), return_tensors="pt")
    level = 1 / 255 / min(seen.normalisation.std)
    assert (seen.pixels(image) - theirs["pixel_values"]).abs().max() <= 1.01 * level


# --- What comes out ------------------------------------------------------------------------------


def test_boxes_are_those_of_transformers_post_processing(detector: Any, scene: Pair) -> None:
    """From photo and phrase to boxes through their processor and model, and through ours."""
    rgb = scene[0]
    processor = published(detector.tokenizer, 112)
    inputs = processor(
        images=torch.from_numpy(rgb).permute(2, 0, 1), text="owl statue", return_tensors="pt"
    )
    with torch.inference_mode():
        out = detector.model(**{key: inputs[key] for key in ("pixel_values", "input_ids", "attention_mask")})  # fmt: skip
    (theirs,) = processor.post_process_object_detection(out, 0.0, [rgb.shape[:2]])
    boxes = np.clip(theirs["boxes"].numpy(), 0, (160, 120, 160, 120))
    found = detector([rgb], "owl statue", 0.0)[0]
    assert len(found) > 1
    assert found.score[0] == pytest.approx(theirs["scores"].max().item(), abs=1e-4)
    for box, score in zip(found.xyxy, found.score, strict=True):
        match = np.abs(boxes - box).max(axis=1).argmin()
        assert np.allclose(boxes[match], box, atol=0.05)
        assert theirs["scores"][match].item() == pytest.approx(score, abs=1e-4)
    for threshold in (None, 0.6):
        least = models.SAM3_THRESHOLD if threshold is None else threshold
        assert (detector([rgb], "owl statue", threshold)[0].score >= least).all()


def test_a_phrase_is_read_once_for_all_images_and_changes_the_boxes(detector: Any) -> None:
    images = [blurred(seed, 60, 80) for seed in (0, 1)]
    together = models.Sam3Detector(detector.model, detector.tokenizer, BATCHED)
    with Watch(detector.model.vision_encoder) as watch:
        found = together(images, "cup", 0.0)
    assert [len(given) for given in watch.given] == [2]
    for boxes, single in zip(found, detector(images, "cup", 0.0), strict=True):
        assert np.allclose(boxes.score, single.score, atol=1e-4)
    (other,) = detector(images[:1], "owl", 0.0)
    assert not np.allclose(other.score[:2], found[0].score[:2], atol=1e-4)


def test_masks_are_those_of_transformers_image_models(
    tracking: dict[str, Any], scene: Pair
) -> None:
    rgb, _, boxes = scene
    segmenter = tracking["segmenter"]
    ours = segmenter.sam.model
    cls = getattr(hf, IMAGE_MODELS[tracking["name"]])
    with quiet_transformers(), backbone_without_hub():
        config = cls.config_class(
            vision_config=ours.config.vision_config,
            prompt_encoder_config=ours.config.prompt_encoder_config.to_dict(),
            mask_decoder_config=ours.config.mask_decoder_config.to_dict(),
        )
        theirs = cls(config).eval()
    assert not theirs.load_state_dict(ours.state_dict(), strict=False).missing_keys
    side = segmenter.sam.side
    scale = np.array([side / 160, side / 120] * 2)
    seen: dict[str, Any] = {"pixel_values": segmenter.sam.pixels(rgb)}
    with torch.inference_mode():
        if tracking["name"] == "sam3":
            # Their image model (5.5) adds the no-memory embedding to a map that it drops; their video model adds it to the last.
            maps = ours.get_image_features(seen["pixel_values"]).fpn_hidden_states
            maps[-1] = maps[-1] + ours.no_memory_embedding
            seen = {"image_embeddings": [flat.permute(1, 2, 0).view(1, -1, *size) for flat, size in zip(maps, SIZES, strict=True)]}  # fmt: skip
        out = theirs(
            **seen,
            input_boxes=torch.from_numpy(boxes.xyxy * scale).float()[None],
            multimask_output=False,
        )
    decoded = segmenter.decode_boxes(rgb, boxes)
    assert torch.allclose(decoded.logits, out.pred_masks[0], atol=1e-3)
    assert torch.allclose(decoded.quality, out.iou_scores[0], atol=1e-4)
    assert (decoded.logits[0] - decoded.logits[1]).abs().max() > 0.01
    expected = F.interpolate(out.pred_masks[0], rgb.shape[:2], mode="bilinear")[:, 0] > 0
    assert expected.any()
    assert (segmenter(rgb, boxes) == expected.numpy()).mean() > 0.999


def test_tracks_are_those_of_transformers_video_session(
    tracking: dict[str, Any], scene: Pair
) -> None:
    """Longer than the memory of maps, with an identity that was never there, and a second view."""
    rgb, masks, _ = scene
    masks = np.concatenate([masks, np.zeros((1, 120, 160), bool)])
    frames = [np.roll(rgb, 4 * k, axis=1) for k in range(8)]
    tracker, other = tracking["tracker"], blurred(8, 100, 60)
    states = tracker.start([frames[0], other], [masks, np.ones((1, 100, 60), bool)])
    seen = []
    for k, (logits, presence) in enumerate(session(tracker.sam, frames, masks)):
        if k == 0:
            continue
        states, (tracks, _) = tracker.step(states, [frames[k], np.roll(other, k, axis=0)])
        assert np.allclose([t.score for t in tracks], presence.sigmoid().numpy(), atol=1e-3)
        whole = F.interpolate(logits, (120, 160), mode="bilinear")[:, 0]
        for track, logit in zip(tracks, whole, strict=True):
            assert (track.mask is None) == (not bool((logit > 0).any()))
            seen.append(track.mask is None)
            assert track.mask is None or ((logit > 0).numpy() == track.mask).mean() > 0.999
    assert set(seen) == {True, False}


# --- How they are named and stored ---------------------------------------------------------------


def test_one_folder_is_detector_and_tracker(parts: dict[str, dict[str, Any]]) -> None:
    filled = parts["sam3"]
    assert type(filled["detector"].model) is hf.Sam3Model
    assert type(filled["tracker"].sam.model) is hf.Sam3TrackerVideoModel
    assert filled["segmenter"].sam is filled["tracker"].sam
    assert filled["by_category"] is None  # the category is a phrase, too


def test_options_say_what_they_need(tmp_path: Path) -> None:
    with pytest.raises(
        MissingWeights,
        match=r"no checksum of sam3 \(facebook/sam3\) is pinned here; pass --unpinned .*first accept Meta's SAM licence",
    ):
        pull(["sam3"], tmp_path)
    with pytest.raises(MissingWeights, match=r"no checksum of edgetam .* pass --unpinned"):
        pull(["edgetam"], tmp_path)
    table = weights_table(tmp_path)
    for line in (":detector=sam3 facebook/sam3:", ":tracker=edgetam yonigozlan/EdgeTAM-hf:"):
        assert line in " ".join(table.split())


def test_edgetam_asks_the_hub_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """transformers alone asks it for a backbone's configuration, even to read a folder."""
    asked: list[Any] = []
    monkeypatch.setattr("transformers.utils.hub.cached_files", lambda *how, **more: asked.append(how))  # fmt: skip
    with torch.device("meta"):
        net = random_network("tracker", "edgetam")
    assert not asked
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(
        13.9e6, rel=2e-3
    )  # as published
