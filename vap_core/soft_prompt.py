"""The soft prompt as a method: "pick up my cup" becomes "pick up <my_0>", and the policy hears a learned embedding there (SPEC section 4; P 5.2)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vap_core import tokens
from vap_core.hard_prompt import Reworded
from vap_core.instruction import parse
from vap_core.sim import objects
from vap_core.sim.studio import reference_views
from vap_core.tokens import WORD, Photos, Token
from vap_core.values import EpisodeRow

MODEL = Path(__file__).resolve().parent.parent / "data" / "policies" / "mini-paligemma"
"""The shipped vision-language model that the shipped policies grew from."""
VIEWS, OTHERS = 12, 4
"""Photos of every look-alike (the paper: more than ten), and how many objects of other kinds there are."""


@dataclass(frozen=True)
class Learned:
    """A word of the object's own, learned in the model that the policy grew from."""


def soft_prompt() -> Reworded:
    """ "pick up my cup" -> "pick up <my_0>"."""

    def say(text: str) -> str:
        target = parse(text).targets[0]
        return text[: target.start] + WORD + text[target.stop :]

    return Reworded(say)


def photographs(rows: Iterable[EpisodeRow], seed: int, k: int = 5) -> Photos:
    """Of the rows' target as its owner takes them, of every look-alike that stands beside it, and of objects of other kinds."""
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
        tuple(view for model in others for view in reference_views(model, k, seed)),
    )


def teach(rows: Iterable[EpisodeRow], folder: Path, model: Path = MODEL) -> Token:
    """Learn the word of the rows' target from K = 5 reference photos, measure it on others, and keep it in `folder`; what is there stays.

    Raises: BadPolicy without the model.
    """
    from vap_core.policies.mini_pi0 import vlm

    played = list(rows)
    teacher = vlm.load(model)
    if (folder / f"{played[0].target}{tokens.SUFFIX}").exists():
        return tokens.load(folder, played[0].target, teacher.sha256())
    token = tokens.learn(teacher, played[0].target, photographs(played, 0), photographs(played, 1))
    tokens.save(folder, token)
    return token
