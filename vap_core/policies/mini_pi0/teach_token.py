"""Teaching the learned token of a personal object (P appendix; SPEC section 4).

It says which photos the token is learned from, and where it is kept.
"""

import hashlib
import sys
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA, writing
from vap_core.base.types import Rgb
from vap_core.policies.lerobot.checkpoints import config_field
from vap_core.policies.mini_pi0 import learned_token, token_file
from vap_core.policies.mini_pi0.learned_token import Photos
from vap_core.policies.mini_pi0.token_file import Token
from vap_core.simulation.assets import objects
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import models_of
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    from vap_core.policies.mini_pi0.vlm import MiniVlm

MODEL = DATA / "policies" / "mini-paligemma-tint-free"
"""The shipped vision-language model that the default policies were initialised from.

That of the first policies lies beside it in a clone (`model_of`).
"""
K = 5
"""Photos of the object to learn from."""
VIEWS = 12
"""Photos of every look-alike (the paper: more than ten), and of the object to measure by."""
OTHERS = 4
"""The number of objects of other categories."""
LEAST_ACCURACY = 0.95
"""Share of right answers that the paper asks of a token."""


def photographs(rows: Iterable[EpisodeRow], seed: int, k: int) -> Photos:
    """Photos of the rows' target, of every look-alike beside it, and of other objects.

    There are `k` of the target, as its owner takes them.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    rows = list(rows)
    own = reference_views(objects.get_object(rows[0].target), k, seed)
    rivals: list[Rgb] = []
    for name in lookalikes(rows):
        rivals += reference_views(objects.get_object(name), VIEWS, seed)
    return Photos(tuple(own), tuple(rivals), other_objects(rows, seed))


def lookalikes(rows: Iterable[EpisodeRow]) -> list[str]:
    """The objects of the target's category that the rows place beside it, sorted.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    rows = list(rows)
    target = objects.get_object(rows[0].target)
    names = []
    for name in sorted(_placed(rows) - {target.name}):
        if objects.get_object(name).category == target.category:
            names.append(name)
    return names


def file_suffix(rows: Iterable[EpisodeRow], model: str, suffix: str = token_file.SUFFIX) -> str:
    """What a token's file is called after its object's name: `suffix`, and before it a digest.

    The digest is of what one object's tokens differ by: the SHA-256 of the model, and the
    look-alikes beside the object.
    """
    differ_by = "\n".join([model, *lookalikes(rows)])
    return f".{hashlib.sha256(differ_by.encode()).hexdigest()[:12]}{suffix}"


def other_objects(rows: Sequence[EpisodeRow], seed: int) -> tuple[Rgb, ...]:
    """Photos of personal objects of other categories than the rows' target.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    category = objects.get_object(rows[0].target).category
    kinds = [kind for kind in objects.CATEGORIES if kind != category]
    first = objects.CATEGORIES.index(category)
    photos: list[Rgb] = []
    for i in range(OTHERS):
        other = objects.personal_instance(kinds[(first + 5 * i) % len(kinds)])
        photos += reference_views(other, seed=seed)
    return tuple(photos)


def model_of(initialised_from: str) -> Path:
    """The folder of the shipped model with this SHA-256; that of MODEL where none has it.

    Raises: BadPolicy when a shipped model is damaged.
    """
    for folder in sorted(MODEL.parent.glob("mini-paligemma*")):
        if _sha256(folder) == initialised_from:
            return folder
    return MODEL


def model_of_policy(policy: Path) -> Path:
    """The folder of the shipped model that the policy in a folder grew from. Raises: BadPolicy."""
    return model_of(config_field(policy, "vlm"))


@lru_cache
def _sha256(model: Path) -> str:
    """Of the model in a folder; every trial of a method asks for it."""
    from vap_core.policies.mini_pi0.vlm import load_vlm

    return load_vlm(model).sha256()


def teach(
    rows: Iterable[EpisodeRow], folder: Path, initialised_from: str, model: Path | None = None
) -> Token:
    """Learn the token of the rows' target from K photos, and keep it in `folder`.

    It is measured on other photos. A token that is there already stays. `initialised_from` is the
    SHA-256 of the model that the policy was initialised from; `model` is its folder, by default the
    shipped one's. A token that is not learned well is noted on stderr.

    Raises: BadPolicy without the model; BadStudy when the policy was initialised from another one;
        BadOutput when the folder cannot be written.
    """
    from vap_core.policies.mini_pi0 import vlm

    model = model or model_of(initialised_from)
    teacher = vlm.load_vlm(model)
    if teacher.sha256() != initialised_from:
        known = f"mini-PaliGemma {initialised_from[:8]}" if initialised_from else "none"
        raise BadStudy(
            f"soft prompt: the policy was initialised from {known}, but the model in {model} is "
            f"{teacher.sha256()[:8]}; leave soft out, or put the right one there."
        )
    return _teach(teacher, list(rows), folder, token_file.SUFFIX)


def teach_own(rows: Iterable[EpisodeRow], folder: Path, policy: Path) -> Token:
    """The same in the weights of the policy whose checkpoint is given, not in those it came from.

    Raises: BadPolicy when the checkpoint is no mini-pi0; BadOutput when the folder cannot be
        written.
    """
    from vap_core.policies.mini_pi0 import vlm

    return _teach(vlm.load_from_policy(policy), list(rows), folder, token_file.OWN_SUFFIX)


def _teach(teacher: "MiniVlm", rows: Sequence[EpisodeRow], folder: Path, suffix: str) -> Token:
    """Learn the target's token in `teacher` unless the folder has it."""
    from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused_attention

    name = rows[0].target
    suffix = file_suffix(rows, teacher.sha256(), suffix)
    if (folder / f"{name}{suffix}").exists():
        return token_file.load(folder, name, teacher.sha256(), suffix)
    taught = photographs(rows, 0, K)
    unseen = photographs(rows, 1, VIEWS)
    with fused_attention():  # a third less time
        token = learned_token.learn(teacher, name, taught, unseen)
    if token.accuracy < LEAST_ACCURACY:
        print(
            f"note: the learned token of {name} is right in {100 * token.accuracy:.0f} % of unseen "
            f"photos, less than {100 * LEAST_ACCURACY:.0f} %.",
            file=sys.stderr,
        )
    with writing(folder, "tokens"):
        token_file.save(folder, token, suffix)
    return token


def _placed(rows: Sequence[EpisodeRow]) -> set[str]:
    """The objects that the rows place, without the goals."""
    return set(models_of(rows)) - {row.goal for row in rows}
