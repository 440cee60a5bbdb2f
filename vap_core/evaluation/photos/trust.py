"""How far the vote of some references can be trusted, asked of the references themselves."""

from collections.abc import Mapping, Sequence

import numpy as np

from vap_core.base.types import PersonalObject, Rgb, value
from vap_core.perception.protocols import Encoder
from vap_core.perception.references import LEAST_COSINE, SMALL_PX, Reference
from vap_core.perception.rows import embed_crops
from vap_core.vote import similarity, vote

FEWEST = 3
"""References that are needed before one can be left out."""


@value
class Trust:
    """Leave-one-out over K references: each in turn is a candidate, and the others vote.

    `right` counts the references that win against all rivals, `margin` is the least cosine by which
    one is ahead. Rivals are the crops of `others` remembered objects and `background` crops of the
    reference photos. `by_name` has the remembered objects that beat a reference.
    """

    right: int
    n: int
    margin: float
    others: int
    background: int
    by_name: tuple[str, ...]

    def __str__(self) -> str:
        if self.n < FEWEST:
            return f"vote not checked: {self.n} references; give {FEWEST} or more, five are best"
        if not self.others + self.background:
            return "vote not checked: nothing else is remembered, and the photos show nothing else"
        text = (
            f"vote: each photo left out in turn, {self.right} of {self.n} are elected by the "
            f"others against {self.others} crops of other objects and {self.background} of the "
            f"background; least lead in cosine {self.margin:.2f}"
        )
        if self.by_name:
            text += f"; mistaken for {', '.join(self.by_name)}"
        if self.right < self.n:
            text += "; more photos, from all sides, or tighter crops help"
        return text


def leave_one_out(
    obj: PersonalObject,
    references: Sequence[Reference],
    bank: Mapping[str, PersonalObject],
    encoder: Encoder,
) -> Trust:
    """Elect each reference by the others among the crops of the bank and of the background."""
    background: list[Rgb] = []
    for reference in references:
        background.extend(reference.others)
    rows = [embed_crops("remember", encoder, background)]
    names = [""] * len(background)
    for other in bank.values():
        if other.name != obj.name and other.encoder == obj.encoder:
            rows.append(other.embeddings)
            names += [other.name] * len(other.embeddings)
    rivals = np.concatenate(rows)
    right, margins, beaten_by = 0, [], []
    n = len(obj.embeddings)
    if n >= FEWEST and len(rivals):
        for k in range(n):
            others = np.delete(obj.embeddings, k, axis=0)
            candidates = np.concatenate([obj.embeddings[k : k + 1], rivals])
            cosine = similarity(candidates, others)
            winner = vote(cosine).winner
            assert winner is not None
            mean = cosine.mean(axis=1)
            margins.append(float(mean[0] - mean[1:].max()))
            right += winner == 0
            if winner and names[winner - 1]:
                beaten_by.append(names[winner - 1])
    return Trust(
        right=right,
        n=n,
        margin=min(margins, default=float("nan")),
        others=len(rivals) - len(background),
        background=len(background),
        by_name=tuple(sorted(set(beaten_by))),
    )


def warnings(
    obj: PersonalObject, references: Sequence[Reference], names: Sequence[str]
) -> list[str]:
    """What is wrong with references that are used all the same, one line each."""
    lines = []
    for name, reference in zip(names, references, strict=True):
        height, width = reference.crop.shape[:2]
        if min(height, width) < SMALL_PX:
            lines.append(
                f"{name}: the object is only {width}x{height} pixels; go nearer, or take more "
                "pixels"
            )
    cosine = obj.embeddings @ obj.embeddings.T
    k = len(cosine)
    for i, name in enumerate(names):
        if k > 1:
            to_others = float((cosine[i].sum() - cosine[i, i]) / (k - 1))
            if to_others < LEAST_COSINE:
                lines.append(
                    f"{name}: unlike the other references (mean cosine {to_others:.2f}); is it "
                    "the same object?"
                )
    return lines
