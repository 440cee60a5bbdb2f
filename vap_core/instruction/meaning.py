"""What words mean: which remembered object they fit best."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import PersonalObject
from vap_core.instruction.looks import fit, wanted

EmbedText = Callable[[Sequence[str]], Float32[np.ndarray, "n d"]]
LOOKS = 0.25
"""Weight of the description's words beside the cosine."""


def object_scores(
    words: str, objects: Sequence[PersonalObject], embed: EmbedText, *, looks: bool
) -> Float32[np.ndarray, " n"]:
    """How well words fit every object.

    It is the mean of the two greatest cosines with the object's texts, and the fit of its
    description; among objects of one category, whose `looks` differ, the greatest cosine.
    """
    there = wanted(words) if looks else words
    (query,) = embed([there or words])
    scores = np.zeros(len(objects), np.float32)
    for i, obj in enumerate(objects):
        cosines = np.sort(embed(_texts(obj, looks)) @ query)
        cosine = cosines[-1] if looks else cosines[-2:].mean()
        if not there:
            cosine = 0.0
        scores[i] = float(cosine) + LOOKS * fit(words, obj)
    return scores


def _texts(obj: PersonalObject, looks: bool) -> list[str]:
    """What is known of an object, in phrases."""
    texts = [obj.category]
    if obj.note:
        texts += [obj.note, f"{obj.category} {obj.note}", f"something {obj.note}"]
    if looks and obj.description is not None:
        texts.append(f"{obj.category}, {obj.description.short}")
    return texts
