"""Learned words for some training objects, so that a policy reads such words before its user's.

Each is learned in the frozen model that the policy is initialised from, as a soft prompt is
(`learned_token`), from photos of the object, of its look-alikes in the films and of other kinds.
"""

import json
import time
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.files import parse_json, write_atomic, writing
from vap_core.base.types import Rgb
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import Photos, TokenTraining
from vap_core.policies.mini_pi0.vlm import load_vlm
from vap_core.simulation.assets import objects
from vap_core.simulation.studio import photograph, reference_shots
from vap_core.study.workers import results_here
from vap_make.films.demonstrations import Film
from vap_make.films.scenes import TRAIN_INSTANCES, only_generic
from vap_make.folder import reading_kept
from vap_make.objects import generic_instance
from vap_make.policy.commands import Embedding

PHOTOS = 5
"""Photos of an object, and of each of its look-alikes."""
OTHERS = 6
"""Photos of objects of other categories."""
SIZE = 224
"""Pixels of a photo, square."""
FILE = "words.json"
"""The words of a folder: what learning them cost, how accurate each is, and in which model."""
TRAINING = TokenTraining(epochs=8)
LEAST_ACCURACY = 0.75
"""A word that tells its object from others in fewer unseen photos is not used."""


def crews(films: Sequence[Film], count: int) -> list[tuple[str, ...]]:
    """The look-alikes of the first films, a tuple a stage, `count` objects in all or a few more.

    Raises: UnknownName, BadObject, as `objects.get_object`.
    """
    found: dict[tuple[str, ...], None] = {}
    for film in films:
        category = objects.get_object(film.names[0]).category
        crew = []
        for i, name in enumerate(film.names):
            if i != film.goal and objects.get_object(name).category == category:
                crew.append(name)
        if sum(map(len, found)) < count:
            found[tuple(sorted(crew))] = None
    return list(found)


def require_words_of(model: str, folder: Path) -> None:
    """Check that the words of a folder were learned in the model with this SHA-256.

    Those that earlier code learned do not say in which, and are accepted.

    Raises: BadOutput when they were learned in another, or words.json is damaged.
    """
    if _read_kept(folder / FILE).get("model", model) != model:
        raise BadOutput(
            f"train policy: the words in {folder} were learned in another mini-PaliGemma; name "
            "that with --vlm, or choose another --out."
        )


def learn_words(
    vlm: Path, films: Sequence[Film], count: int, folder: Path, jobs: int = 1
) -> tuple[dict[str, Embedding], dict[str, Any]]:
    """The usable words of about `count` objects of the films, and what learning them took.

    They are learned in `jobs` processes, in the mini-PaliGemma of the folder `vlm`. `folder` keeps
    them; an earlier call goes on.

    Raises: BadOutput when words.json is damaged, of another model or cannot be written.
    """
    from tqdm import tqdm

    file = folder / FILE
    kept = _read_kept(file)
    model = load_vlm(vlm).sha256()
    require_words_of(model, folder)
    kept["model"] = model
    crew_of: dict[str, tuple[str, ...]] = {}
    for crew in crews(films, count):
        for name in crew:
            crew_of.setdefault(name, crew)
    missing = [pair for pair in crew_of.items() if pair[0] not in kept["accuracy"]]
    work = results_here(
        partial(_learn, vlm, folder, TRAINING), missing, workers=jobs, remedy="jobs"
    )
    for (name, _), (accuracy, cpu_s) in tqdm(
        work, desc="learned words", total=len(missing), mininterval=10
    ):
        kept["accuracy"][name] = accuracy
        kept["cpu_s"] += cpu_s
        with writing(file, "train"):
            write_atomic(file, json.dumps(kept, indent=1).encode())
    # In the films' order, whichever was learned first.
    kept["accuracy"] = {name: kept["accuracy"][name] for name in crew_of}
    words = {}
    for name, accuracy in kept["accuracy"].items():
        if accuracy >= LEAST_ACCURACY:
            words[name] = learned_token.load(folder, name, model).embedding
    return words, kept


def _read_kept(file: Path) -> dict[str, Any]:
    """What words.json says of the words learned so far. Raises: BadOutput when it is damaged."""
    kept: dict[str, Any] = {"cpu_s": 0.0, "accuracy": {}}
    if file.exists():
        with reading_kept(file, "train"):
            found = parse_json(file.read_bytes())
            kept = {"cpu_s": float(found["cpu_s"]), "accuracy": dict(found["accuracy"])}
            if "model" in found:
                kept["model"] = str(found["model"])
    return kept


def _learn(
    vlm: Path, folder: Path, training: TokenTraining, pair: tuple[str, Sequence[str]]
) -> tuple[float, float]:
    """Learn the word of an object with a crew; its accuracy, and the CPU seconds that it took."""
    started = time.process_time()
    name, crew = pair
    taught, unseen = (_photos(name, crew, seed) for seed in (0, 1))
    token = learned_token.learn(load_vlm(vlm), name, taught, unseen, training)
    with writing(folder, "train"):
        learned_token.save(folder, token)
    return token.accuracy, time.process_time() - started


def _photos(name: str, crew: Sequence[str], seed: int) -> Photos:
    """Photos of an object, its look-alikes and other things, none of which is in an evaluation."""
    rng = np.random.default_rng([80, seed, *crew[0].encode()])
    category = objects.get_object(name).category
    rivals: list[Rgb] = []
    for other in crew:
        if other != name:
            rivals += _photograph(other, PHOTOS, seed)
    kinds = [kind for kind in objects.CATEGORIES if kind != category]
    others: list[Rgb] = []
    for kind in rng.choice(kinds, OTHERS, replace=False):
        instance = generic_instance(str(kind), int(rng.integers(TRAIN_INSTANCES)))
        others += _photograph(instance.name, 1, seed)
    return Photos(_photograph(name, PHOTOS, seed), tuple(rivals), tuple(others))


@lru_cache(maxsize=64)
def _photograph(name: str, n: int, seed: int) -> tuple[Rgb, ...]:
    """Photos of an object; those of a crew are asked for by each of it."""
    model = objects.get_object(name)
    only_generic([model])
    return tuple(photograph(model, reference_shots(model, n, seed), SIZE))
