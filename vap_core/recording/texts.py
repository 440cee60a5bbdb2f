"""Text in a recording: the vote of a view, the outcome, the diagnosis, the instruction pane."""

import rerun as rr

from vap_core.base.events import describe_ballot, describe_lead, describe_rejection
from vap_core.base.types import Grounding, PersonalObject
from vap_core.rollout.failure import Diagnosis
from vap_core.rollout.types import EpisodeHeader
from vap_core.simulation.types import EpisodeRow, Outcome


def describe_vote(grounding: Grounding) -> str:
    """One view's vote in a line; before it what association chose instead."""
    ballot = grounding.ballot
    if ballot.winner is None:
        return "no candidate, view unmodified"
    text = f"#{ballot.winner} wins: {describe_ballot(grounding)}"
    if grounding.rejected is not None:
        return f"#{grounding.rejected} {describe_rejection(grounding)} · {text}"
    if not grounding.overruled:
        return text
    if grounding.winner is None:
        return f"none by association · {text}"
    return f"#{grounding.winner} by association · {text}"


def vote_title(grounding: Grounding) -> str:
    """The vote in the width of a view's title; the view itself shows the votes."""
    if grounding.ballot.winner is None:
        return describe_ballot(grounding)
    if grounding.rejected is not None:
        return "not in view"
    if grounding.overruled:
        return "overruled"
    return describe_lead(grounding.ballot)


def describe_outcome(outcome: Outcome) -> str:
    """How an episode ended, such as "failure, 60 steps, moved a wrong object"."""
    parts = [outcome.status, f"{outcome.steps} steps"]
    if outcome.wrong_object:
        parts.append("moved a wrong object")
    if outcome.detail:
        parts.append(outcome.detail)
    return ", ".join(parts)


def describe_diagnosis(diagnosis: Diagnosis) -> str:
    """Which case a failure is, and why, in one line."""
    return f"{diagnosis.case.capitalize()}, {diagnosis.sub_case}: {diagnosis.sentence}"


def instruction_document(
    header: EpisodeHeader, outcome: str = "", diagnosis: str = ""
) -> rr.TextDocument:
    """The instruction and its rewrite, how the episode ended and why, and every view's vote."""
    row = header.row
    lines = [f'**said** "{header.instruction}"']
    if row.owned:
        lines.append(f"**by** {row.speaker} · {_owners(row)}")
    if header.rewritten != header.instruction:
        lines.append(f'**policy read** "{header.rewritten}"')
    else:
        lines.append("**policy read** the same words")
    if outcome:
        lines.append(f"**ended** {outcome}")
    if diagnosis:
        lines.append(f"**why** {diagnosis}")
    lines.append(
        f"{row.suite} · {row.task} · episode {row.episode} · seed {row.seed} · "
        f"{header.method} · {header.policy}"
    )
    return _markdown("  \n".join(lines) + "\n\n" + _vote_table(header))


def grounding_document(
    grounding: Grounding, obj: PersonalObject, instruction: str, rewritten: str
) -> rr.TextDocument:
    """The instruction, its rewrite, the vote and the object of one grounded picture."""
    lines = [
        f'**said** "{instruction}"',
        f'**policy reads** "{rewritten}"',
        describe_vote(grounding),
        f"{obj.name} · {obj.category} · {len(obj.crops)} references · {obj.encoder}",
    ]
    return _markdown("\n\n".join(lines))


def _owners(row: EpisodeRow) -> str:
    """ "anna's camera-personal, ben's (anna's brother) camera-lookalike-5"."""
    parts = []
    for owned in row.owned:
        known = f" ({', '.join(owned.known_as)})" if owned.known_as else ""
        parts.append(f"{owned.owner}'s{known} {owned.model}")
    return ", ".join(parts)


def _vote_table(header: EpisodeHeader) -> str:
    rows = []
    for camera, per_target in header.groundings.items():
        for grounding in per_target:
            rows.append(f"| {camera} | {describe_vote(grounding)} |")
    if not rows:
        return "*no grounding: this method does not prompt*"
    return "\n".join(["| view | vote at t = 0 |", "| --- | --- |", *rows])


def _markdown(text: str) -> rr.TextDocument:
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
