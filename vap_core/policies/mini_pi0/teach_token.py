"""Teaching the learned token of a personal object: which photos it is learned from, and where it is kept (P appendix; SPEC section 4)."""

import sys
from collections.abc import Iterable
from pathlib import Path

from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import Photos, Token
from vap_core.simulation.assets import objects
from vap_core.simulation.studio import reference_views
from vap_core.simulation.types import EpisodeRow

MODEL = DATA / "policies" / "mini-paligemma"
"""The shipped vision-language model that the shipped policies were initialised from."""
K, VIEWS, OTHERS = 5, 12, 4
"""Photos of the object to learn from; of every look-alike (the paper: more than ten), and to measure
by; and the number of objects of other categories."""
ENOUGH = 0.95
"""Share of right answers that the paper asks of a token."""


def photographs(rows: Iterable[EpisodeRow], seed: int, k: int) -> Photos:
    """Photos of the rows' target as its owner takes them (k), of every look-alike beside it, and of other objects."""
    rows = list(rows)
    target = objects.get_object(rows[0].target)
    goals = {row.goal for row in rows}
    placed = {place.model for row in rows for place in row.placements}
    rivals = []
    for name in sorted(placed - {target.name} - goals):
        model = objects.get_object(name)
        if model.category == target.category:
            rivals += reference_views(model, VIEWS, seed)
    kinds = [kind for kind in objects.CATEGORIES if kind != target.category]
    first = objects.CATEGORIES.index(target.category)
    others = []
    for i in range(OTHERS):
        other = objects.personal_instance(kinds[(first + 5 * i) % len(kinds)])
        others += reference_views(other, seed=seed)
    own = reference_views(target, k, seed)
    return Photos(tuple(own), tuple(rivals), tuple(others))


def teach(
    rows: Iterable[EpisodeRow], folder: Path, initialised_from: str, model: Path = MODEL
) -> Token:
    """Learn the token of the rows' target from K = 5 photos, measure it on others, and keep it in `folder`.

    A token that is there already stays. `initialised_from` is the SHA-256 of the model that the
    policy was initialised from. A token that is not learned well is noted on stderr.

    Raises: BadPolicy without the model; BadStudy when the policy was initialised from another one.
    """
    from vap_core.policies.mini_pi0 import vlm

    rows = list(rows)
    teacher = vlm.load(model)
    if teacher.sha256() != initialised_from:
        known = f"mini-PaliGemma {initialised_from[:8]}" if initialised_from else "none"
        raise BadStudy(
            f"soft prompt: the policy was initialised from {known}, but the model in {model} is "
            f"{teacher.sha256()[:8]}; leave soft out, or put the right one there."
        )
    name = rows[0].target
    if (folder / f"{name}{learned_token.SUFFIX}").exists():
        return learned_token.load(folder, name, teacher.sha256())
    taught, held_out = photographs(rows, 0, K), photographs(rows, 1, VIEWS)
    token = learned_token.learn(teacher, name, taught, held_out)
    if token.accuracy < ENOUGH:
        print(
            f"note: the learned token of {name} is right in {100 * token.accuracy:.0f} % of unseen "
            f"photos, less than {100 * ENOUGH:.0f} %.",
            file=sys.stderr,
        )
    learned_token.save(folder, token)
    return token
