"""Train a mini-pi0 on filmed demonstrations (P 5.1).

    ./vap train policy --suite simpler-bridge --seed 0

From nothing: the films, the mini-PaliGemma that the policy grows from, the descriptions of the
objects, learned words for some of them, and the policy. Each is kept, so that the same command goes
on where it was interrupted, at whatever moment.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from vap_core.base.errors import BadOutput, BadPolicy, device_name
from vap_core.base.files import (
    code_version,
    make_folder,
    parse_json,
    saving_tensors,
    write_atomic,
    writing,
)
from vap_core.policies.lerobot.checkpoints import CAPTIONS, TRAINING_CARD, WORDS
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused_attention
from vap_core.policies.mini_pi0.vlm import (
    MiniVlm,
    load_vlm,
    store_in_bfloat16,
)
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import suite
from vap_make.films.captions import captions
from vap_make.films.dataset import about, data_sha256, read, shoot_stages
from vap_make.films.demonstrations import SIDE, Film, cached, stage_file, thinned
from vap_make.films.scenes import CACHE, only_generic
from vap_make.folder import SAVING, cost_s, training_folder
from vap_make.patches import model_options
from vap_make.policy.ahead import Ahead
from vap_make.policy.batches import Frames, statistics
from vap_make.policy.commands import Known, nameable
from vap_make.policy.losses import Learner, embedding_cosine, losses
from vap_make.policy.taught import learn_words, require_words_of
from vap_make.recipe import Recipe, filmed_tasks
from vap_make.step import Figures, Schedule, average_of, begun_with, train_steps

FILMS = "dyed-films"
SIZES = ("image_resolution", "patch", "width", "depth", "head_dim", "vision_width", "vision_depth")
HELD_OUT = 19
"""Every so many stages one is kept from training, to see what was learned.

It is a prime, as tasks take turns.
"""
TEMPERATURE = 0.0
"""Of the trained policy's sampling noise.

