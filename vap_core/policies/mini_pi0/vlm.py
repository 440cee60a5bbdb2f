"""A mini-PaliGemma by itself: it reads views and questions, and answers in words.

A mini-pi0 is initialised from it; a token is learned in it (SPEC section 4).
"""

from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Bool, Float, Int64
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file, save
from torch import Tensor, nn

from vap_core.base.errors import BadPolicy, first_line
from vap_core.base.files import write_atomic
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniTowers
from vap_core.policies.mini_pi0.processor_mini_pi0 import END, encode, vocabulary
from vap_core.policies.protocol import state_sha256

ANSWER = 3
"""Words of the longest answer, END included."""
WEIGHTS = "vlm.safetensors"
IN_POLICY = "model.paligemma_with_expert.paligemma."
"""What precedes the names of its weights in a policy's file."""


class MiniVlm(nn.Module):
    """Reads image patches and a question, then answers word by word, as PaliGemma does it.

    Attention goes in both directions among patches and question.
    """

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.config = config
        self.towers = MiniTowers(config)
        self.towers.gemma_expert = None
        self.towers.paligemma.model.language_model.config._attn_implementation = "eager"
        self.vocabulary = vocabulary(config.words)

    def embed_images(self, images: Float[Tensor, "b 3 s s"]) -> Float[Tensor, "b p d"]:
        """Patch features of views with values in 0..1."""
        return self.towers.embed_image(images * 2 - 1)

    def forward(
        self,
        patches: Float[Tensor, "q p d"],
        tokens: Int64[Tensor, "q l"],
        mask: Bool[Tensor, "q l"],
        answers: Int64[Tensor, "q a"],
    ) -> tuple[Float[Tensor, "q a w"], Float[Tensor, "q p d"]]:
        """Scores of every word at every place of the answer, given the words before it.

        The second result is the penultimate layer's states of the patches. `mask` tells tokens of
        the question from padding.
        """
        return self.read(patches, self.towers.embed_language_tokens(tokens), mask, answers)

    def read(
        self,
        patches: Float[Tensor, "q p d"],
        words: Float[Tensor, "q l d"],
        mask: Bool[Tensor, "q l"],
        answers: Int64[Tensor, "q a"],
    ) -> tuple[Float[Tensor, "q a w"], Float[Tensor, "q p d"]]:
        """`forward` with the question's words embedded already."""
        from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

        n_patches = patches.shape[1]
        start = n_patches + words.shape[1]
        given = answers[:, :-1]
        all_patches = torch.ones_like(patches[..., 0], dtype=torch.bool)
        present = torch.cat([all_patches, mask, torch.ones_like(given, dtype=torch.bool)], 1)
        causal = torch.zeros_like(present)
        causal[:, start:] = True
        attention = prepare_attention_masks_4d(make_att_2d_masks(present, causal))
        embedded = torch.cat([patches, words, self.towers.embed_language_tokens(given)], 1)
        output = self.towers.paligemma.model.language_model(
            inputs_embeds=embedded,
            attention_mask=attention,
            position_ids=torch.cumsum(present, dim=1) - 1,
            use_cache=False,
            output_hidden_states=True,
        )
        last_of_question = n_patches + mask.sum(1, keepdim=True) - 1
        of_given = start + torch.arange(given.shape[1]).expand(len(words), -1)
        places = torch.cat([last_of_question, of_given], 1)
        places = places[..., None].expand(-1, -1, patches.shape[2])
        states = output.last_hidden_state.gather(1, places)
        return self.towers.paligemma.lm_head(states), output.hidden_states[-2][:, :n_patches]

    @torch.inference_mode()
    def answer(
        self, images: Float[Tensor, "b 3 s s"], questions: Sequence[str]
    ) -> list[tuple[str, ...]]:
        """One question per view, answered greedily."""
        patches = self.embed_images(images)
        tokens, mask = self.tokenize(questions)
        answers = torch.zeros((len(questions), ANSWER), dtype=torch.long)
        for i in range(ANSWER):
            scores, _ = self(patches, tokens, mask, answers)
            answers[:, i] = scores[:, i].argmax(-1)
        words = [[self.config.words[int(token)] for token in answer] for answer in answers]
        return [tuple(takewhile(lambda word: word != END, answer)) for answer in words]

    def tokenize(
        self, questions: Sequence[str]
    ) -> tuple[Int64[Tensor, "q l"], Bool[Tensor, "q l"]]:
        """Tokens of questions, and a mask of those that do not pad them."""
        return encode(list(questions), self.vocabulary, self.config.tokenizer_max_length)

    def sha256(self) -> str:
        """Checksum of all weights as they stand."""
        return state_sha256(self.towers)

    def save(self, folder: Path) -> None:
        """Write `folder`: sizes and words as config.json, weights as safetensors in bfloat16."""
        folder.mkdir(parents=True, exist_ok=True)
        self.config.save_pretrained(folder)
        _write_bfloat16(self.towers.state_dict(), folder / WEIGHTS)


def load_vlm(folder: Path) -> MiniVlm:
    """The frozen model that `save` wrote. Raises: BadPolicy."""
    if not (folder / WEIGHTS).is_file():
        raise BadPolicy(
            f"load_vlm: {folder} holds no mini-PaliGemma ({WEIGHTS}); make one: ./vap train vlm"
        )
    try:
        vlm = MiniVlm(cast(MiniPI0Config, PreTrainedConfig.from_pretrained(folder)))
        vlm.towers.load_state_dict(load_file(folder / WEIGHTS))
    except BadPolicy:  # it says its own remedy
        raise
    except Exception as error:
        raise BadPolicy(
            f"load_vlm: {folder} is damaged ({type(error).__name__}: {first_line(error):.150}); "
            "run: ./vap train vlm"
        ) from error
    return vlm.eval().requires_grad_(False)


def load_from_policy(folder: Path) -> MiniVlm:
    """The frozen model inside a mini-pi0's checkpoint, with the policy's own weights.

    Its language head is as it was in the model that the policy was initialised from: acting gives
    it no gradient.

    Raises: BadPolicy.
    """
    try:
        vlm = MiniVlm(cast(MiniPI0Config, PreTrainedConfig.from_pretrained(folder)))
        weights = {
            name.removeprefix(IN_POLICY): tensor
            for name, tensor in load_file(folder / "model.safetensors").items()
            if name.startswith(IN_POLICY)
        }
        vlm.towers.paligemma.load_state_dict(weights)
    except BadPolicy:  # it says its own remedy
        raise
    except Exception as error:
        raise BadPolicy(
            f"load_from_policy: {folder} is no mini-pi0 ({type(error).__name__}: "
            f"{first_line(error):.120}); leave soft-own out, or give one: "
            "./vap train policy"
        ) from error
    return vlm.eval().requires_grad_(False)


def store_in_bfloat16(file: Path) -> None:
    """Keep a file's tensors in bfloat16; a model that loads them computes in its own precision."""
    _write_bfloat16(load_file(file), file)


def _write_bfloat16(tensors: Mapping[str, Tensor], file: Path) -> None:
    halves = {name: tensor.bfloat16().contiguous() for name, tensor in tensors.items()}
    write_atomic(file, save(halves, metadata={"format": "pt"}))
