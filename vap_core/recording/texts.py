"""Text in a recording: the vote of a view, the outcome, the diagnosis, the instruction pane."""

import rerun as rr

from vap_core.base.events import describe_ballot, describe_rejection
from vap_core.base.pictures import LEGEND
from vap_core.base.types import Grounding, PersonalObject
from vap_core.rollout.types import Diagnosis, EpisodeHeader
from vap_core.simulation.types import EpisodeRow, Outcome


def describe_vote(grounding: Grounding) -> str:
    """One view's vote in a line; before it what was chosen instead."""
    ballot = grounding.ballot
    if ballot.winner is None:
        return "no candidate, view unmodified"
    if grounding.rejected is not None:
        rejection = f"#{grounding.rejected} {describe_rejection(grounding)}"
        return f"{rejection} · best of the vote: {describe_ballot(grounding)}"
    text = f"#{ballot.winner} wins: {describe_ballot(grounding)}"
    if not grounding.overruled:
        return text
    if grounding.winner is None:
        return f"none is chosen · {text}"
    return f"#{grounding.winner} is chosen · {text}"


def describe_outcome(outcome: Outcome) -> str:
    """How an episode ended, such as "failure, 60 steps, moved a wrong object"."""
    parts = [outcome.status, f"{outcome.steps} steps"]
    if outcome.wrong_object:
        parts.append("moved a wrong object")
    if outcome.detail:
        parts.append(outcome.detail)
    return ", ".join(parts)


def verdict_line(target: str, outcome: Outcome, diagnosis: Diagnosis | None) -> str:
    """How an episode ended, such as "FAILURE · Case 2 · side tints cup-2, front tints yours"."""
    parts = [outcome.status.upper()]
    if diagnosis is None:
        parts.append(f"{outcome.steps} steps")
        if outcome.detail:
            parts.append(outcome.detail)
        return " · ".join(parts)
    parts.append(diagnosis.case.capitalize())
    shown = _tinted(diagnosis, target)
    if diagnosis.case != "case 2" or not shown:
        parts.append(diagnosis.sub_case)
    if shown:
        parts.append(shown)
    return " · ".join(parts)


def verdict_document(
    header: EpisodeHeader, outcome: Outcome, diagnosis: Diagnosis | None
) -> rr.TextDocument:
    """The verdict as a heading; below it, for a failure, the sentence that explains it."""
    line = f"## {verdict_line(header.row.target, outcome, diagnosis)}"
    if diagnosis is not None:
        line += f"\n\n{diagnosis.sentence} · opens at frame {diagnosis.frame_index}"
    return _markdown(line)


def instruction_document(header: EpisodeHeader, outcome: str = "") -> rr.TextDocument:
    """The instruction and its rewrite, how the episode ended, every view's vote, the colours."""
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
    lines.append(
        f"{row.suite} · {row.task} · episode {row.episode} · seed {row.seed} · "
        f"{header.method} · {header.policy}"
    )
    lines.append(f"*{LEGEND}*")
    return _markdown("  \n".join(lines) + "\n\n" + _vote_table(header))


def _tinted(diagnosis: Diagnosis, target: str) -> str:
    """What every view tints, views of one thing together and those of the target last."""
    views: dict[str, list[str]] = {}
    for name, label in diagnosis.evidence.items():
        if name.startswith("shows_"):
            views.setdefault(str(label), []).append(name.removeprefix("shows_"))
    yours = views.pop(target, [])
    parts = []
    for label, cameras in views.items():
        thing = "no object" if label.startswith("nothing in ") else label
        parts.append(_tint_words(cameras, thing))
    if yours:
        parts.append(_tint_words(yours, "yours"))
    return ", ".join(parts)


def _tint_words(cameras: list[str], thing: str) -> str:
    names = cameras[0]
    if len(cameras) > 1:
        names = f"{', '.join(cameras[:-1])} and {cameras[-1]}"
    return f"{names} {'tint' if len(cameras) > 1 else 'tints'} {thing}"


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