Without any, three in five generic objects are grasped where with all of it two in five are.
"""


@dataclass(frozen=True)
class Films:
    """Films to train on, films held out, and the CPU seconds that filming them took.

    The cost of a dataset is not known: None.
    """

    train: list[Film]
    held_out: list[Film]
    cpu_s: float | None = None

    @property
    def all(self) -> list[Film]:
        return [*self.train, *self.held_out]


def configuration(recipe: Recipe, state_size: int, action_size: int) -> MiniPI0Config:
    """The policy's configuration for states and actions of these sizes.

    Raises: UnknownName for a recipe of a suite that no registry holds.
    """
    from lerobot.configs import FeatureType, PolicyFeature

    inputs = {}
    for camera in suite(recipe.suite).cameras:
        view = PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
        inputs[f"observation.images.{camera}"] = view
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (state_size,))
    return MiniPI0Config(
        **model_options(recipe),
        chunk_size=recipe.chunk,
        n_action_steps=recipe.execute,
        max_state_dim=state_size,
        max_action_dim=action_size,
        temperature=TEMPERATURE,
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
    )


def origin(demonstrations: Path, suite_name: str) -> dict[str, Any]:
    """Suite, seed and number of stages of a dataset's films.

    Raises: BadOutput for one that is damaged or of another suite.
    """
    card = about(demonstrations)
    if card["suite"] != suite_name:
        raise BadOutput(
            f"train policy: {demonstrations} shows {card['suite']}, not {suite_name}; "
            "name its suite, or another dataset."
        )
    return {name: card[name] for name in ("suite", "seed", "stages")}


def load_films(
    recipe: Recipe,
    cache: Path = CACHE,
    demonstrations: Path | None = None,
    jobs: int | None = None,
) -> Films:
    """The films of a dataset, or of the cache, shot where they are missing there.

    Raises: BadOutput for a dataset that is damaged or of another suite.
    """
    if demonstrations is not None:
        origin(demonstrations, recipe.suite)
        return Films(
            thinned(read(demonstrations, lambda stage: not _is_held_out(stage)), recipe.thin),
            thinned(read(demonstrations, _is_held_out), recipe.thin),
        )
    folder = cache / FILMS
    shoot_stages(recipe.suite, recipe.stages, folder, seed=recipe.seed, jobs=jobs)
    films: list[Film] = []
    held_out: list[Film] = []
    spent_s = 0.0
    for stage in range(recipe.stages):
        part = held_out if _is_held_out(stage) else films
        part += thinned(cached(folder, recipe.suite, recipe.seed, stage), recipe.thin)
        spent_s += cost_s(stage_file(folder, recipe.suite, recipe.seed, stage))
    return Films(films, held_out, spent_s)


def require_startable(
    recipe: Recipe,
    out: Path,
    vlm: Path,
    *,
    demonstrations: Path | None = None,
    cache: Path = CACHE,
    device: str | None = None,
) -> None:
    """Check what `train` is given before the mini-PaliGemma is made in `vlm`, which takes long.

    Raises: as `train`, for the device, the dataset's origin, `out` and `cache`, and where `out`
        holds a training and `vlm` no model that it could have grown from.
    """
    device_name(device)
    recipe = _with_stages_of(demonstrations, recipe)
    with training_folder(out, "train policy", recipe.as_json()):
        if demonstrations is None:
            _make_cache(cache)
        if begun_with(out) and not (vlm / "model.safetensors").exists():
            raise _other_teacher(out)


def train(
    recipe: Recipe,
    out: Path,
    *,
    vlm: Path | None = None,
    demonstrations: Path | None = None,
    minutes: float | None = None,
    cache: Path = CACHE,
    every: int = 100,
    jobs: int | None = None,
    device: str | None = None,
) -> dict[str, Any]:
    """Train, or go on where an earlier call stopped, and write a checkpoint that lerobot loads.

    Returns training.json: the recipe, what was measured on the films held out, and the cost. The
    policy grows from the mini-PaliGemma in `vlm`, in which learned words are taught, or, None,
    begins with nothing. `demonstrations` is a dataset of train demonstrations, whose number of
    stages takes the place of the recipe's; None: the cache.
    The steps run on `device` (`base.device`); `jobs` processes, None: one a core, film, photograph,
    teach the words and draw the batches.

    Raises: BadOutput when `out` holds another training or a model without what it would go on from,
        another process trains there, or it or `cache` cannot be written or is damaged; BadPolicy
        for a mini-PaliGemma of other words or sizes; UnknownName: no such device.
    """
    place = torch.device(device_name(device))
    made_of: dict[str, Any] = {}
    if demonstrations is not None:
        made_of["demonstrations"] = origin(demonstrations, recipe.suite)
    recipe = _with_stages_of(demonstrations, recipe)
    with training_folder(out, "train policy", recipe.as_json()):
        if demonstrations is None:
            _make_cache(cache)
        jobs = jobs or os.cpu_count() or 1
        # Before the films, which take longest.
        teacher = None if vlm is None else load_vlm(vlm)
        made_of["taught_in"] = _require_same_teacher(recipe, teacher, out)
        films = load_films(recipe, cache, demonstrations, jobs)
        if not films.train:
            raise BadOutput(
                f"train policy: {demonstrations or recipe.suite} holds no film to learn from; "
                "make more stages."
            )
        _require_trainable(recipe, films.all)
        made_of["recipe"] = recipe.as_json()
        made_of["data_sha256"] = data_sha256(films.all)
        first = films.train[0]
        config = configuration(recipe, first.state.shape[1], first.action.shape[1])
        stats = statistics(films.train, recipe.angle_noise_rad)
        # Of initial weights only; every other draw comes from the step's stream.
        torch.manual_seed(recipe.seed)
        learner = Learner(config)
        if teacher is not None:
            config.vlm = teacher.sha256()
            initialise_policy(teacher, learner.policy)
        made_of["vlm"] = config.vlm
        cost_cpu_s: dict[str, float] = {}
        for part, spent_s in (("films", films.cpu_s), ("vlm", _vlm_cost_s(vlm))):
            if spent_s is not None:
                cost_cpu_s[part] = spent_s
        known, taught = _prepare_words(recipe, films, vlm, out, cost_cpu_s, jobs)
        frames = Frames(recipe=recipe, films=films.train, stats=stats, config=config, known=known)
        ahead = Ahead(frames, jobs)

        def step(model: Learner, at: int) -> tuple[Tensor, Figures]:
            batch = ahead.take(at).to(place)
            generator = torch.Generator().manual_seed(recipe.seed * 1_000_003 + at)
            with fused_attention():
                return losses(
                    policy=model.policy,
                    asked=model.asked,
                    batch=batch,
                    draws=recipe.draws,
                    generator=generator,
                )

        run = Schedule(
            name=recipe.suite,
            steps=recipe.steps,
            rate=recipe.rate,
            minutes=minutes,
            every=every,
            made_of=made_of,
            slower="lower --rate",
        )
        mean, log = train_steps(learner.to(place), step, run, out, lambda: ahead.cpu_s)
        ahead.close()
        mean = mean.cpu()
        cost_cpu_s["steps"] = log[-1]["cpu_s"]
        card = {
            **made_of,
            "taught": taught,
            "embedding_cosine": embedding_cosine(mean.policy, teacher),
            "device": torch.cuda.get_device_name(place) if place.type == "cuda" else place.type,
            "cpu_hours": _hours(cost_cpu_s),
            "log": log,
        }
        held = Frames(
            recipe=recipe, films=films.held_out, stats=stats, config=mean.policy.config, known=known
        )
        return save(learner=mean, stats=stats, held=held, card=card, out=out)


def save(
    learner: Learner, stats: Any, held: Frames, card: dict[str, Any], out: Path
) -> dict[str, Any]:
    """Write weights, configuration and processors as lerobot keeps them, and what was measured.

    Returns training.json; its `held_out` are the losses on the films of `held`.

    Raises: BadOutput when the disk is full.
    """
    from lerobot.policies import make_pre_post_processors

    policy = learner.policy
    # Killed at any moment, every file that has its name is whole.
    with writing(out, "train policy"), TemporaryDirectory(prefix=SAVING, dir=out) as name:
        part = Path(name)
        with saving_tensors():
            policy.save_pretrained(part)
            store_in_bfloat16(part / "model.safetensors")
            for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
                pipeline.save_pretrained(part)
        for file in part.iterdir():
            os.replace(file, out / file.name)
    # What is measured is what was saved.
    policy.load_state_dict(load_file(out / "model.safetensors"))
    measured = []
    if held.films:
        with torch.no_grad():
            for i in range(8):
                batch = held.draw(held.recipe.batch, np.random.default_rng([74, i]))
                generator = torch.Generator().manual_seed(i)
                _, figures = losses(
                    policy=policy, asked=learner.asked, batch=batch, draws=4, generator=generator
                )
                measured.append(figures)
    card = {
        **card,
        "trained_steps": card["log"][-1]["step"],
        "written_by": code_version(),
        "held_out": average_of(measured),
    }
    with writing(out, "train policy"):
        write_atomic(out / TRAINING_CARD, json.dumps(card, indent=1).encode())
    return card


def _with_stages_of(demonstrations: Path | None, recipe: Recipe) -> Recipe:
    """The recipe with as many stages as a dataset has; without one, as it is.

    Raises: BadOutput, as `origin`.
    """
    if demonstrations is None:
        return recipe
    return replace(recipe, stages=origin(demonstrations, recipe.suite)["stages"])


def _make_cache(cache: Path) -> None:
    """Raises: BadOutput when the folder of films cannot be written."""
    make_folder(cache, "train policy", "choose another folder with --cache")


def _require_same_teacher(recipe: Recipe, teacher: MiniVlm | None, out: Path) -> str:
    """The SHA-256 of the model that words are taught in, "" where none are.

    Raises: BadOutput when the training in `out` grew from another model, or its words were taught
        in another.
    """
    sha256 = "" if teacher is None else teacher.sha256()
    taught_in = sha256 if recipe.taught else ""
    known = {"taught_in": taught_in, "vlm": sha256}
    begun = begun_with(out)
    for name, given in known.items():
        if begun.get(name, given) != given:
            raise _other_teacher(out)
    if taught_in:
        require_words_of(taught_in, out / WORDS)
    return taught_in


def _other_teacher(out: Path) -> BadOutput:
    return BadOutput(
        f"train policy: {out} holds a training with another mini-PaliGemma, or with none; go on "
        "with the same --vlm, or choose another --out."
    )


def _prepare_words(
    recipe: Recipe,
    films: Films,
    vlm: Path | None,
    out: Path,
    cost_cpu_s: dict[str, float],
    jobs: int,
) -> tuple[Known, dict[str, Any]]:
    """What can be said of the films' objects, and about the learned words; adds to the cost."""
    names: dict[str, None] = {}
    for film in films.all:
        for i in nameable(film, recipe.suite):
            names[film.names[i]] = None
    described, cost_cpu_s["captions"] = captions(names, out / CAPTIONS, jobs)
    if vlm is None or not recipe.taught:
        return Known(described), {}
    words, kept = learn_words(vlm, films.train, recipe.taught, out / WORDS, jobs)
    cost_cpu_s["words"] = kept["cpu_s"]
    accuracy = list(kept["accuracy"].values())
    about_words = {
        "objects": len(accuracy),
        "used": len(words),
        "mean_accuracy": float(np.mean(accuracy)),
    }
    return Known(described, words), about_words


