"""A mini-PaliGemma by itself: it reads views and questions, and answers in words. A mini-pi0 grows from it; a token is learned in it (SPEC 4)."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Bool, Float, Int64
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from vap_core.base.errors import BadPolicy
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniTowers
from vap_core.policies.mini_pi0.processor_mini_pi0 import END, encode

ANSWER = 3
"""Words of the longest answer, END included."""
WEIGHTS = "vlm.safetensors"
SIZES = ("image_resolution", "patch", "width", "depth", "head_dim", "vision_width", "vision_depth")


class MiniVlm(nn.Module):
    """Image patches and a question, read in both directions, then an answer word by word, as PaliGemma does it."""

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.config, self.towers = config, MiniTowers(config)
        self.towers.gemma_expert = None
        self.towers.paligemma.model.language_model.config._attn_implementation = "eager"
        self.number = {word: i for i, word in enumerate(config.words)}

    def look(self, images: Float[Tensor, "b 3 s s"]) -> Float[Tensor, "b p d"]:
        """Patch features of views with values in 0..1."""
        return self.towers.embed_image(images * 2 - 1)

    def forward(
        self,
        patches: Float[Tensor, "q p d"],
        tokens: Int64[Tensor, "q l"],
        there: Bool[Tensor, "q l"],
        answers: Int64[Tensor, "q a"],
    ) -> tuple[Float[Tensor, "q a w"], Float[Tensor, "q p d"]]:
        """Scores of every word at every place of the answer, given the words before it; and the penultimate layer's states of the patches."""
        return self.read(patches, self.towers.embed_language_tokens(tokens), there, answers)

    def read(
        self,
        patches: Float[Tensor, "q p d"],
        words: Float[Tensor, "q l d"],
        there: Bool[Tensor, "q l"],
        answers: Int64[Tensor, "q a"],
    ) -> tuple[Float[Tensor, "q a w"], Float[Tensor, "q p d"]]:
        """`forward` with the question's words embedded already."""
        from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

        length, start, before = patches.shape[1], patches.shape[1] + words.shape[1], answers[:, :-1]
        pad = torch.cat(
            [
                torch.ones_like(patches[..., 0], dtype=torch.bool),
                there,
                torch.ones_like(before, dtype=torch.bool),
            ],
            1,
        )
        causal = torch.zeros_like(pad)
        causal[:, start:] = True
        out = self.towers.paligemma.model.language_model(
            inputs_embeds=torch.cat([patches, words, self.towers.embed_language_tokens(before)], 1),
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(pad, causal)), position_ids=torch.cumsum(pad, dim=1) - 1,
            use_cache=False, output_hidden_states=True,
        )  # fmt: skip
        last = length + there.sum(1, keepdim=True) - 1
        places = torch.cat([last, start + torch.arange(before.shape[1]).expand(len(words), -1)], 1)
        states = out.last_hidden_state.gather(1, places[..., None].expand(-1, -1, patches.shape[2]))
        return self.towers.paligemma.lm_head(states), out.hidden_states[-2][:, :length]

    @torch.inference_mode()
    def answer(
        self, images: Float[Tensor, "b 3 s s"], questions: Sequence[str]
    ) -> list[tuple[str, ...]]:
        """One question per view, answered greedily."""
        patches, (tokens, there) = self.look(images), self.ask(questions)
        said = torch.zeros((len(questions), ANSWER), dtype=torch.long)
        for i in range(ANSWER):
            said[:, i] = self(patches, tokens, there, said)[0][:, i].argmax(-1)
        words = [[self.config.words[int(token)] for token in row] for row in said]
        return [tuple(row[: row.index(END)] if END in row else row) for row in words]

    def ask(self, questions: Sequence[str]) -> tuple[Int64[Tensor, "q l"], Bool[Tensor, "q l"]]:
        """Tokens of questions, and where there are any."""
        return encode(list(questions), self.number, self.config.tokenizer_max_length)

    def sha256(self) -> str:
        """Checksum of all weights as they stand."""
        found = hashlib.sha256()
        for name, tensor in sorted(self.towers.state_dict().items()):
            found.update(name.encode() + tensor.detach().contiguous().numpy().tobytes())
        return found.hexdigest()

    def save(self, folder: Path) -> None:
        """Write `folder`: sizes and words as config.json, weights as safetensors in bfloat16."""
        folder.mkdir(parents=True, exist_ok=True)
        self.config.save_pretrained(folder)
        save_file(
            {name: tensor.contiguous() for name, tensor in self.towers.state_dict().items()},
            folder / WEIGHTS,
        )
        halve(folder / WEIGHTS)


def load(folder: Path) -> MiniVlm:
    """The frozen model that `save` wrote. Raises: BadPolicy."""
    if not (folder / WEIGHTS).is_file():
        raise BadPolicy(
            f"vlm.load: {folder} holds no mini-PaliGemma ({WEIGHTS}); make one: python -m vap_core train vlm"
        )
    try:
        vlm = MiniVlm(cast(MiniPI0Config, PreTrainedConfig.from_pretrained(folder)))
        vlm.towers.load_state_dict(load_file(folder / WEIGHTS))
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise BadPolicy(
            f"vlm.load: {folder} is damaged ({type(error).__name__}: {reason:.150}); run: python -m vap_core train vlm"
        ) from error
    return vlm.eval().requires_grad_(False)


def halve(file: Path) -> None:
    """Keep a file's tensors in bfloat16; a model that loads them computes in its own precision."""
    save_file(
        {name: tensor.bfloat16() for name, tensor in load_file(file).items()},
        file,
        metadata={"format": "pt"},
    )


def grow(vlm: MiniVlm, policy: Any) -> None:
    """Start a policy's image tower, decoder and words from the model's. Raises: BadPolicy when words or sizes differ."""
    for name in ("words", *SIZES):
        if getattr(policy.config, name) != getattr(vlm.config, name):
            raise BadPolicy(
                f"vlm.grow: policy and mini-PaliGemma differ in {name}; make the model again: python -m vap_core train vlm"
            )
    policy.model.paligemma_with_expert.paligemma.load_state_dict(vlm.towers.paligemma.state_dict())
