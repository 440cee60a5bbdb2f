"""The policy that a training goes on from, instead of beginning with nothing.

    start = read_start(start_folder("mini-pi0-tabletop-longer"), teacher, seed=0)
    require_alike(start, config)

It has to look and act as the recipe says, and to have grown from the same mini-PaliGemma. Where
learned words are taught, its words' embeddings have to be that model's still.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from safetensors.torch import load_file
from torch import Tensor

from vap_core.base.errors import BadPolicy, first_line
from vap_core.base.files import check_regular
from vap_core.policies.lerobot.checkpoints import CONFIG, PIPELINES, WEIGHTS, refuse_code
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.vlm import MiniVlm
from vap_core.policies.names import SHIPPED
from vap_make.policy.losses import Learner, embedding_cosine

SCALES = "policy_preprocessor_step_4_normalizer_processor.safetensors"
"""The file in which lerobot keeps a policy's statistics."""
ALIKE = 0.99
"""Mean cosine of embeddings above which a word means the same to two models.

A policy that moved its words has 0.78 to 0.89, one that kept them 1.000.
"""

SIZES = ("image_resolution", "patch", "width", "depth", "head_dim", "vision_width", "vision_depth")


@dataclass(frozen=True)
class Start:
    """The policy in a folder, and how its processors scale states and actions."""

    folder: Path
    learner: Learner
    stats: dict[str, dict[str, Tensor]]


def start_folder(start: str) -> Path:
    """The folder of the shipped policy with this name, or the folder that it names."""
    shipped = SHIPPED / start
    return shipped if shipped.is_dir() else Path(start)


def read_start(folder: Path, teacher: MiniVlm | None, seed: int) -> Start:
    """The policy of a folder; the questions beside it begin with weights of the seed.

    Raises: BadPolicy when it can't be read, or did not grow from the `teacher`.
    """
    from lerobot.configs import PreTrainedConfig

    torch.manual_seed(seed)
    try:
        for name in (CONFIG, WEIGHTS, *PIPELINES):
            check_regular(folder / name)
        refuse_code(folder)
        config = cast(MiniPI0Config, PreTrainedConfig.from_pretrained(folder))
        learner = Learner(config)
        learner.policy.load_state_dict(load_file(folder / "model.safetensors"))
        kept = load_file(folder / SCALES)
        stats: dict[str, dict[str, Tensor]] = {}
        for name in ("observation.state", "action"):
            stats[name] = {part: kept[f"{name}.{part}"] for part in ("mean", "std")}
    except BadPolicy:
        raise
    except Exception as error:
        raise BadPolicy(
            f"train policy: {folder} is no mini-pi0 to go on from ({type(error).__name__}: "
            f"{first_line(error):.120}); name a checkpoint's folder, or get the repository's "
            "data/policies again: git checkout data/policies"
        ) from error
    if teacher is not None and config.vlm != teacher.sha256():
        raise BadPolicy(
            f"train policy: {folder} did not grow from this mini-PaliGemma; name the one that it "
            "grew from with --vlm, or leave it out to teach no learned word."
        )
    return Start(folder, learner, stats)


def require_shared_words(start: Start, teacher: MiniVlm) -> None:
    """Raises: BadPolicy when a word learned in the `teacher` would mean something else to the
    policy, whose own training moved the embeddings of words.
    """
    mean = embedding_cosine(start.learner.policy, teacher)["mean"]
    if mean < ALIKE:
        raise BadPolicy(
            f"train policy: the words of {start.folder} are no longer those of the mini-PaliGemma "
            f"that it grew from (mean cosine {mean:.2f}, least allowed {ALIKE}), so that a word "
            "learned there means nothing to it; leave out --vlm to teach no learned word."
        )


def sizes_of(start: Start) -> tuple[int, int]:
    """How many numbers its state and its action have."""
    config = start.learner.policy.config
    return config.max_state_dim, config.max_action_dim


def require_alike(start: Start, wanted: MiniPI0Config) -> None:
    """Raises: BadPolicy when the policy does not look and act as in `wanted`."""
    config = start.learner.policy.config
    for name in ("input_features", "output_features", "chunk_size", "width", "words"):
        if getattr(config, name) != getattr(wanted, name):
            raise BadPolicy(
                f"train policy: {start.folder} differs from the recipe in {name}; go on from a "
                "policy of the same suite, or leave out --start."
            )


def initialise_policy(vlm: MiniVlm, policy: Any) -> None:
    """Start a policy's image tower, decoder and words from the model's.

    Raises: BadPolicy when words or sizes differ.
    """
    for name in ("words", *SIZES):
        if getattr(policy.config, name) != getattr(vlm.config, name):
            raise BadPolicy(
                f"vlm.initialise_policy: policy and mini-PaliGemma differ in {name}; make the "
                "model again: python -m vap_core train vlm"
            )
    paligemma = policy.model.paligemma_with_expert.paligemma
    paligemma.load_state_dict(vlm.towers.paligemma.state_dict())
