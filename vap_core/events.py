"""What attending has to say, in words that a researcher finds again: who was elected and by what, which views agreed, what came and went."""

from collections.abc import Mapping

from vap_core.values import Association, Event, Grounding

Pairs = frozenset[tuple[str, int]]
"""Camera and target, where that target is visible."""


def grounded(
    groundings: Mapping[str, tuple[Grounding, ...]],
    associations: tuple[Association | None, ...],
    ids: Mapping[str, tuple[int | None, ...]],
    by: str,
) -> tuple[Event, ...]:
    """Of t = 0; `by` says what overruled a vote where something did."""
    agreed = (_agreement(groundings, j, a) for j, a in enumerate(associations) if a is not None)
    return (*(_elected(g, by) for per_view in groundings.values() for g in per_view), *agreed, *_shared(ids))


def changed(index: int, before: Pairs, after: Pairs) -> tuple[Event, ...]:
    """Targets that a step lost, and found again."""
    lost = [Event(index, "WARN", f"{c}: target {j} not visible, the view passes unmodified") for c, j in sorted(before - after)]
    back = [Event(index, "INFO", f"{c}: target {j} re-acquired") for c, j in sorted(after - before)]
    return (*lost, *back)


def _shared(ids: Mapping[str, tuple[int | None, ...]]) -> list[Event]:
    """A warning for every view in which two targets were matched with the same object."""
    found = {camera: [i for i in per_target if i is not None] for camera, per_target in ids.items()}
    doubled = [camera for camera, of_view in found.items() if len(set(of_view)) < len(of_view)]
    return [Event(0, "WARN", f"{camera}: two targets share one object, at most one is right") for camera in doubled]


def _elected(g: Grounding, by: str) -> Event:
    if g.elected is None:
        return Event(0, "WARN", f"{g.camera}: no {g.candidates.phrase} found, the view passes unmodified")
    if g.winner is None:
        return Event(0, "WARN", f"{g.camera}: {g.object} is none of {len(g.candidates)} candidates by {by}, the view passes unmodified")
    tie = " after a tie" if g.overruled is None and g.tied[g.winner] else ""
    over = "" if g.overruled is None else f" by {by}, over candidate {g.overruled} with {g.votes[g.overruled]}"
    return Event(0, "INFO", f"{g.camera}: {g.object} is candidate {g.winner} with {g.votes[g.winner]}/{g.similarity.shape[1]} votes{tie}{over}")


def _agreement(groundings: Mapping[str, tuple[Grounding, ...]], j: int, a: Association) -> Event:
    """How sure the views are of target j together, and by what."""
    name = next(iter(groundings.values()))[j].object
    return Event(0, "INFO", f"{name}: views associated, margin {a.margin:.2f}; " + ", ".join(f"{term} {part:.2f}" for term, part in a.terms.items()))
