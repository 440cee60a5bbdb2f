"""Train a mini-PaliGemma on questions about rendered views of generic objects, before any policy grows from it (P 5.1, SPEC section 4).

    python -m vap_core train vlm --out data/runs/mini-paligemma

The answers' words are its loss, and, while training only, which patches show the object that is meant, asked of the penultimate layer.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.base.files import DATA
from vap_core.base.types import Rgb, value
from vap_core.evaluation.processes import results
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused
from vap_core.policies.mini_pi0.vlm import ANSWER, MiniVlm, load
from vap_core.training.films.demonstrations import SIDE, small
from vap_core.training.films.scenes import Shots, cached
from vap_core.training.looking import Shown, Sizes, looking, shares
from vap_core.training.step import Descent, Told, average_of, descend
from vap_core.training.vlm.questions import Question, ask

CACHE = DATA / "cache" / "perception"
"""The same scenes as perception's; what is there is not rendered again."""
SEEN = 0.5
"""Weight of the patches beside the words."""
KINDS = ("where", "yes", "no", "colour")
HELD_OUT = 30
"""Stages with unseen objects that the result is measured on."""


@dataclass(frozen=True)
class Recipe(Sizes):
    """How long, how fast, how large. `questions` are asked of each of `batch` views."""

    stages: int = 540
    steps: int = 1600
    batch: int = 64
    questions: int = 2
    rate: float = 1e-3
    seed: int = 0


@value
class View:
    """A rendered view, and i + 1 wherever names[i] is seen."""

    image: UInt8[np.ndarray, "s s 3"]
    ids: UInt8[np.ndarray, "s s"]
    names: tuple[str, ...]


@dataclass
class Batch:
    """Views (b x 3 x s x s in 0..1), the questions of each in turn (q), answers (q x ANSWER tokens; 0 counts nothing), patches (q x p)."""

    images: Tensor
    questions: list[Question]
    answers: Tensor
    patches: Tensor


class Learner(nn.Module):
    """What is trained: the model, and the question beside it."""

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.vlm, self.shown = MiniVlm(config), Shown(config.width)


def configuration(recipe: Recipe) -> MiniPI0Config:
    return MiniPI0Config(**recipe.configuration())


def views(
    stages: int, seed: int, cache: Path, *, held_out: bool = False, jobs: int = 2
) -> list[View]:
    """Views and every other portrait of so many stages, scaled down; rendered in processes where they are missing."""
    from tqdm import tqdm

    kind = "held" if held_out else "train"
    missing = [n for n in range(stages) if not (cache / f"{kind}-{seed}-{n:05d}.npz").exists()]
    if missing:
        list(
            tqdm(
                results(partial(_render, cache, seed, held_out), missing, jobs, "jobs"),
                "scenes",
                len(missing),
                mininterval=10,
            )
        )
    found = []
    for n in range(stages):
        shots = cached(cache, seed, n, held_out=held_out)
        found += [_view(rgb, ids, shots) for rgb, ids in zip(shots.rgb, shots.ids, strict=True)]
        found += [
            _view(rgb, ids, shots)
            for rgb, ids in zip(shots.portraits[::2], shots.portrait_ids[::2], strict=True)
        ]
    return found


def _view(rgb: Rgb, ids: UInt8[np.ndarray, "h w"], shots: Shots) -> View:
    return View(
        small(rgb), cv2.resize(ids, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), shots.names
    )


def _render(cache: Path, seed: int, held_out: bool, number: int) -> None:
    cached(cache, seed, number, held_out=held_out)


def collate(
    recipe: Recipe,
    pool: Sequence[View],
    number: dict[str, int],
    rng: np.random.Generator,
    config: MiniPI0Config,
) -> Batch:
    """One batch: views drawn anew, coloured anew, with questions of their own."""
    images, questions, shown = [], [], []
    for i in rng.integers(len(pool), size=recipe.batch):
        view = pool[i]
        asked = ask(view.image, view.ids, view.names, recipe.questions, rng)
        images.append(asked.image)
        for question in asked.questions:
            questions.append(question)
            meant = (view.ids == question.target + 1) & (question.target >= 0)
            shown.append(shares(meant, config.patch))
    answers = torch.zeros((len(questions), ANSWER), dtype=torch.long)
    for row, question in zip(answers, questions, strict=True):
        if question.answer:
            said = [number[word] for word in (*question.answer, "\n")]
            row[: len(said)] = torch.tensor(said)
    pictures = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    return Batch(pictures, questions, answers, torch.from_numpy(np.stack(shown)).float())


def losses(learner: Learner, batch: Batch) -> tuple[Tensor, Told]:
    """Cross-entropy of the answers' words and of the patches; shares of right answers by kind of question (NaN: none was asked)."""
    vlm = learner.vlm
    tokens, there = vlm.ask([question.text for question in batch.questions])
    patches = vlm.look(batch.images).repeat_interleave(len(batch.questions) // len(batch.images), 0)
    scores, hidden = vlm(patches, tokens, there, batch.answers)
    words = F.cross_entropy(scores.flatten(0, 1), batch.answers.flatten(), ignore_index=0)
    heat, hit = looking(learner.shown(hidden), batch.patches)
    right = ((scores.argmax(-1) == batch.answers) | (batch.answers == 0)).all(1)
    kinds = [_kind(question) for question in batch.questions]
    told = {
        kind: _share([bool(good) for good, each in zip(right, kinds, strict=True) if each == kind])
        for kind in KINDS
    }
    return words + SEEN * heat, {
        "words": float(words.detach()),
        "heat": float(heat.detach()),
        "hit": float(hit),
        **told,
    }


def _kind(question: Question) -> str:
    """What was asked, and, of yes and no, what is right: a model that always says the same is half right at most."""
    if not question.answer:
        return ""
    return {"where": "where", "what": "colour"}.get(question.text.split()[0], question.answer[0])


def _share(good: list[bool]) -> float:
    return float(np.mean(good)) if good else float("nan")


def train(
    recipe: Recipe, out: Path, *, minutes: float | None = None, cache: Path = CACHE, jobs: int = 2
) -> dict[str, Any]:
    """Train, or go on where an earlier call stopped; write the model and what was measured on unseen objects."""
    pool, config = views(recipe.stages, recipe.seed, cache, jobs=jobs), configuration(recipe)
    torch.manual_seed(
        recipe.seed
    )  # initial weights only; every other draw comes from the step's stream
    learner = Learner(config)
    number = learner.vlm.number

    def step(model: Learner, at: int) -> tuple[Tensor, Told]:
        with fused():
            return losses(
                model,
                collate(recipe, pool, number, np.random.default_rng([75, recipe.seed, at]), config),
            )

    mean, log = descend(
        learner,
        step,
        Descent(
            "mini-paligemma",
            recipe.steps,
            recipe.rate,
            minutes,
            made_of={"recipe": vars(recipe), "words": config.words},
        ),
        out,
    )
    held = views(min(HELD_OUT, recipe.stages), recipe.seed, cache, held_out=True, jobs=jobs)
    mean.vlm.save(out)
    mean.vlm = load(out)  # what is measured is what was saved
    with torch.no_grad():
        told = [
            losses(mean, collate(recipe, held, number, np.random.default_rng([76, i]), config))[1]
            for i in range(16)
        ]
    about = {"recipe": vars(recipe), "held_out": average_of(told), "log": log}
    (out / "training.json").write_text(json.dumps(about, indent=1))
    return about
