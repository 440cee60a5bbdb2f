"""From folders of weights, or from published sizes with random ones, to the four models."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from vap_core.errors import MissingWeights
from vap_core.foundation import Parts
from vap_core.foundation.dino import SIDE, Dino
from vap_core.foundation.grounding import GroundingDino
from vap_core.foundation.runtime import Runtime
from vap_core.foundation.sam import MEAN, STD, Sam, SamSegmenter
from vap_core.foundation.video import SamTracker
from vap_core.hub import KINDS, Weights

SWIN: dict[str, dict[str, Any]] = {
    "grounding-dino-base": {"embed_dim": 128, "depths": [2, 2, 18, 2], "num_heads": [4, 8, 16, 32], "window_size": 12, "image_size": 384},
    "grounding-dino-tiny": {"embed_dim": 96, "depths": [2, 2, 6, 2], "num_heads": [3, 6, 12, 24], "window_size": 7, "image_size": 224},
}
VIT: dict[str, dict[str, Any]] = {
    "dinov2-base": {"hidden_size": 768, "num_attention_heads": 12},
    "dinov2-small": {"hidden_size": 384, "num_attention_heads": 6},
}
HIERA: dict[str, dict[str, Any]] = {
    "sam2.1-hiera-large": {
        "hidden_size": 144,
        "num_attention_heads": 2,
        "blocks_per_stage": [2, 6, 36, 4],
        "embed_dim_per_stage": [144, 288, 576, 1152],
        "num_attention_heads_per_stage": [2, 4, 8, 16],
        "window_size_per_stage": [8, 4, 16, 8],
        "global_attention_blocks": [23, 33, 43],
    },
    "sam2.1-hiera-tiny": {},
}


@dataclass(frozen=True)
class Networks:
    """transformers' models of one stack, on the CPU; `encoder_name` is stored with every memory."""

    detector: Any
    tokenizer: Any
    encoder: Any
    encoder_name: str
    sam: Any


def assemble(nets: Networks, runtime: Runtime) -> Parts:
    """Put the adapters around the networks, with the pre-processing that they were trained with."""
    from transformers.models.bit.image_processing_pil_bit import BitImageProcessorPil
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil

    looks = BitImageProcessorPil(
        size={"height": SIDE, "width": SIDE}, do_center_crop=False, image_mean=list(MEAN), image_std=list(STD)
    )  # the published 256 -> 224 centre crop would cut the ends off what `square` has just kept
    sam = Sam(nets.sam, runtime)
    return Parts(
        GroundingDino(nets.detector, nets.tokenizer, GroundingDinoImageProcessorPil(), runtime),
        Dino(nets.encoder, looks, nets.encoder_name, runtime),
        SamSegmenter(sam),
        SamTracker(sam),
    )


def read(detector: Weights, encoder: Weights, sam: Weights) -> Networks:
    """Networks from verified folders; safetensors and JSON only, and no code from them.

    Raises:
        MissingWeights: a file that transformers cannot make sense of.
    """
    from transformers import AutoTokenizer, Dinov2Model, GroundingDinoForObjectDetection, Sam2VideoModel

    def network(cls: Any, weights: Weights) -> Any:
        try:
            net, told = cls.from_pretrained(
                weights.folder, local_files_only=True, use_safetensors=True, dtype=torch.float32, output_loading_info=True
            )
        except (OSError, ValueError, RuntimeError, KeyError) as error:
            raise MissingWeights(f"foundation: {weights.folder} cannot be read as {cls.__name__} ({_line(error)}); pull it again.") from error
        if told["missing_keys"]:
            missing = sorted(told["missing_keys"])
            raise MissingWeights(f"foundation: {weights.folder} lacks {len(missing)} tensors of {cls.__name__}, such as {missing[0]}; pull it again.")
        return net

    with quiet():
        tokenizer = AutoTokenizer.from_pretrained(detector.folder, local_files_only=True)
        return Networks(
            network(GroundingDinoForObjectDetection, detector),
            tokenizer,
            network(Dinov2Model, encoder),
            encoder.identity,
            network(Sam2VideoModel, sam),
        )


def invent(kind: str, seed: int = 0) -> Networks:
    """Random networks of the published sizes; the tokenizer knows single letters only."""
    import transformers

    hf: Any = transformers  # its configurations take more than they declare
    detector, encoder, sam = KINDS[kind]
    hiera = hf.Sam2HieraDetConfig(**HIERA[sam])
    vision = hf.Sam2VisionConfig(backbone_config=hiera, backbone_channel_list=hiera.embed_dim_per_stage[::-1])
    swin = hf.SwinConfig(**SWIN[detector], out_indices=[2, 3, 4])
    with quiet(), torch.random.fork_rng():
        torch.manual_seed(seed)
        return Networks(
            hf.GroundingDinoForObjectDetection(hf.GroundingDinoConfig(backbone_config=swin)),
            letters(),
            hf.Dinov2Model(hf.Dinov2Config(**VIT[encoder], image_size=518)),
            f"{encoder}-random",
            hf.Sam2VideoModel(hf.Sam2VideoConfig(vision_config=vision)),
        )


def letters() -> Any:
    """A BERT tokenizer of a few dozen words, with the special tokens where bert-base-uncased has them."""
    from transformers import BertTokenizer

    special = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
    words = {special.get(i, f"[unused{i}]"): i for i in range(1030)}
    for i, letter in enumerate("abcdefghijklmnopqrstuvwxyz"):
        for j, word in enumerate((letter, f"##{letter}")):
            del words[f"[unused{200 + 2 * i + j}]"]
            words[word] = 200 + 2 * i + j
    return BertTokenizer(vocab=words)


@contextmanager
def quiet() -> Iterator[None]:
    """Without transformers' progress bars and notes while networks are made."""
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
