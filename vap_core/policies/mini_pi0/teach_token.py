"""Teaching the learned token of a personal object (P appendix; SPEC section 4).

It says which photos the token is learned from, and where it is kept.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA
from vap_core.base.types import Rgb
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import Photos, Token
from vap_core.simulation.assets import objects
from vap_core.simulation.studio import reference_views
from vap_core.simulation.types import EpisodeRow

MODEL = DATA / "policies" / "mini-paligemma"
"""The shipped vision-language model that the shipped policies were initialised from."""
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
    """
    rows = list(rows)
    target = objects.get_object(rows[0].target)
    rivals: list[Rgb] = []
    for name in sorted(_placed(rows) - {target.name}):
        model = objects.get_object(name)
        if model.category == target.category:
            rivals += reference_views(model, VIEWS, seed)
    kinds = [kind for kind in objects.CATEGORIES if kind != target.category]
    first = objects.CATEGORIES.index(target.category)
    others: list[Rgb] = []
    for i in range(OTHERS):
        other = objects.personal_instance(kinds[(first + 5 * i) % len(kinds)])
        others += reference_views(other, seed=seed)
    own = reference_views(target, k, seed)
    return Photos(tuple(own), tuple(rivals), tuple(others))


def teach(
    rows: Iterable[EpisodeRow], folder: Path, initialised_from: str, model: Path = MODEL
) -> Token:
    """Learn the token of the rows' target from K photos, and keep it in `folder`.

    It is measured on other photos. A token that is there already stays. `initialised_from` is the
    SHA-256 of the model that the policy was initialised from. A token that is not learned well is
    noted on stderr.

    Raises: BadPolicy without the model; BadStudy when the policy was initialised from another one.
    """
    from vap_core.policies.mini_pi0 import vlm

    rows = list(rows)
    teacher = vlm.load_vlm(model)
    if teacher.sha256() != initialised_from:
        known = f"mini-PaliGemma {initialised_from[:8]}" if initialised_from else "none"
        raise BadStudy(
            f"soft prompt: the policy was initialised from {known}, but the model in {model} is "
            f"{teacher.sha256()[:8]}; leave soft out, or put the right one there."
        )
    name = rows[0].target
    if (folder / f"{name}{learned_token.SUFFIX}").exists():
        return learned_token.load(folder, name, teacher.sha256())
    taught = photographs(rows, 0, K)
    unseen = photographs(rows, 1, VIEWS)
    token = learned_token.learn(teacher, name, taught, unseen)
    if token.accuracy < LEAST_ACCURACY:
        print(
            f"note: the learned token of {name} is right in {100 * token.accuracy:.0f} % of unseen "
            f"photos, less than {100 * LEAST_ACCURACY:.0f} %.",
            file=sys.stderr,
        )
    learned_token.save(folder, token)
    return token


def _placed(rows: Sequence[EpisodeRow]) -> set[str]:
    """The objects that the rows place, without the goals."""
    placed = set()
    goals = set()
    for row in rows:
        goals.add(row.goal)
        for place in row.placements:
            placed.add(place.model)
    return placed - goals
