"""The events of the method as text: what the vote elected, what the views agreed on, which targets
were lost and found."""

from collections.abc import Mapping

from vap_core.base.errors import number_of
from vap_core.base.files import signed
from vap_core.base.types import Association, Ballot, Event, Grounding

Visible = frozenset[tuple[str, int]]
"""Camera and target index of every target that is visible in that view."""
UNMODIFIED = "the view passes unmodified"
UNMARKED = "it is not marked in this view"
"""What is said instead where the view shows another target, which is marked."""
SHARED = "two targets share one object, at most one is right"
INSIDE = "is inside another target"
LOST = "not visible, "
"""What the event of a lost target says before either."""


def grounding_events(
    groundings: Mapping[str, tuple[Grounding, ...]],
    associations: tuple[Association | None, ...],
    ids: Mapping[str, tuple[int | None, ...]],
    shown: Mapping[str, tuple[bool, ...]],
    chosen_by: str,
) -> tuple[Event, ...]:
    """Events of t = 0. `chosen_by` names what overruled a vote, where something did.

    `shown[camera][j]` says whether target j has a pixel that is no earlier target's.
    """
    events = []
    for per_view in groundings.values():
        marked = any(grounding.mask is not None for grounding in per_view)
        without = UNMARKED if marked else UNMODIFIED
        events += [_elected(grounding, chosen_by, without) for grounding in per_view]
    for j, association in enumerate(associations):
        if association is not None:
            events.append(_associated(groundings, j, association))
    for camera, per_target in ids.items():
        found = [identity for identity in per_target if identity is not None]
        if len(set(found)) < len(found):
            events.append(Event(0, "WARN", f"{camera}: {SHARED}"))
        for j, grounding in enumerate(groundings[camera]):
            has_mask = grounding.mask is not None and grounding.mask.any()
            if has_mask and not shown[camera][j] and per_target[j] not in per_target[:j]:
                text = f"{camera}: {grounding.object} {INSIDE}, {UNMARKED}"
                events.append(Event(0, "WARN", text))
    return tuple(events)


def visibility_events(frame_index: int, before: Visible, after: Visible) -> tuple[Event, ...]:
    """Targets that one step lost, and targets that it found again."""
    events = []
    shown = {camera for camera, _ in after}
    for camera, j in sorted(before - after):
        without = UNMARKED if camera in shown else UNMODIFIED
        events.append(Event(frame_index, "WARN", f"{camera}: target {j} {LOST}{without}"))
    for camera, j in sorted(after - before):
        events.append(Event(frame_index, "INFO", f"{camera}: target {j} re-acquired"))
    return tuple(events)


def is_lost(event: Event) -> bool:
    """Whether the event says that a target was lost."""
    return event.text.endswith((LOST + UNMODIFIED, LOST + UNMARKED))


def is_shared(event: Event) -> bool:
    """Whether the event says that two targets of a view are one object, or one is in the other."""
    return event.text.endswith((SHARED, f"{INSIDE}, {UNMARKED}"))


def describe_ballot(grounding: Grounding) -> str:
    """The elected candidate's votes and lead, such as "votes 5 of 5, lead +0.06"."""
    ballot = grounding.ballot
    if ballot.winner is None:
        return "no candidate"
    votes = f"votes {ballot.votes[ballot.winner]} of {grounding.similarity.shape[1]}"
    return f"{votes}, {describe_lead(ballot)}"


def describe_rejection(grounding: Grounding) -> str:
    """Why the object is not in view, such as "not in view, cosine 0.31 below 0.59".

    Where points were compared, the cosine and their proof are a likeness.
    """
    assert grounding.rejected is not None, "the grounding is rejected"
    likeness = grounding.likeness[grounding.rejected]
    measure = "cosine"
    counted = ""
    if grounding.candidates.verified is not None:
        measure = "likeness"
        counted = f", {grounding.candidates.verified[grounding.rejected]} points verified"
    digits = 2  # as many as tell the two apart
    while digits < 6 and f"{likeness:.{digits}f}" == f"{grounding.threshold:.{digits}f}":
        digits += 1
    below = f"{likeness:.{digits}f} below {grounding.threshold:.{digits}f}"
    return f"not in view, {measure} {below}{counted}"


def describe_lead(ballot: Ballot) -> str:
    """How far the elected candidate is ahead of every other, by `Ballot.cosine_margin`."""
    if len(ballot.votes) == 1:
        return "the only candidate"
    lead = f"lead {signed(ballot.cosine_margin, 2)}"
    if int(ballot.tied.sum()) > 1:
        return f"tie, {lead}"
    return lead


def _elected(grounding: Grounding, chosen_by: str, without: str) -> Event:
    """The event of one vote; `without` says what becomes of a view without the target."""
    ballot, camera, name = grounding.ballot, grounding.camera, grounding.object
    n, k = grounding.similarity.shape
    if ballot.winner is None:
        phrase = grounding.candidates.phrase
        return Event(0, "WARN", f"{camera}: no {phrase} found, {without}")
    if grounding.rejected is not None:
        text = f"{camera}: {name} {describe_rejection(grounding)}, {without}"
        return Event(0, "WARN", text)
    if grounding.winner is None:
        text = f"{camera}: {name} is none of {number_of(n, 'candidate')} by {chosen_by}, {without}"
        return Event(0, "WARN", text)
    # Whether the candidate is the named object is not known here, so the text does not say it.
    verb = "takes" if grounding.overruled else "elects"
    text = f"{camera}: {verb} candidate {grounding.winner} for {name} with "
    text += f"{ballot.votes[grounding.winner]}/{k} votes"
    if grounding.overruled:
        text += (
            f" by {chosen_by}, over candidate {ballot.winner} with {ballot.votes[ballot.winner]}"
        )
    elif ballot.tied[ballot.winner]:
        text += " after a tie"
    return Event(0, "INFO", text)


def _associated(
    groundings: Mapping[str, tuple[Grounding, ...]], j: int, association: Association
) -> Event:
    name = next(iter(groundings.values()))[j].object
    terms = ", ".join(f"{term} {score:.2f}" for term, score in association.terms.items())
    text = f"{name}: views associated, margin {association.margin:.2f}; {terms}"
    return Event(0, "INFO", text)
