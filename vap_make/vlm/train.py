"""Train a mini-PaliGemma on questions about rendered views (P 5.1, SPEC section 4).

    ./vap train vlm --out data/runs/mini-paligemma

The views show generic objects; policies grow from the model. Its loss is of the answers' words and,
in training only, of the patches that show the object meant, asked of the penultimate layer.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.base.files import make_folder, parse_json, write_atomic, writing
from vap_core.base.types import Description, Rgb, value
from vap_core.policies.lerobot.checkpoints import CAPTIONS, TRAINING_CARD
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused_attention
from vap_core.policies.mini_pi0.vlm import ANSWER, MiniVlm, load_vlm
from vap_core.simulation.assets.objects import get_object
from vap_core.study.workers import results
from vap_make.films.captions import captions
from vap_make.films.demonstrations import SIDE, small
from vap_make.films.looks import draw_look
from vap_make.films.scenes import CACHE, Shots, cached, only_generic, stage_file
from vap_make.folder import cost_s, reading_kept, training_folder
from vap_make.patches import PatchScores, model_options, patch_loss, patch_shares
from vap_make.recipe import Sizes
from vap_make.step import Figures, Schedule, average_of, train_steps
from vap_make.vlm.questions import Question, ask

SCENES = "dyed-scenes"
SEEN = 0.5
"""Weight of the patches beside the words."""
OWN_STD, FASTER = 0.2, 30.0
"""Deviation of the objects' own words to begin with, and how much faster they are learned: each is
asked for in few batches."""
KINDS = ("own", "where", "yes", "no", "colour")
HELD_OUT = 30
"""Stages with unseen objects that the result is measured on."""
HELD_OUT_BATCHES = 16
"""Batches of questions about them."""


@dataclass(frozen=True)
class Recipe(Sizes):
    """How long, how fast, how large. `questions` are asked of each of `batch` views.

    `own` is the share of those about one of several look-alikes, by a word of its own.
    """

    stages: int = 320
    steps: int = 2400
    batch: int = 64
    questions: int = 2
    own: float = 0.3
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
    """Views, questions, answers and patches.

    Views are b x 3 x s x s in 0..1; the questions of each view follow each other (q in all);
    answers are q x ANSWER tokens, of which 0 does not count; patches are q x p. `instances` are q
    numbers of objects that have a word of their own in their question, else -1.
    """

    images: Tensor
    questions: list[Question]
    answers: Tensor
    patches: Tensor
    instances: Tensor


class Learner(nn.Module):
    """What is trained: the model, the score of its patches, and a word for each of `n` objects."""

    def __init__(self, config: MiniPI0Config, n: int) -> None:
        super().__init__()
        self.vlm = MiniVlm(config)
        self.shown = PatchScores(config.width)
        self.own_words = nn.Embedding(n, config.width)
        nn.init.normal_(self.own_words.weight, std=OWN_STD / FASTER)


def configuration(recipe: Recipe) -> MiniPI0Config:
    """The configuration of the model."""
    return MiniPI0Config(**model_options(recipe))


def views(
    stages: int, seed: int, cache: Path, *, held_out: bool = False, jobs: int = 2
) -> tuple[list[View], float]:
    """Views and every other portrait of so many stages, scaled down, and their CPU seconds.

    `jobs` processes render the stages that are missing.

    Raises: ValueError for a stage that shows an object of the evaluation.
    """
    from tqdm import tqdm

    folder = cache / SCENES
    missing = []
    for number in range(stages):
        if not stage_file(folder, seed, number, held_out).exists():
            missing.append(number)
    if missing:
        render = partial(_render, folder, seed, held_out)
        finished = results(render, missing, jobs, "jobs")
        for _ in tqdm(finished, "scenes", len(missing), mininterval=10):
            pass
    found = []
    spent_s = 0.0
    for number in range(stages):
        shots = cached(folder, seed, number, held_out=held_out, look=draw_look, dyes=True)
        only_generic([get_object(name) for name in shots.names])
        spent_s += cost_s(stage_file(folder, seed, number, held_out))
        pictures = zip(shots.rgb, shots.ids, strict=True)
        portraits = zip(shots.portraits[::2], shots.portrait_ids[::2], strict=True)
        for rgb, ids in chain(pictures, portraits):
            found.append(_view(rgb, ids, shots))
    return found, spent_s


def collate(
    recipe: Recipe,
    pool: Sequence[View],
    looks: Mapping[str, Description],
    number: dict[str, int],
    rng: np.random.Generator,
    config: MiniPI0Config,
) -> Batch:
    """One batch: views drawn anew, with questions of their own.

    `looks` describes the objects, `number` gives the token of each word.

    Raises: as `ask`.
    """
    order = {name: i for i, name in enumerate(looks)}
    images = []
    questions = []
    patches = []
    instances = []
    for i in rng.integers(len(pool), size=recipe.batch):
        view = pool[i]
        described = [looks[name] for name in view.names]
        questioned = ask(
            image=view.image,
            ids=view.ids,
            names=view.names,
            looks=described,
            n=recipe.questions,
            own=recipe.own,
            rng=rng,
        )
        images.append(questioned.image)
        for question in questioned.questions:
            questions.append(question)
            meant = (view.ids == question.target + 1) & (question.target >= 0)
            patches.append(patch_shares(meant, config.patch))
            own = question.instance
            instances.append(order[view.names[own]] if own >= 0 else -1)
    return Batch(
        images=torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255,
        questions=questions,
        answers=_tokenize_answers(questions, number),
        patches=torch.from_numpy(np.stack(patches)).float(),
        instances=torch.tensor(instances),
    )


def losses(learner: Learner, batch: Batch) -> tuple[Tensor, Figures]:
    """Cross-entropy of the answers' words and of the patches, and figures to log.

    Among the figures are shares of right answers by kind of question (NaN: none was asked).
    """
    vlm = learner.vlm
    texts = [question.text for question in batch.questions]
    tokens, there = vlm.tokenize(texts)
    per_view = len(batch.questions) // len(batch.images)
    patches = vlm.embed_images(batch.images).repeat_interleave(per_view, 0)
    embedded = vlm.towers.embed_language_tokens(tokens)
    is_own = (tokens == vlm.vocabulary[WORD]) & (batch.instances >= 0)[:, None]
    own = FASTER * learner.own_words(batch.instances.clamp(min=0))[:, None]
    embedded = torch.where(is_own[..., None], own, embedded)
    scores, hidden = vlm.read(patches, embedded, there, batch.answers)
    words = F.cross_entropy(scores.flatten(0, 1), batch.answers.flatten(), ignore_index=0)
    heat, hit = patch_loss(learner.shown(hidden), batch.patches)
    matches = (scores.argmax(-1) == batch.answers) | (batch.answers == 0)
    figures = {"words": float(words.detach()), "heat": float(heat.detach()), "hit": float(hit)}
    figures |= _shares_right(matches.all(1), batch.questions)
    return words + SEEN * heat, figures


def train(
    recipe: Recipe,
    out: Path,
    *,
    minutes: float | None = None,
    cache: Path = CACHE,
    jobs: int | None = None,
) -> dict[str, Any]:
    """Train, or go on where an earlier call stopped.

    Writes the model to `out`, and what was measured on unseen objects and the cost, which it
    returns. `jobs` processes (all cores) render and describe.

    Raises: BadOutput when `out` holds another training or a model without what it would go on from,
        another process trains there, or it or `cache` cannot be written or is damaged.
    """
    with training_folder(out, "train vlm", vars(recipe)):
        make_folder(cache, "train vlm", "choose another folder with --cache")
        jobs = jobs or os.cpu_count() or 1
        pool, scenes_s = views(recipe.stages, recipe.seed, cache, jobs=jobs)
        n_held_out = min(HELD_OUT, recipe.stages)
        held_out, more_s = views(n_held_out, recipe.seed, cache, held_out=True, jobs=jobs)
        names = dict.fromkeys(chain.from_iterable(view.names for view in [*pool, *held_out]))
        looks, captions_s = captions(names, out / CAPTIONS, jobs)
        config = configuration(recipe)
        # Initial weights only; every other draw comes from the step's stream.
        torch.manual_seed(recipe.seed)
        learner = Learner(config, len(looks))
        number = learner.vlm.vocabulary

        def step_losses(model: Learner, step: int) -> tuple[Tensor, Figures]:
            rng = np.random.default_rng([75, recipe.seed, step])
            with fused_attention():
                batch = collate(recipe, pool, looks, number, rng, config)
                return losses(model, batch)

        run = Schedule(
            name="mini-paligemma",
            steps=recipe.steps,
            rate=recipe.rate,
            minutes=minutes,
            every=100,
            made_of={
                "recipe": vars(recipe),
                "words": config.words,
                "data_sha256": data_sha256(pool, looks),
            },
        )
        mean, log = train_steps(learner, step_losses, run, out)
        with writing(out, "train vlm"):
            mean.vlm.save(out)
        # What is measured is what was saved.
        mean.vlm = load_vlm(out)
        figures = []
        with torch.no_grad():
            for i in range(HELD_OUT_BATCHES):
                rng = np.random.default_rng([76, i])
                # Nobody has learned a word of theirs.
                asked = replace(recipe, own=0.0)
                batch = collate(asked, held_out, looks, number, rng, config)
                figures.append(losses(mean, batch)[1])
        spent_s = scenes_s + more_s + captions_s + log[-1]["cpu_s"]
        about = {
            "recipe": vars(recipe),
            "trained_steps": log[-1]["step"],
            "cpu_hours": {"total": round(spent_s / 3600, 3)},
            "held_out": average_of(figures),
            "log": log,
        }
        with writing(out, "train vlm"):
            write_atomic(out / TRAINING_CARD, json.dumps(about, indent=1).encode())
        return about


def make(out: Path, *, cache: Path = CACHE, jobs: int | None = None) -> Path:
    """`out`, once it holds the model of the standard recipe, trained to the end.

    Raises: BadOutput as `train`.
    """
    recipe = Recipe()
    file = out / TRAINING_CARD
    if file.is_file():
        with reading_kept(file, "train vlm"):
            about = dict(parse_json(file.read_bytes()))
            trained_steps = _trained_steps(about)
        if about.get("recipe") == vars(recipe) and trained_steps == recipe.steps:
            return out
    train(recipe, out, cache=cache, jobs=jobs)
    return out


def _trained_steps(about: Mapping[str, Any]) -> int:
    """The steps that the model of a training.json took."""
    if "trained_steps" in about:
        return int(about["trained_steps"])
    # The card of data/policies/mini-paligemma is older than the field.
    return int(about["log"][-1]["step"])


def data_sha256(pool: Sequence[View], looks: Mapping[str, Description]) -> str:
    """A checksum of what a model learns from: the views, and the words for their objects."""
    digest = hashlib.sha256()
    for view in pool:
        digest.update(view.image.tobytes() + view.ids.tobytes() + " ".join(view.names).encode())
    for name in sorted(looks):
        digest.update(f"{name}: {looks[name].short}; {looks[name].long}.".encode())
    return digest.hexdigest()


def _view(rgb: Rgb, ids: UInt8[np.ndarray, "h w"], shots: Shots) -> View:
    small_ids = cv2.resize(ids, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    return View(small(rgb), small_ids, shots.names)


def _render(folder: Path, seed: int, held_out: bool, number: int) -> None:
    cached(folder, seed, number, held_out=held_out, look=draw_look, dyes=True)


def _tokenize_answers(questions: Sequence[Question], number: dict[str, int]) -> Tensor:
    """The tokens of the answers (q x ANSWER); each ends with a new line, then zeros."""
    answers = torch.zeros((len(questions), ANSWER), dtype=torch.long)
    for row, question in zip(answers, questions, strict=True):
        if question.answer:
            tokens = [number[word] for word in (*question.answer, "\n")]
            row[: len(tokens)] = torch.tensor(tokens)
    return answers


def _shares_right(right: Tensor, questions: Sequence[Question]) -> Figures:
    """The share of right answers by kind of question, NaN where none was asked."""
    by_kind: dict[str, list[bool]] = {"": []}
    for kind in KINDS:
        by_kind[kind] = []
    for is_right, question in zip(right, questions, strict=True):
        by_kind[_kind(question)].append(bool(is_right))
    figures = {}
    for kind in KINDS:
        figures[kind] = float("nan")
        if by_kind[kind]:
            figures[kind] = float(np.mean(by_kind[kind]))
    return figures


def _kind(question: Question) -> str:
    """What was asked, and, of yes and no, what is right.

    So a model that always says the same is half right at most.
    """
    if not question.answer:
        return ""
    if question.instance >= 0:
        return "own"
    first_word = question.text.split()[0]
    return {"where": "where", "what": "colour"}.get(first_word, question.answer[0])