def _hours(cost_cpu_s: dict[str, float]) -> dict[str, float]:
    """CPU hours by part whose cost is known, and in all of these."""
    hours = {}
    for part, seconds in cost_cpu_s.items():
        hours[part] = round(seconds / 3600, 3)
    hours["total"] = round(sum(cost_cpu_s.values()) / 3600, 3)
    return hours


def _vlm_cost_s(folder: Path | None) -> float | None:
    """CPU seconds that the mini-PaliGemma in a folder took, 0 without one.

    None: not known, as where its card does not say so, or is absent or damaged.
    """
    if folder is None:
        return 0.0
    if not (folder / TRAINING_CARD).is_file():
        return None
    try:
        card = parse_json((folder / TRAINING_CARD).read_bytes())
        hours = card.get("cpu_hours", {}).get("total")
        return None if hours is None else 3600.0 * float(hours)
    except (OSError, ValueError, TypeError, AttributeError):
        # The card is not what the policy grows from.
        return None


def _is_held_out(stage: int) -> bool:
    return stage % HELD_OUT == HELD_OUT - 1


def _require_trainable(recipe: Recipe, films: Sequence[Film]) -> None:
    """Raises: ValueError when a film shows an evaluation object other than its goal; BadOutput for
    a task that the recipe's films do not show, or an object of the category that is held out.
    """
    held_out = recipe.held_out_category
    tasks = {task.name for task in filmed_tasks(recipe.suite)}
    models = []
    for film in films:
        if film.task not in tasks:
            raise _shows_held_out(f"{film.task}, whose category {recipe.suite} holds out")
        for i in nameable(film, recipe.suite):
            model = get_object(film.names[i])
            if model.category == held_out:
                raise _shows_held_out(f"a {held_out}, which {recipe.suite} holds out")
            models.append(model)
    only_generic(models)


def _shows_held_out(what: str) -> BadOutput:
    return BadOutput(
        f"train policy: the films show {what}; film them again: ./vap train demonstrations."
    )


def initialise_policy(vlm: MiniVlm, policy: Any) -> None:
    """Start a policy's image tower, decoder and words from the model's.

    Raises: BadPolicy when words or sizes differ.
    """
    for name in ("words", *SIZES):
        if getattr(policy.config, name) != getattr(vlm.config, name):
            raise BadPolicy(
                f"vlm.initialise_policy: policy and mini-PaliGemma differ in {name}; make the "
                "model again: ./vap train vlm"
            )
    paligemma = policy.model.paligemma_with_expert.paligemma
    paligemma.load_state_dict(vlm.towers.paligemma.state_dict())
