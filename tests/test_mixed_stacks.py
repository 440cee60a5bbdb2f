"""Stacks mixed from parts: the real classes at toy size with random weights, in the role that each can have.

What depends on trained weights is not tested here; that every option's pixels are those of its published processor, and its answers those
of transformers' own code, is.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.contract import kept
from tests.test_foundation import _Decoder, blurred, scene
from vap_core.base.errors import MissingWeights, UnknownName
from vap_core.contracts import test_detector, test_encoder
from vap_core.contracts.given import RenderedScene
from vap_core.perception import foundation
from vap_core.perception.foundation import models as crops
from vap_core.perception.foundation.architectures import letter_tokenizer, quiet_transformers
from vap_core.perception.foundation.weights import (
    KINDS,
    MODELS,
    PARTS,
    models_of,
    parts_of,
    pull,
    weights_table,
)
from vap_core.perception.protocols import JudgedDetector, Thresholds, keep_thresholds
from vap_core.perception.stacks import EMBEDDED_THRESHOLDS, check_stack, load_stack, mixed

__all__ = ["scene"]
ROOT = Path(__file__).resolve().parents[1]
TOYS = ("llmdet-tiny", "dinov3-small", "siglip2-base")


def network(model: str) -> Any:
    """The model's own class, a few thousand random weights, drawn wide enough that answers differ."""
    import transformers as hf

    match model:
        case "llmdet-tiny":
            swin = hf.SwinConfig(
                image_size=64, embed_dim=16, depths=[1, 1, 1, 1], num_heads=[1, 2, 4, 8], window_size=4, out_indices=[2, 3, 4],
            )  # fmt: skip
            bert = hf.BertConfig(
                hidden_size=32, num_hidden_layers=1, num_attention_heads=2, intermediate_size=64, vocab_size=1030,
            )  # fmt: skip
            config = hf.MMGroundingDinoConfig(
                backbone_config=swin, text_config=bert, d_model=32, num_queries=30, encoder_layers=1, decoder_layers=2,
                encoder_attention_heads=2, decoder_attention_heads=2, encoder_ffn_dim=64, decoder_ffn_dim=64,
            )  # fmt: skip
            net = hf.MMGroundingDinoForObjectDetection(config)
        case "dinov3-small":
            net = hf.DINOv3ViTModel(
                hf.DINOv3ViTConfig(hidden_size=48, intermediate_size=96, num_hidden_layers=2, num_attention_heads=4)
            )  # fmt: skip
        case "siglip2-base":
            # The published repository holds the text tower, too.
            small = {
                "hidden_size": 48,
                "intermediate_size": 96,
                "num_hidden_layers": 2,
                "num_attention_heads": 4,
            }
            net = hf.SiglipModel(
                hf.SiglipConfig(
                    text_config={**small, "vocab_size": 64, "projection_size": 48},
                    vision_config=small,
                )
            )
    for name, weight in net.named_parameters():
        if weight.ndim > 1 and weight.numel() and "norm" not in name:
            torch.nn.init.normal_(weight, std=0.9 / weight[0].numel() ** 0.5)
    return net.eval()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the toys, filled from a folder as on a machine without internet."""
    folder = tmp_path_factory.mktemp("mixed")
    with quiet_transformers(), torch.random.fork_rng():
        torch.manual_seed(0)
        for name in TOYS:
            network(name).save_pretrained(folder / "origin" / MODELS[name].repo)
    letter_tokenizer().save_pretrained(folder / "origin" / MODELS["llmdet-tiny"].repo)
    pull(TOYS, folder / "store", origin=folder / "origin", unpinned=True, say=lambda line: None)
    return folder / "store"


@pytest.fixture
def here(store: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VAP_WEIGHTS", str(store))
    monkeypatch.setenv("VAP_DEVICE", "cpu")
    return store


def part(store: Path, **parts: str) -> Any:
    """The one part that is not embedded."""
    (role,) = parts
    return foundation.load_parts(mixed("embedded", **parts), "cpu", store)[role]


@pytest.mark.parametrize("name", ["dinov3-small", "siglip2-base"])
def test_every_encoder_keeps_the_contract(store: Path, scene: tuple, name: str) -> None:
    kept(test_encoder, encoder=part(store, encoder=name), scene=RenderedScene(*scene))


def test_the_mm_grounding_dino_keeps_the_contract(store: Path, scene: tuple) -> None:
    detector = part(store, detector="llmdet-tiny")
    assert type(detector.model).__name__ == "MMGroundingDinoForObjectDetection"
    kept(test_detector, sanity=False, detector=detector, scene=RenderedScene(*scene))


def test_its_boxes_are_those_of_transformers_post_processing(store: Path, scene: tuple) -> None:
    from transformers import GroundingDinoProcessor

    rgb, detector = scene[0], part(store, detector="llmdet-tiny")
    caught: list = []
    hook = detector.model.register_forward_hook(lambda net, args, out: caught.append(out))
    found = detector([rgb], "Owl statue", 0.0)[0]
    hook.remove()
    theirs = GroundingDinoProcessor.post_process_grounded_object_detection(
        _Decoder(detector.tokenizer),
        caught[0],
        detector.tokenizer(["owl statue."], return_tensors="pt").input_ids,
        0.0,
        target_sizes=[rgb.shape[:2]],
    )[0]
    boxes = np.clip(theirs["boxes"].numpy(), 0, (160, 120, 160, 120))
    assert len(found) > 1
    for box, score in zip(found.xyxy, found.score, strict=True):
        match = np.abs(boxes - box).max(axis=1).argmin()
        assert np.allclose(boxes[match], box, atol=1e-3)
        assert theirs["scores"][match].item() == pytest.approx(score, abs=1e-6)


@pytest.mark.parametrize("name", ["dinov3-small", "siglip2-base"])
@pytest.mark.parametrize("side", [224, 180])
def test_every_encoder_sees_what_its_published_processor_makes_of_a_square(
    store: Path, name: str, side: int
) -> None:
    import transformers as hf

    published = {
        "dinov3-small": lambda: hf.DINOv3ViTImageProcessor(),
        "siglip2-base": lambda: hf.SiglipImageProcessor(size={"height": 224, "width": 224}),
    }[name]()
    encoder, crop = part(store, encoder=name), blurred(1, side, side)
    given: list[torch.Tensor] = []
    hook = encoder.model.register_forward_pre_hook(lambda net, args: given.append(args[0]))
    encoder([crop])
    hook.remove()
    theirs = published(images=torch.from_numpy(crop).permute(2, 0, 1), return_tensors="pt")
    one_level = 1 / 255 / min(encoder.recipe.std)
    difference = (given[0] - theirs["pixel_values"]).abs()
    assert difference.max() <= 3 * one_level, "torchvision and Pillow round differently"
    assert difference.mean() <= 0.6 * one_level


def test_the_row_is_the_models_own_feature(store: Path) -> None:
    crop = blurred(4, 224, 224)
    for name, read in (
        ("dinov3-small", lambda out: out.last_hidden_state[:, 0]),
        ("siglip2-base", lambda out: out.pooler_output),
    ):
        encoder, given = part(store, encoder=name), []
        hook = encoder.model.register_forward_hook(lambda net, args, out, kept=given: kept.append(out))  # fmt: skip
        (row,) = encoder([crop])
        hook.remove()
        feature = read(given[0])[0].numpy()
        assert np.allclose(row, feature / np.linalg.norm(feature), atol=1e-5)
        assert encoder.name.startswith(f"{name}-"), "rows of other weights are never compared"


def test_parts_mix_freely_and_thresholds_belong_to_detector_and_encoder(here: Path) -> None:
    embedded = load_stack("embedded")
    both = load_stack(mixed("embedded", detector="llmdet-tiny", encoder="siglip2-base"))
    assert isinstance(both.detector, JudgedDetector), "the embedded segmenter tells photos apart"
    assert (type(both.detector.detector).__name__, type(both.encoder).__name__) == ("GroundingDino", "CropEncoder")  # fmt: skip
    assert type(both.tracker) is type(embedded.tracker)
    assert both.unfamiliar_encoder is None
    assert both.category_detector is both.detector
    assert both.thresholds is None
    name = mixed("embedded", encoder="dinov3-small")
    one = load_stack(name)
    assert one.by_category is not None
    assert one.verifier is None
    assert one.thresholds is None
    keep_thresholds(here, name, one.encoder.name, Thresholds(0.4, 0.5))
    assert load_stack(name).thresholds == Thresholds(0.4, 0.5)
    assert load_stack(mixed("foundation", detector="embedded", encoder="embedded", tracker="embedded")).thresholds == EMBEDDED_THRESHOLDS  # fmt: skip


def test_names_of_mixed_stacks() -> None:
    assert mixed("embedded") == mixed("embedded", encoder="") == "embedded"
    name = mixed("foundation", detector="llmdet-base", tracker="embedded")
    assert name == "foundation:detector=llmdet-base,tracker=embedded"
    assert parts_of(name) == {"detector": "llmdet-base", "encoder": "dinov2-base", "tracker": "embedded"}  # fmt: skip
    assert models_of(name) == ("llmdet-base", "dinov2-base")
    check_stack(name)
    for wrong, words in (
        (
            "embedded:encoder=resnet",
            "encoder 'resnet' is unknown; known: dinov2-base, dinov2-small, dinov3-small",
        ),
        ("embedded:eye=dinov2-small", "part of a mixed stack 'eye' is unknown; known: detector"),
        ("fast:encoder=dinov2-small", "base of a mixed stack 'fast' is unknown"),
        ("embedded:encoder", "encoder 'nothing' is unknown"),
        ("fast", "stack 'fast' is unknown; known: embedded"),
    ):
        with pytest.raises(UnknownName, match=words):
            check_stack(wrong)


def test_an_option_says_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VAP_WEIGHTS", str(tmp_path))
    with pytest.raises(
        MissingWeights, match=r"weights pull --stack embedded:encoder=dinov3-small --unpinned"
    ):
        load_stack("embedded:encoder=dinov3-small")
    with pytest.raises(
        MissingWeights,
        match=r"no checksum of dinov3-small .* pass --unpinned .*first accept Meta's DINOv3 licence",
    ):
        pull(["dinov3-small"], tmp_path)
    table = weights_table(tmp_path)
    options = {name for models in PARTS.values() for name in models} - {name for kind in KINDS.values() for name in kind}  # fmt: skip
    for name in options:
        assert f"={name} " in table


def test_the_page_says_of_every_option_what_it_needs() -> None:
    rows: dict[tuple[str, str], str] = {}
    role = ""
    for line in (ROOT / "docs" / "perception.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 4 and cells[1].startswith("`"):
            role = cells[0].partition(",")[0] or role
            rows |= {(role, name): cells[3] for name in re.findall(r"`([\w.-]+)`", cells[1])}
    assert set(rows) == {(role, name) for role, names in PARTS.items() for name in names}
    for (_, name), needs in rows.items():
        assert (needs == "pinned") == bool(MODELS[name].sha256), name
        assert ("--unpinned" in needs) == (not MODELS[name].sha256), name
        assert ("licence" in needs) == ("licence" in MODELS[name].needs), name


def test_a_branch_is_found_in_a_hub_cache_by_its_commit(store: Path, tmp_path: Path) -> None:
    source = MODELS["siglip2-base"]
    cache = tmp_path / f"models--{source.folder}"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text("abc123")
    (cache / "snapshots").mkdir()
    (cache / "snapshots" / "abc123").symlink_to(store / source.folder)
    pull(
        ["siglip2-base"], tmp_path / "store", origin=tmp_path, unpinned=True, say=lambda line: None
    )
    assert (tmp_path / "store" / source.folder / "lock.json").is_file()


def test_the_pad_is_the_colour_that_normalises_to_zero() -> None:
    assert crops.DINO.grey == crops.DINOV3.grey == (124, 116, 104)
    assert crops.SIGLIP.grey == (128, 128, 128)
