"""The survey of one episode's opening: its views one by one, and whether they agree.

Views are compared with and without association.
"""

from collections.abc import Mapping, Sequence

from vap_core.associate import PAIRINGS, Pairing, Sighting, associate, compare_views
from vap_core.base.types import PersonalObject, election_scores
from vap_core.evaluation.perception.first_frames import (
    KS,
    USUAL_K,
    TableRow,
    Tables,
    View,
    find_candidates,
    object_under_box,
    registered_object,
    survey_view,
)
from vap_core.perception.candidates import Proposals
from vap_core.perception.protocols import Stack
from vap_core.vote import compare, nominate, vote

OFF = "off"
"""Views grounded one by one, as the paper does."""


def survey(episode: Sequence[View], stack: Stack, ks: Sequence[int] = KS) -> Tables:
    """Every table of `survey_view` with its keys, and "agreements".

    "agreements" has a row per way to associate the views; none for a single view.

    Raises: as `registered_object` and `agreements`.
    """
    target = episode[0].row.target
    memory = {}
    for k in ks:
        memory[k], _ = registered_object(stack, target, k)
    candidates = find_candidates(episode, stack)
    tables: Tables = {"views": [], "objects": [], "detections": [], "choices": [], "agreements": []}
    for view, of_view in zip(episode, candidates, strict=True):
        of_tables = survey_view(view=view, stack=stack, memory=memory, candidates=of_view)
        for name, rows in of_tables.items():
            tables[name] += [{**view.key, **row} for row in rows]
    if len(episode) > 1:
        tables["agreements"] = agreements(episode, candidates, memory[USUAL_K], stack)
    return tables


def agreements(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    personal: PersonalObject,
    stack: Stack,
) -> list[TableRow]:
    """What the views of an episode highlight together, by every way to associate them.

    `case` is the comparison of the views (SPEC section 7); `right` is in how many of the `views`
    that show the target it is highlighted. A box on no object is another thing in every view.

    Raises: BadViews, as `associate`; BadEncoder, as `compare`.
    """
    few = []
    for view, of_view in zip(episode, candidates, strict=True):
        few.append(nominate(view.rgb, personal, of_view, stack))
    sightings = _sightings(episode, few, personal, stack)
    single = {camera: vote(sighting.cosine).winner for camera, sighting in sightings.items()}
    pairings: Mapping[str, Pairing | None] = {OFF: None, **PAIRINGS}
    row = episode[0].row
    table = []
    for name, pairing in pairings.items():
        association = None
        if pairing is not None:
            association = associate(sightings, pairing)
        chosen: Mapping[str, int | None] = single
        margin = None
        if association is not None:
            chosen = association.chosen
            margin = association.margin
        highlighted = _highlighted_objects(episode, few, chosen)
        n_right, n_views = _count_right(episode, highlighted)
        agreement: TableRow = {
            "suite": row.suite,
            "task": row.task,
            "episode": row.episode,
            "target": row.target,
            "associate": name,
            "case": compare_views(_distinguish_nothing(highlighted), row.target),
            "right": n_right,
            "views": n_views,
            "margin": margin,
        }
        table.append(agreement)
    return table


def _sightings(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    personal: PersonalObject,
    stack: Stack,
) -> dict[str, Sighting]:
    """The candidates of each view, by camera, as `associate` takes them."""
    sightings = {}
    for view, of_view in zip(episode, candidates, strict=True):
        sightings[view.camera] = Sighting(
            cosine=election_scores(compare(personal, of_view, stack), of_view.boxes),
            xyxy=of_view.boxes.xyxy,
            camera=view.optics,
        )
    return sightings


def _highlighted_objects(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    chosen: Mapping[str, int | None],
) -> dict[str, str | None]:
    """The object under the chosen box of each camera; None where none is chosen."""
    highlighted: dict[str, str | None] = {}
    for view, of_view in zip(episode, candidates, strict=True):
        i = chosen[view.camera]
        highlighted[view.camera] = None
        if i is not None:
            highlighted[view.camera] = object_under_box(view, of_view.boxes.xyxy[i])
    return highlighted


def _count_right(episode: Sequence[View], highlighted: Mapping[str, str | None]) -> tuple[int, int]:
    """In how many views the target is highlighted, and how many show it."""
    target = episode[0].row.target
    n_right = 0
    n_views = 0
    for view in episode:
        if target in view.visible():
            n_views += 1
            n_right += highlighted[view.camera] == target
    return n_right, n_views


def _distinguish_nothing(highlighted: Mapping[str, str | None]) -> dict[str, str | None]:
    """The same objects, with "nothing" as another thing in every camera."""
    distinct = dict(highlighted)
    for camera, name in highlighted.items():
        if name == "nothing":
            distinct[camera] = f"nothing in {camera}"
    return distinct
