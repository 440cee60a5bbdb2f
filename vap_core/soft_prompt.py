"""The soft prompt as a method: "pick up my cup" becomes "pick up <my_0>", and the policy hears a learned embedding there (SPEC section 4; P 5.2)."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vap_core import tokens
from vap_core.errors import BadStudy
from vap_core.hard_prompt import Reworded
from vap_core.instruction import parse
from vap_core.sim import objects
from vap_core.sim.studio import reference_views
from vap_core.tokens import WORD, Photos, Token
from vap_core.values import EpisodeRow

MODEL = Path(__file__).resolve().parent.parent / "data" / "policies" / "mini-paligemma"
"""The shipped vision-language model that the shipped policies grew from."""
K, VIEWS, OTHERS = 5, 12, 4
"""Photos of the object to learn from; of every look-alike (the paper: more than ten), and to measure by; and how many objects of other kinds."""
ENOUGH = 0.95
"""Share of right answers that the paper asks of a word."""


@dataclass(frozen=True)
class Learned:
    """A word of the object's own, learned in the model that the policy grew from."""


def soft_prompt() -> Reworded:
    """ "pick up my cup" -> "pick up <my_0>"."""

    def say(text: str) -> str:
        target = parse(text).targets[0]
        return text[: target.start] + WORD + text[target.stop :]

    return Reworded(say)


def photographs(rows: Iterable[EpisodeRow], seed: int, k: int) -> Photos:
    """Of the rows' target as its owner takes them (k), of every look-alike that stands beside it, and of objects of other kinds."""
    played = list(rows)
    target, goals = objects.get(played[0].target), {row.goal for row in played}
    names = sorted({place.model for row in played for place in row.placements} - {target.name} - goals)
    rivals = [model for model in map(objects.get, names) if model.category == target.category]
    kinds = [kind for kind in objects.CATEGORIES if kind != target.category]
    at = objects.CATEGORIES.index(target.category)
    others = [objects.personal(kinds[(at + 5 * i) % len(kinds)]) for i in range(OTHERS)]
    return Photos(
        tuple(reference_views(target, k, seed)),
        tuple(view for model in rivals for view in reference_views(model, VIEWS, seed)),
        tuple(view for model in others for view in reference_views(model, seed=seed)),
    )


def teach(rows: Iterable[EpisodeRow], folder: Path, grown: str, model: Path = MODEL) -> Token:
    """Learn the word of the rows' target from K = 5 reference photos, measure it on others, and keep it in `folder`; what is there stays.

    `grown` is the SHA-256 of the model that the policy grew from. A word that is not learned well is said so.
    Raises: BadPolicy without the model; BadStudy when the policy grew from another one, or from none.
    """
    from vap_core.policies.mini_pi0 import vlm

    played = list(rows)
    teacher = vlm.load(model)
    if teacher.sha256() != grown:
        known = f"from mini-PaliGemma {grown[:8]}" if grown else "from no mini-PaliGemma"
        here = f"the one in {model} is {teacher.sha256()[:8]}"
        raise BadStudy(f"soft prompt: the policy grew {known}, {here}; leave soft out, or put the right one there.")
    if (folder / f"{played[0].target}{tokens.SUFFIX}").exists():
        return tokens.load(folder, played[0].target, teacher.sha256())
    token = tokens.learn(teacher, played[0].target, photographs(played, 0, K), photographs(played, 1, VIEWS))
    if token.accuracy < ENOUGH:
        told = f"in {100 * token.accuracy:.0f} % of unseen photos, less than {100 * ENOUGH:.0f} %"
        print(f"note: the word of {token.object} tells it {told}.", file=sys.stderr)
    tokens.save(folder, token)
    return token
