"""The survey of one episode's opening: its views one by one, and whether they agree, with and without association."""

from collections.abc import Mapping, Sequence

from vap_core.associate import PAIRINGS, Pairing, Sighting, associate, compare_views
from vap_core.base.types import PersonalObject
from vap_core.evaluation.perception.first_frames import (
    KS,
    USUAL_K,
    Line,
    Looked,
    Tables,
    View,
    look,
    remembered,
    survey_view,
    under,
)
from vap_core.perception.protocols import Stack
from vap_core.vote import similarity, vote

OFF = "off"
"""Views grounded one by one, as the paper does."""


def survey(episode: Sequence[View], stack: Stack, ks: Sequence[int] = KS) -> Tables:
    """Every table of survey_view, keyed; and "agreements", a line per way to associate the views, where there are several."""
    memory = {k: remembered(stack, episode[0].row.target, k)[0] for k in ks}
    looked = [look(view, stack) for view in episode]
    tables: Tables = {"views": [], "objects": [], "detections": [], "choices": [], "agreements": []}
    for view, seen in zip(episode, looked, strict=True):
        for name, lines in survey_view(view, stack, memory, seen).items():
            tables[name] += [{**view.key, **line} for line in lines]
    if len(episode) > 1:
        tables["agreements"] = agreements(episode, looked, memory[USUAL_K])
    return tables


def agreements(
    episode: Sequence[View], looked: Sequence[Looked], mine: PersonalObject
) -> list[Line]:
    """What is highlighted in the views together (case, SPEC section 7), and in how many of those that show the target it is the target.

    A box on no object is another thing in every view.
    """
    sights = {
        view.camera: Sighting(
            similarity(seen.rows, mine.embeddings), seen.rows, seen.found.xyxy, view.optics
        )
        for view, seen in zip(episode, looked, strict=True)
    }
    alone = {camera: vote(sight.cosine).winner for camera, sight in sights.items()}
    ways: Mapping[str, Pairing | None] = {OFF: None, **PAIRINGS}
    lines = []
    for name, pairing in ways.items():
        together = None if pairing is None else associate(sights, pairing)
        chosen = alone if together is None else together.chosen
        shown = {}
        for view, seen in zip(episode, looked, strict=True):
            i = chosen[view.camera]
            shown[view.camera] = None if i is None else under(view, seen.found.xyxy[i])
        distinct = {
            camera: f"nothing in {camera}" if what == "nothing" else what
            for camera, what in shown.items()
        }
        row = episode[0].row
        counts = [view.camera for view in episode if row.target in view.visible()]
        lines.append(
            {
                "suite": row.suite, "task": row.task, "episode": row.episode, "target": row.target, "associate": name,
                "case": compare_views(distinct, row.target), "right": sum(shown[camera] == row.target for camera in counts), "views": len(counts),
                "margin": None if together is None else together.margin,
            }
        )  # fmt: skip
    return lines
